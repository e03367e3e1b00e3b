"""Which results are presses of their own."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.calibration.presses import PressFinder
from tactflow.engine.frame import Frame
from tactflow.message.result import Result
from tactflow.vision.types import Contact

GEL = np.full((80, 120, 3), 100, np.uint8)


def result(
    seq: int, x: int | None = None, radius: int = 12, gel: NDArray[np.uint8] = GEL, epoch: int = 0
) -> Result:
    """A frame with a round contact at (x, 40), or without: a reference."""
    ports: dict[str, object] = {"image": gel}
    if x is not None:
        mask = cv2.circle(np.zeros(GEL.shape[:2], np.uint8), (x, 40), radius, 255, -1)
        ports |= {
            "contact_mask": mask,
            "contact": Contact(450.0, (float(x), 40.0), None, None, np.zeros((0, 2)), None),
        }
    return Result(Frame("main", seq, seq / 30, gel, reference=x is None, epoch=epoch), ports)


CONTACTS = [(50, 10), (50, 16), (54, 12), (54, 12), (90, 12)]


@pytest.mark.parametrize(("pictures", "expected"), [(False, [2, 5]), (True, [1, 2, 3, 5])])
def test_pictures_of_presses_at_one_place_are_presses_of_their_own_and_frames_of_a_film_are_one(
    pictures: bool, expected: list[int]
) -> None:
    finder = PressFinder(pictures)
    finder.add(result(0))
    for seq, (x, radius) in enumerate(CONTACTS, 1):
        finder.add(result(seq, x, radius))
    assert [press.seq for press in finder.presses] == expected


def test_a_press_has_the_radius_of_its_core_where_that_is_known() -> None:
    finder = PressFinder()
    finder.add(result(0))
    for seq, area in enumerate((100 * math.pi, None), 1):
        touched = result(seq, 40 * seq)
        assert touched.contact is not None
        ports = {name: touched[name] for name in ("image", "contact_mask")} | {
            "contact": replace(touched.contact, core_area=area)
        }
        finder.add(Result(touched.frame, ports))
    assert [press.core_radius for press in finder.presses] == pytest.approx([10, math.nan], nan_ok=True)


@pytest.mark.parametrize(("brighter", "presses"), [(2, 2), (20, 1)])
def test_a_new_reference_replaces_the_one_before_and_presses_of_another_look_are_left_out(
    brighter: int, presses: int, caplog: pytest.LogCaptureFixture
) -> None:
    finder = PressFinder()
    changed = np.asarray(GEL + brighter, np.uint8)
    for seq, (x, gel) in enumerate([(None, GEL), (50, GEL), (None, changed), (50, changed)]):
        finder.add(result(seq, x, gel=gel, epoch=int(seq > 1)))
    assert np.array_equal(finder.untouched, changed)
    assert len(finder.presses) == presses
    assert ("1, are left out" in caplog.text) == (presses == 1)
