"""Who is inside a region whose outline is bent where marks hide it."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tactflow.vision.contact import inside
from tactflow.vision.contact.inside import inside_outline, outline_depth
from tactflow.vision.flow import flow_in_mask, inside_mask
from tactflow.vision.types import Markers
from tests.oracles.inside import plain_outline_depths

Y, X = np.mgrid[:160, :200]
RADIUS = 4.65
HIDDEN = RADIUS + 2.5


def disc(x: float, y: float, radius: float) -> NDArray[np.bool_]:
    return np.asarray(np.hypot(X - x, Y - y) <= radius, np.bool_)


def picture(region: NDArray[np.bool_]) -> NDArray[np.uint8]:
    return np.asarray(region * np.uint8(255), np.uint8)


def on_circle(radius: float, count: int = 8, phase: float = 0.3) -> NDArray[np.float64]:
    angle = phase + 2 * math.pi * np.arange(count) / count
    return np.column_stack([100.3 + radius * np.cos(angle), 80.2 + radius * np.sin(angle)])


@pytest.mark.parametrize("dent", [-3.0, 3.0])
def test_a_dent_or_a_bulge_below_a_mark_does_not_move_it(dent: float) -> None:
    # A pixel's stairs leave a few tenths: 0.45 px is the largest error measured over these, 0.6 allowed.
    for phase in np.linspace(0, 0.7, 8):
        marks = on_circle(40, phase=float(phase))
        bent = disc(100.3, 80.2, 40)
        below = np.zeros_like(bent)
        for x, y in marks:
            below |= disc(x, y, RADIUS + 1.5)
        bent = np.where(below, disc(100.3, 80.2, 40 + dent), bent)
        just_in, just_out = (on_circle(40 + by, phase=float(phase)) for by in (-0.6, 0.6))
        assert inside_outline(just_in, picture(bent), HIDDEN).all()
        assert not inside_outline(just_out, picture(bent), HIDDEN).any()
        # Below the marks the pixels say something else.
        wrong = just_in if dent < 0 else just_out
        assert inside_mask(wrong, picture(bent)).all() == (dent > 0)


@pytest.mark.parametrize("radius", [11.0, 14.0, 20.0, 40.0])
def test_the_bridge_over_a_border_is_as_round_as_the_border(radius: float) -> None:
    rng = np.random.default_rng(8)
    errors = []
    for _ in range(60):
        x, y = rng.uniform(90, 110), rng.uniform(70, 90)
        depth, angle = rng.uniform(-2, 2), rng.uniform(0, 2 * math.pi)
        mark = np.array([[x + (radius - depth) * math.cos(angle), y + (radius - depth) * math.sin(angle)]])
        found = outline_depth(mark, picture(disc(x, y, radius) & ~disc(*mark[0], 5.0)), HIDDEN, HIDDEN + 1)
        errors.append(found[0] - depth)
    # Measured over the four radii: 0.04 to 0.06 px on average, that is half of what the pixels' stairs
    # shift a rim; 0.10 to 0.14 px standard deviation.
    assert abs(np.mean(errors)) < 0.12
    assert np.std(errors) < 0.2


@pytest.mark.parametrize("angle", [0.0, 0.3, 0.9, 2.0, 4.0])
def test_the_distance_counts_to_a_fraction_of_a_pixel(angle: float) -> None:
    along = np.array([math.cos(angle), math.sin(angle)])
    region = (X - 100) * along[0] + (Y - 80) * along[1] < 0
    depth = np.arange(-2.0, 2.0, 0.1)
    points = np.array([100.0, 80]) - depth[:, None] * along
    for dilate in (0.0, 0.5, 1.25):
        inside = np.array([inside_outline(p[None], picture(region), HIDDEN, dilate)[0] for p in points])
        # Derived: whole pixels tell where a line along their sides is to half a pixel.
        assert inside[depth > 0.51 - dilate].all()
        assert not inside[depth < -0.51 - dilate].any()


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_where_nothing_is_hidden_the_pixels_decide(seed: int) -> None:
    rng = np.random.default_rng(seed)
    region = np.zeros(X.shape, bool)
    for _ in range(4):
        region |= disc(rng.uniform(20, 180), rng.uniform(20, 140), rng.uniform(3, 40))
    region &= ~disc(rng.uniform(20, 180), rng.uniform(20, 140), rng.uniform(3, 30))
    points = rng.uniform(-10, 210, (60, 2))
    mask = picture(region)
    np.testing.assert_array_equal(inside_outline(points, mask, 0.0), inside_mask(points, mask))
    # A mark whose own disc meets no outline is on the side where its pixel is, whatever the others hide.
    clear = []
    for x, y in points:
        around = disc(x, y, 9)
        alike = region[around].all() or not region[around].any()
        clear.append(alike and min(x, y) > 10 and x < 189 and y < 149)
    told = inside_outline(points, mask, HIDDEN)
    np.testing.assert_array_equal(told[clear], inside_mask(points, mask)[clear])


def test_a_mark_at_the_border_of_a_hole_knows_its_side() -> None:
    mask = picture(disc(100.3, 80.2, 70) & ~disc(100.3, 80.2, 30))
    assert not inside_outline(on_circle(29), mask, HIDDEN).any()
    assert inside_outline(on_circle(31), mask, HIDDEN).all()
    assert inside_outline(on_circle(69), mask, HIDDEN).all()
    assert not inside_outline(on_circle(71), mask, HIDDEN).any()


def test_a_strip_narrower_than_the_mark_is_crossed() -> None:
    mask = picture((np.abs(Y - 80) <= 3) & (X > 20) & (X < 180))
    points = np.array([[60.0, 78], [90, 82.5], [120, 84.2], [150, 75.4]])
    # Each alone, and together.
    alone = [bool(inside_outline(p[None], mask, HIDDEN)[0]) for p in points]
    assert alone == inside_outline(points, mask, HIDDEN).tolist() == [True, True, False, False]


def test_a_region_that_is_hidden_as_a_whole_is_taken_as_it_is() -> None:
    mask = picture(disc(100, 80, 2))
    points = np.array([[100.0, 80], [101, 80], [103.4, 80]])
    assert inside_outline(points, mask, HIDDEN).tolist() == [True, True, False]
    assert inside_outline(points, mask, HIDDEN, dilate=1.0).all()


@pytest.mark.parametrize("shape", [(1, 1), (1, 30), (30, 1), (2, 2)])
def test_the_smallest_pictures_have_an_inside(shape: tuple[int, int]) -> None:
    mask = np.full(shape, 255, np.uint8)
    assert inside_outline(np.zeros((1, 2)), mask, HIDDEN).all()
    assert not inside_outline(np.array([[40.0, 40.0]]), mask, HIDDEN).any()


def scribble(rng: np.random.Generator) -> NDArray[np.uint8]:
    """A region of any kind: smooth, with holes, in pieces, of single pixels, thin, cut by the border."""
    kind = rng.integers(5)
    if kind == 0:
        return np.asarray(rng.random((1 + rng.integers(40), 1 + rng.integers(40))) < 0.4, np.uint8)
    mask = np.zeros((int(rng.integers(1, 160)), int(rng.integers(1, 200))), np.uint8)
    for _ in range(rng.integers(1, 5)):
        center = int(rng.integers(mask.shape[1])), int(rng.integers(mask.shape[0]))
        size = int(rng.integers(1, 60)), int(rng.integers(1, 60))
        filled = -1 if kind < 4 else 1
        cv2.ellipse(mask, center, size, float(rng.uniform(0, 180)), 0, 360, int(rng.integers(3)), filled)
    return mask


def test_the_loops_find_what_the_plain_version_finds(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(11)
    bridged = 0
    for _ in range(400):
        mask = scribble(rng)
        height, width = mask.shape
        marks = rng.uniform(-12, [width + 12, height + 12], (30, 2))
        # Some in the middle of a pixel, and so with distances on a threshold.
        marks[:10] = np.rint(marks[:10])
        hidden = float(rng.choice([0.0, 1.0, 3.5, 7.15, 12.0, 300.0]))
        if rng.random() < 0.3:
            mask, marks = np.asfortranarray(mask), np.asfortranarray(marks)
        fast = outline_depth(marks, mask, hidden, hidden + 5)
        with monkeypatch.context() as patch:
            patch.setattr(inside, "outline_depths", plain_outline_depths)
            slow = outline_depth(marks, mask, hidden, hidden + 5)
        bridged += np.count_nonzero(fast != outline_depth(marks, mask, 0.0, hidden + 5))
        # Derived: the ridge, 1e-6, and the tie, 1e-6 px, are what decides about an outline of two points
        # around a mark; all else agrees to the 16 digits of doubles times a condition of at most 1e8.
        np.testing.assert_allclose(fast, slow, rtol=0, atol=1e-5)
    assert bridged > 1000


def test_quarter_turns_change_nothing() -> None:
    rng = np.random.default_rng(4)
    mask = picture(disc(80, 70, 41.3) | disc(120, 95, 30.7))
    points = rng.uniform(20, 150, (120, 2))
    expected = inside_outline(points, mask, HIDDEN, 0.5)
    for _ in range(3):
        mask = np.ascontiguousarray(np.rot90(mask, -1))
        points = np.column_stack([mask.shape[1] - 1 - points[:, 1], points[:, 0]])
        np.testing.assert_array_equal(inside_outline(points, mask, HIDDEN, 0.5), expected)


def test_nobody_is_inside_of_nothing() -> None:
    assert not inside_outline(np.zeros((3, 2)), np.zeros((5, 5), np.uint8), 3.0).any()
    assert inside_outline(np.zeros((0, 2)), picture(disc(100, 80, 30)), 3.0).shape == (0,)
    assert not inside_outline(np.zeros((3, 2)), np.zeros((0, 0), np.uint8), 3.0).any()


def test_the_flow_counts_a_mark_at_the_border_by_the_outline_around_it() -> None:
    origin = np.concatenate([on_circle(39, 6), on_circle(15, 4)])
    bent = disc(100.3, 80.2, 40)
    for x, y in origin:
        bent &= ~(disc(x, y, RADIUS + 1.5) & ~disc(100.3, 80.2, 36))
    moved = origin + np.array([2.0, -1.0])
    bent = np.roll(bent, (-1, 2), axis=(0, 1))
    known = Markers(origin, moved, np.zeros(10, np.uint8), np.full(10, 0.01), RADIUS)
    unknown = Markers(origin, moved, np.zeros(10, np.uint8), np.full(10, 0.01))
    assert flow_in_mask(known, picture(bent)).count == 10
    assert flow_in_mask(unknown, picture(bent)).count == 4


@pytest.mark.parametrize(
    ("mask", "hidden", "dilate", "message"),
    [
        (np.zeros((3, 3), bool), 1.0, 0.0, "uint8"),
        (np.zeros((3, 3, 1), np.uint8), 1.0, 0.0, r"\(H, W\)"),
        (np.zeros((3, 3), np.uint8), -1.0, 0.0, "hidden >= 0"),
        (np.zeros((3, 3), np.uint8), math.nan, 0.0, "hidden >= 0"),
        (np.zeros((3, 3), np.uint8), 1.0, math.inf, "dilate >= 0"),
    ],
)
def test_bad_input_is_refused_with_a_reason(mask: Any, hidden: float, dilate: float, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        inside_outline(np.zeros((1, 2)), mask, hidden, dilate)
