"""The original script's hull, line and ellipse, and its mean flow, against its own steps."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.classic.functions import (
    get_convex_hull_area,
    mean_flow,
)
from tactflow.vision.types import Contact, Markers

Mask = NDArray[np.uint8]


def blobs(seed: int, size: tuple[int, int] = (140, 120)) -> Mask:
    """A few ellipses anywhere, with a random mask's rough border."""
    rng = np.random.default_rng(seed)
    mask = np.zeros(size, np.uint8)
    for _ in range(3):
        center = (int(rng.integers(20, size[1] - 20)), int(rng.integers(20, size[0] - 20)))
        axes = (int(rng.integers(5, 25)), int(rng.integers(3, 12)))
        cv2.ellipse(mask, center, axes, float(rng.uniform(0, 180)), 0, 360, 255, -1)
    return mask


def line_step_by_step(points: NDArray[Any], width: int) -> tuple[float, float, tuple[float, float]]:
    """The script's `regress_line`: (-angle, slope, midpoint)."""
    vx, vy, x, y = (float(v) for v in np.ravel(cv2.fitLine(points, cv2.DIST_L2, 0, 0.01, 0.01)))
    slope = vy / vx
    left = int(-x * vy / vx + y)
    right = int((width - x) * vy / vx + y)
    ends = (width - 1, right), (0, left)
    middle = ((ends[0][0] + ends[1][0]) / 2, (ends[0][1] + ends[1][1]) / 2)
    return -math.degrees(math.atan(slope)), slope, middle


def described(mask: Mask) -> Contact:
    contact = get_convex_hull_area(mask)
    assert contact is not None
    return contact


@pytest.mark.parametrize("seed", range(12))
def test_the_hull_and_its_line_are_those_of_the_script(seed: int) -> None:
    mask = blobs(seed)
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    hull = cv2.convexHull(np.vstack(contours))
    contact = described(mask)
    angle, slope, middle = line_step_by_step(hull, mask.shape[1])
    assert contact.area == cv2.contourArea(hull)
    np.testing.assert_array_equal(contact.hull, hull.reshape(-1, 2))
    assert contact.angle == pytest.approx(angle, abs=1e-9)
    assert contact.slope == pytest.approx(slope, abs=1e-9)
    assert contact.center == middle


def test_a_vertical_line_has_an_angle_and_no_slope() -> None:
    mask = np.zeros((120, 100), np.uint8)
    mask[10:90, 30] = 255
    contact = described(mask)
    assert contact.angle == pytest.approx(90, abs=1e-4)
    assert contact.slope is None
    assert contact.center == pytest.approx((30, 49.5), abs=1e-4)
    assert contact.ellipse is None


GRID = np.stack(np.meshgrid(np.arange(10.0, 200, 15), np.arange(10.0, 160, 15)), axis=-1).reshape(-1, 2)


def moved(position: NDArray[np.float64], status: NDArray[np.uint8] | None = None) -> Markers:
    status = np.zeros(len(GRID), np.uint8) if status is None else status
    return Markers(GRID, position, status, np.full(len(GRID), np.nan))


@pytest.mark.parametrize("dilate", [0, 7])
def test_the_mean_flow_is_that_of_the_scripts_loop(dilate: int) -> None:
    rng = np.random.default_rng(2)
    position = GRID + rng.normal(0, 3, GRID.shape)
    position[0] = (-4.0, 500.0)
    mask = np.zeros((160, 200), np.uint8)
    cv2.ellipse(mask, (90, 80), (60, 30), 20, 0, 360, 255, -1)
    status = rng.integers(0, 3, len(GRID)).astype(np.uint8)
    grown = cv2.dilate(mask, np.ones((2 * dilate + 1, 2 * dilate + 1), np.uint8))
    change, counter = [0, 0], 0
    for (ox, oy), (cx, cy) in zip(GRID, position, strict=True):
        if 0 <= int(cx) < 200 and 0 <= int(cy) < 160 and grown[int(cy), int(cx)] == 255:
            change[0] += int(cx - ox)
            change[1] += int(cy - oy)
            counter += 1
    flow = mean_flow(moved(position, status), mask, dilate)
    assert flow.count == counter > 10
    assert flow.mean == pytest.approx((change[0] / counter, change[1] / counter), abs=1e-12)
    assert flow.rotation is None
