"""Stage `smooth`."""

from __future__ import annotations

import numpy as np

from tactflow.engine.frame import Absent, Frame
from tactflow.stages.smooth import Smooth
from tactflow.vision.types import Contact

IMAGE = np.zeros((4, 4, 3), np.uint8)


def frame(t: float) -> Frame:
    return Frame("main", round(60 * t), t, IMAGE)


def contact(x: float) -> Contact:
    return Contact(10.0, (x, 0.0), 30.0, -0.577, np.zeros((1, 2)), None)


def centre(result: Contact | Absent) -> float:
    assert isinstance(result, Contact)
    return result.center[0]


def test_a_jump_is_followed_gradually() -> None:
    stage = Smooth(Smooth.Params())
    assert centre(stage.process(contact(0), frame(0.0))) == 0
    assert 0 < centre(stage.process(contact(10), frame(0.02))) < 10


def test_no_contact_stays_none_and_the_next_contact_starts_afresh() -> None:
    stage = Smooth(Smooth.Params())
    stage.process(contact(0), frame(0.0))
    assert stage.process(None, frame(0.02)) == Absent("no_contact")
    assert centre(stage.process(contact(10), frame(0.04))) == 10


def test_reset_forgets() -> None:
    stage = Smooth(Smooth.Params())
    stage.process(contact(0), frame(0.0))
    stage.reset()
    assert centre(stage.process(contact(10), frame(0.02))) == 10
