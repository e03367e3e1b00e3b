"""Valid area: which part of a picture is gel."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from tactflow.sim import open_scene
from tactflow.vision.geometry.valid_area import bounding_box, lit_area, polygon_mask, valid_area

GEL = np.full((240, 320, 3), (90, 120, 60), np.uint8)


def with_disc(image: np.ndarray, center: tuple[int, int], radius: int, level: int) -> np.ndarray:
    return np.asarray(cv2.circle(image.copy(), center, radius, (level,) * 3, -1))


@pytest.mark.parametrize("scene", ["press", "dense", "bright_dots", "unmarked"])
def test_a_picture_of_nothing_but_gel_is_valid_everywhere(scene: str) -> None:
    assert valid_area(open_scene(f"{scene}?frames=2").frame(0)).all()


def test_a_black_surround_is_no_gel() -> None:
    window = np.zeros(GEL.shape[:2], np.uint8)
    cv2.ellipse(window, (160, 120), (120, 90), 0, 0, 360, 255, -1)
    noise = np.random.default_rng(0).integers(0, 12, GEL.shape, np.uint8)
    picture = np.where(window[:, :, None] > 0, GEL, noise)
    valid = valid_area(picture)
    outline = cv2.morphologyEx(window, cv2.MORPH_GRADIENT, np.ones((5, 5), np.uint8))
    assert ((valid == window) | (outline > 0)).all()


def test_a_thin_black_strip_along_the_border_is_no_gel() -> None:
    picture = GEL.copy()
    picture[:6] = 4
    assert not valid_area(picture)[:4].any(), "brightness is averaged over 5 px"
    assert valid_area(picture)[9:].all()


def test_marks_stay_gel_even_where_the_border_cuts_them() -> None:
    picture = GEL
    for x in range(20, 320, 40):
        for y in range(0, 241, 40):
            picture = with_disc(picture, (x, y), 9, 3)
    assert valid_area(picture)[5:-5].all()


def test_the_black_between_bright_pins_is_gel_and_has_no_light() -> None:
    picture = np.full((256, 256, 3), 15, np.uint8)
    for x in range(40, 220, 12):
        for y in range(40, 220, 12):
            picture = with_disc(picture, (x, y), 4, 250)
    assert valid_area(picture)[40:208, 40:208].all()
    assert not valid_area(picture)[:10].any()
    assert not lit_area(picture)[50:198, 50:198].any()


def test_folds_beside_the_gel_are_no_gel() -> None:
    picture = GEL.copy()
    picture[:, :110] += np.uint8(60 + 60 * np.sin(np.arange(110) * 2 * np.pi / 18))[None, :, None]
    lit = lit_area(picture)
    assert not lit[:, :85].any()
    assert lit[:, 135:].all()


@pytest.mark.parametrize("step", [40, 130])
def test_gel_reaches_up_to_an_edge(step: int) -> None:
    picture = GEL.copy()
    picture[:, :160] += np.uint8(step)
    assert lit_area(picture)[4:-4].all()


@pytest.mark.parametrize("scene", ["press", "dense", "bright_dots"])
def test_dots_that_were_not_removed_are_no_edges(scene: str) -> None:
    # Those that the border of the picture cuts are.
    assert lit_area(open_scene(f"{scene}?frames=2").frame(0)).mean() > 0.99


def test_a_lamp_that_saturates_all_channels_is_no_gel() -> None:
    valid = valid_area(with_disc(GEL, (160, 120), 30, 255))
    assert valid[120, 160] == 0
    assert valid[120, 200] == 255
    one_channel = GEL.copy()
    one_channel[:, :, 1] = 255
    assert valid_area(one_channel).all(), "the others still tell"


@pytest.mark.parametrize("level", [0, 255])
def test_a_picture_without_any_gel_is_valid_everywhere(level: int) -> None:
    assert valid_area(np.full((60, 80, 3), level, np.uint8)).all()


def test_a_large_picture_has_the_area_of_a_small_one() -> None:
    picture = GEL.copy()
    picture[:, :80] = 5
    large = cv2.resize(picture, None, fx=4, fy=4, interpolation=cv2.INTER_NEAREST)
    assert abs((valid_area(large) > 0).mean() - (valid_area(picture) > 0).mean()) < 0.01


def test_a_polygon_gives_its_pixels_and_their_bounding_box() -> None:
    area = polygon_mask([(10, 20), (30, 20), (30, 50), (10, 50)], width=80, height=60)
    assert np.count_nonzero(area) == 21 * 31
    assert bounding_box(area) == (slice(20, 51), slice(10, 31))


@pytest.mark.parametrize("polygon", [[(1, 1), (2, 2)], [(100, 100), (120, 100), (110, 120)]])
def test_a_polygon_without_corners_or_outside_is_refused(polygon: list[tuple[float, float]]) -> None:
    with pytest.raises(ValueError, match="polygon"):
        polygon_mask(polygon, width=80, height=60)
