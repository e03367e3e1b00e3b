"""Pictures of the results."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.drawing.lettering import Lettering
from tactflow.drawing.results import Annotator, draw_arrows
from tactflow.vision.flow import flow_in_mask
from tactflow.vision.geometry.hull import contact_geometry
from tactflow.vision.types import Contact, Depth, Markers, MarkerStatus, Scale

GRAY = np.full((240, 320, 3), 100, np.uint8)


def slanted_mask() -> NDArray[np.uint8]:
    y, x = np.mgrid[:240, :320].astype(np.float64)
    along = (x - 150) * math.cos(0.5) + (y - 120) * math.sin(0.5)
    across = (y - 120) * math.cos(0.5) - (x - 150) * math.sin(0.5)
    return ((along / 60) ** 2 + (across / 18) ** 2 <= 1).astype(np.uint8) * 255


MASK = slanted_mask()


def contact() -> Contact:
    found = contact_geometry(MASK)
    assert found is not None
    return found


def markers(origin: Any, position: Any, status: Any) -> Markers:
    return Markers(
        np.array(origin, np.float64),
        np.array(position, np.float64),
        np.array(status, np.uint8),
        np.full(len(origin), np.nan),
    )


def field() -> Markers:
    origin = np.stack(np.meshgrid(np.arange(20, 310, 25.0), np.arange(60, 230, 25.0)), -1).reshape(-1, 2)
    status = np.zeros(len(origin), np.uint8)
    status[::7] = MarkerStatus.INFERRED
    status[::11] = MarkerStatus.LOST
    return Markers(origin, origin + np.array([2.3, -1.1]), status, np.full(len(origin), 0.02))


def everything() -> dict[str, Any]:
    dots = field()
    flow = flow_in_mask(dots, MASK)
    return {"contact": contact(), "flow": flow, "markers": dots, "contact_mask": MASK}


@pytest.mark.parametrize(
    ("status", "colour"),
    [(MarkerStatus.TRACKED, (0, 255, 255)), (MarkerStatus.INFERRED, (255, 255, 255))],
)
def test_arrows_run_from_the_origin_and_show_the_status(status: MarkerStatus, colour: Any) -> None:
    picture = GRAY.copy()
    draw_arrows(picture, markers([[50, 60]], [[60, 60]], [status]), scale=3.0)
    for x in (65, 78):
        # An antialiased stroke of one pixel reaches 92 % of its colour; measured.
        assert np.abs(picture[60, x].astype(int) - colour).max() <= 30
    np.testing.assert_array_equal(picture[60, 90], GRAY[0, 0])
    np.testing.assert_array_equal(picture[50, 65], GRAY[0, 0])


def test_an_arrow_moves_with_its_marker_by_fractions_of_a_pixel() -> None:
    black = np.zeros_like(GRAY)

    def row_of(y: float) -> float:
        picture = black.copy()
        draw_arrows(picture, markers([[40, y]], [[140, y]], [MarkerStatus.TRACKED]))
        weight = picture[:, 80, 1].astype(float)
        return float((weight * np.arange(240)).sum() / weight.sum())

    # Yellow on its dark rim; positions are kept to 1/16 px and grey levels to 1/255.
    for y in (60.0, 60.25, 60.5, 60.75):
        assert row_of(y) == pytest.approx(y, abs=0.15)


def test_the_hull_is_green_and_the_axis_orange() -> None:
    picture = Annotator(text=False)(GRAY, contact=contact())
    x, y = (contact().hull[0] + contact().hull[1]) / 2
    green = picture[round(y), round(x)].astype(int)
    assert green[1] > green[0] + 60
    assert green[1] > green[2] + 60
    x, y = np.array(contact().center) + 30 * np.array([math.cos(0.5), math.sin(0.5)])
    orange = picture[round(y), round(x)].astype(int)
    assert orange[2] > orange[0] + 100


def test_the_contact_view_is_black_outside_the_contact() -> None:
    picture = Annotator(view="contact", text=False)(GRAY, **everything())
    assert not picture[:40].any()
    assert not picture[:, 250:].any()
    assert picture[120, 150].any()
    empty = Annotator(view="contact", text=False)(GRAY, markers=field())
    assert not empty.any()


def test_text_appears_and_stays_inside_tiny_and_odd_pictures() -> None:
    results = everything()
    plain = Annotator(text=False)(GRAY, **results)
    assert not np.array_equal(plain[:40, :100], Annotator()(GRAY, **results)[:40, :100])
    for shape in ((1, 1, 3), (7, 3, 3), (33, 61, 3), (900, 1201, 3)):
        assert Annotator()(np.zeros(shape, np.uint8), **{**results, "contact_mask": None}).shape == shape


def test_pictures_of_another_kind_are_refused() -> None:
    with pytest.raises(ValueError, match=r"\(H, W, 3\) uint8"):
        Annotator()(np.zeros((4, 4), np.uint8))
    with pytest.raises(ValueError, match="contact_mask of shape"):
        Annotator(view="contact")(GRAY, contact_mask=np.zeros((4, 4), np.uint8))
    flat, scale = Depth(np.zeros((4, 4), np.float32), 0.0, None, 0.0, None), Scale(1, 1, (0, 0), (0, 0))
    with pytest.raises(ValueError, match="heights of shape"):
        Annotator(view="depth")(GRAY, depth=flat, scale=scale)


def test_a_height_map_has_its_numbers_and_a_bar_that_explains_its_colours() -> None:
    scale = Scale(0.1, 0.1, (0, 0), (0, 0))
    depth = Depth(np.full(GRAY.shape[:2], 0.2, np.float32), 0.2, None, 4.0, None)
    with_text, plain = (
        Annotator(view="depth", deepest=2.0, text=text)(GRAY, depth=depth, scale=scale)
        for text in (True, False)
    )
    changed = (with_text != plain).any(axis=2)
    height, width = changed.shape
    assert changed[:40, :60].any(), "the numbers"
    bar = with_text[-30:, : width // 2].reshape(-1, 3).tolist()
    assert [84, 1, 68] in bar, "0"
    assert [37, 231, 253] in bar, "the deepest"
    assert not changed[height // 2].any()
    tiny = Annotator(view="depth")(GRAY[:9, :9], depth=None, scale=None)
    assert tiny.shape == (9, 9, 3)


def test_letters_of_opencv_4_are_plain_but_there() -> None:
    letters = Lettering(strokes=True)
    picture = np.zeros((40, 200, 3), np.uint8)
    wide, tall = letters.size(picture, "area 12 px², 3.1°", 11)
    letters.write(picture, "area 12 px², 3.1°", (5, 25), (255, 255, 255), 11)
    rows, columns = np.nonzero(picture.any(axis=2))
    # Antialiasing and commas reach a little further than the box.
    assert columns.min() >= 5
    assert columns.max() <= 5 + wide + 2
    assert 25 - tall - 2 <= rows.min()
