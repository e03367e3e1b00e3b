"""Fusion of what the light and what the markers say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.contact.fusion import MIN_RESTING_MARKERS, changed_mask, fuse_contact
from tactflow.vision.flow.motion import MotionTest
from tactflow.vision.types import Markers, MarkerStatus

ORIGIN = np.array([[x, y] for y in range(20, 220, 25) for x in range(20, 300, 25)], np.float64)
DARK = np.zeros((240, 320), np.uint8)


def markers(displacement: float = 0.0, status: MarkerStatus = MarkerStatus.TRACKED) -> Markers:
    """Pushed aside, most of all 40 px from (147, 118)."""
    away = (ORIGIN - [147, 118]) / 40
    moved = displacement * away * np.exp((1 - (away**2).sum(axis=1, keepdims=True)) / 2)
    count = len(ORIGIN)
    return Markers(ORIGIN, ORIGIN + moved, np.full(count, status, np.uint8), np.full(count, 0.02), radius=4.0)


def light(*rectangle: int) -> NDArray[np.uint8]:
    left, top, right, bottom = rectangle
    mask = DARK.copy()
    mask[top:bottom, left:right] = 255
    return mask


def test_where_neither_sees_anything_there_is_nothing() -> None:
    fused = fuse_contact(DARK, markers(), MotionTest(ORIGIN))
    assert not fused.touching
    assert fused.mask is DARK


def test_what_both_see_has_the_outline_of_the_light() -> None:
    seen = light(120, 100, 170, 150)
    fused = fuse_contact(seen, markers(3.0), MotionTest(ORIGIN))
    assert (fused.evidence, fused.light_changed) == ("both", False)
    assert fused.mask is seen


def test_a_touch_between_the_markers_is_shown_by_the_light() -> None:
    fused = fuse_contact(light(125, 100, 140, 110), markers(), MotionTest(ORIGIN))
    assert fused.evidence == "light"


def test_where_the_light_sees_nothing_the_markers_give_the_region() -> None:
    fused = fuse_contact(DARK, markers(3.0), MotionTest(ORIGIN))
    assert fused.evidence == "dots"
    rows, columns = np.nonzero(fused.mask)
    assert np.hypot(columns.mean() - 147, rows.mean() - 118) < 10
    assert 40 < np.ptp(columns) < 120


def test_a_change_of_the_light_over_many_resting_markers_is_no_contact() -> None:
    everywhere = light(0, 0, 320, 240)
    fused = fuse_contact(everywhere, markers(), MotionTest(ORIGIN))
    assert fused.light_changed
    assert not fused.touching
    assert not fused.mask.any()


def test_fewer_resting_markers_leave_the_light_its_say() -> None:
    one_row = light(10, 10, 15 + 25 * (MIN_RESTING_MARKERS - 1), 30)
    assert fuse_contact(one_row, markers(), MotionTest(ORIGIN)).evidence == "light"


def test_markers_that_are_not_seen_do_not_rest() -> None:
    """A contact often hides the markers below it."""
    everywhere = light(0, 0, 320, 240)
    lost = markers(status=MarkerStatus.LOST)
    assert fuse_contact(everywhere, lost, MotionTest(ORIGIN)).evidence == "light"


def test_what_the_removal_of_a_marker_leaves_at_its_rim_is_no_contact() -> None:
    sliver = light(24, 16, 28, 24)
    assert not fuse_contact(sliver, markers(), MotionTest(ORIGIN)).touching
    with_contact = sliver | light(125, 100, 140, 110)
    fused = fuse_contact(with_contact, markers(), MotionTest(ORIGIN))
    assert (fused.mask == light(125, 100, 140, 110)).all()


def test_what_has_changed_tells_of_rests_and_rims_not_how_it_is_outlined() -> None:
    outline, everywhere, sliver = (
        light(10, 10, 40, 40),
        np.ones((2, 60, 80), np.float32),
        light(20, 12, 32, 28),
    )
    cells = np.zeros((2, 60, 80), np.float32)
    cells[1, 3:7, 5:8] = 20
    assert np.array_equal(changed_mask(cells, (240, 320)), sliver)
    assert fuse_contact(outline, markers(), MotionTest(ORIGIN)).touching
    assert fuse_contact(outline, markers(), MotionTest(ORIGIN), everywhere).light_changed
    assert not fuse_contact(outline, markers(), MotionTest(ORIGIN), cells).touching


def test_beside_markers_of_unknown_size_nothing_is_taken_for_a_rim() -> None:
    sliver, sizes_unknown = light(24, 16, 28, 24), replace(markers(), radius=None)
    fused = fuse_contact(sliver, sizes_unknown, MotionTest(ORIGIN))
    assert fused.evidence == "light"
    assert fused.mask is sliver


def test_a_touch_on_a_marker_that_is_larger_than_it_counts() -> None:
    assert fuse_contact(light(10, 10, 32, 32), markers(), MotionTest(ORIGIN)).evidence == "light"
