"""The stage valid_area, and the stages that take what it finds."""

from __future__ import annotations

import numpy as np
import pytest

from tactflow.engine.errors import StageError
from tactflow.engine.frame import Frame
from tactflow.stages.difference import Difference
from tactflow.stages.valid_area import ValidArea

GEL = np.full((120, 160, 3), 100, np.uint8)
HOUSED = GEL.copy()
HOUSED[:, :40] = 6


def area_of(area: object, image: np.ndarray = HOUSED) -> np.ndarray:
    return ValidArea(ValidArea.Params.model_validate({"area": area})).process(image)


def test_the_area_is_found_once_for_each_reference() -> None:
    stage = ValidArea(ValidArea.Params())
    found = stage.process(HOUSED)
    assert found[60, 20] == 0
    assert stage.process(GEL) is found
    stage.reset()
    assert stage.process(GEL).all()


def test_the_area_may_be_all_or_a_polygon() -> None:
    assert area_of("all").all()
    assert area_of([[50, 10], [90, 10], [90, 40], [50, 40]]).sum() == 255 * 41 * 31


def test_a_polygon_outside_of_the_picture_is_refused() -> None:
    with pytest.raises(StageError, match="covers no pixel"):
        area_of([[300, 300], [310, 300], [310, 310]])


def test_what_changes_outside_of_the_area_is_no_contact() -> None:
    noise = np.random.default_rng(0).normal(0, 1.5, (3, *GEL.shape))
    rest, busy, pressed = (np.clip(GEL + part, 0, 255).astype(np.uint8) for part in noise)
    busy[:, :30] //= 2
    pressed[40:80, 90:130] += 60
    pressed[:, :30] //= 2

    def touched(valid: np.ndarray | None) -> list[bool]:
        stage = Difference(Difference.Params())
        stage.process(rest, Frame("s", 0, 0, rest, reference=True), valid=valid)
        return [
            stage.process(image, Frame("s", 1, 0, image), valid=valid).touching for image in (busy, pressed)
        ]

    assert touched(None) == [True, True]
    assert touched(area_of([[40, 0], [159, 0], [159, 119], [40, 119]])) == [False, True]


def test_a_lamp_that_covers_most_of_a_black_surround_still_is_a_change_of_the_light() -> None:
    """The surround stays black under a stronger lamp, and must not say how strong the lamp is."""
    shade = np.linspace(80, 150, 160)[None, :, None] + np.zeros((120, 160, 3))
    shade[:, :110] = 5
    rest = shade.astype(np.uint8)
    brighter = np.where(shade > 5, shade * 1.2, 5).astype(np.uint8)
    stage = Difference(Difference.Params())
    valid = area_of("auto", rest)
    stage.process(rest, Frame("s", 0, 0, rest, reference=True), valid=valid)
    assert not stage.process(brighter, Frame("s", 1, 0, brighter), valid=valid).touching
