"""The judge of what is accepted as a ball."""

from __future__ import annotations

import pytest

from lab.not_balls import NOT_BALLS, RADIUS, simulated, verdict
from tactflow.calibration.scale import centre
from tactflow.sim import shapes
from tactflow.sim.gel import MM_PER_PX
from tactflow.vision.types import Scale


@pytest.mark.parametrize(
    ("name", "words"), [("cone", "pointed or flat"), ("ring", "fill"), (None, "")], ids=str
)
def test_simulated_things_are_refused_for_their_shape_and_a_ball_is_not(name: str | None, words: str) -> None:
    session = simulated(shapes.ball if name is None else NOT_BALLS[name])
    scale = Scale(2 * MM_PER_PX, 2 * MM_PER_PX, (0.0, 0.0), centre(session.mapping.size))
    decision, why = verdict(session, scale, RADIUS)
    assert (decision == "refused") == (name is not None)
    assert words in why
