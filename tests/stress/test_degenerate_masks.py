"""Contacts of every awkward shape, with answers worked out by hand."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.drawing.results import Annotator
from tactflow.vision.geometry.hull import contact_geometry, contact_parts
from tactflow.vision.types import Markers
from tests.stress.builders import FLOWS, HULLS, Image, assert_defined

HEIGHT, WIDTH = 60, 80


def _empty() -> Image:
    return np.zeros((HEIGHT, WIDTH), np.uint8)


def _pixel() -> Image:
    mask = _empty()
    mask[20, 30] = 255
    return mask


def _row() -> Image:
    mask = _empty()
    mask[7] = 255
    return mask


def _column() -> Image:
    mask = _empty()
    mask[:, 79] = 255
    return mask


def _diagonal(sign: int) -> Image:
    mask = _empty()
    steps = np.arange(40)
    mask[10 + steps if sign > 0 else 49 - steps, 20 + steps] = 255
    return mask


def _disc() -> Image:
    rows, columns = np.indices((HEIGHT, WIDTH))
    return ((columns - 40) ** 2 + (rows - 30) ** 2 <= 20**2).astype(np.uint8) * np.uint8(255)


def _whole() -> Image:
    return np.full((HEIGHT, WIDTH), 255, np.uint8)


def _cut() -> Image:
    """A disc of which the border of the frame leaves a quarter."""
    rows, columns = np.indices((HEIGHT, WIDTH))
    return (columns**2 + rows**2 <= 30**2).astype(np.uint8) * np.uint8(255)


def _two_pixels() -> Image:
    mask = _empty()
    mask[0, 0] = mask[59, 79] = 255
    return mask


def _frame_around() -> Image:
    mask = _whole()
    mask[1:-1, 1:-1] = 0
    return mask


@dataclass(frozen=True)
class Known:
    """What the geometry of a mask is: by hand."""

    mask: Image
    area: float
    center: tuple[float, float]
    angle: float | None
    ellipse: bool


# A rectangle of w x h pixels has variances (w^2 - 1) / 12 and (h^2 - 1) / 12.
KNOWN = {
    "one pixel": Known(_pixel(), 1, (30, 20), None, False),
    "one row": Known(_row(), 80, (39.5, 7), 0.0, False),
    "one column": Known(_column(), 60, (79, 29.5), 90.0, False),
    "a falling diagonal": Known(_diagonal(1), 40, (39.5, 29.5), -45.0, False),
    "a rising diagonal": Known(_diagonal(-1), 40, (39.5, 29.5), 45.0, False),
    "a disc": Known(_disc(), float((_disc() > 0).sum()), (40, 30), None, True),
    "the whole frame": Known(_whole(), 4800, (39.5, 29.5), 0.0, True),
    # Two specks of dust always lie on a line: that is no direction.
    "two far pixels": Known(_two_pixels(), 2, (39.5, 29.5), None, False),
    "the border alone": Known(_frame_around(), 4800, (39.5, 29.5), 0.0, True),
}


@pytest.mark.parametrize("name", KNOWN)
def test_awkward_contacts_have_the_geometry_worked_out_by_hand(name: str) -> None:
    known = KNOWN[name]
    found = contact_geometry(known.mask)
    assert found is not None
    assert_defined(found)
    assert found.area == known.area
    # One division of whole numbers: half a unit in the last place.
    np.testing.assert_allclose(found.center, known.center, rtol=1e-15)
    if known.angle is None:
        assert found.angle is None
        assert found.slope is None
    else:
        assert found.angle is not None
        assert abs(found.angle - known.angle) < 1e-12
        if abs(known.angle) == 90:
            assert found.slope is None
        else:
            assert found.slope == pytest.approx(-np.tan(np.radians(known.angle)), abs=1e-12)
    assert (found.ellipse is not None) == known.ellipse
    assert found.region_area == (known.mask > 0).sum()


def test_a_contact_cut_by_the_border_ends_there() -> None:
    found = contact_geometry(_cut())
    assert found is not None
    assert found.hull.min() == 0
    assert found.area == (_cut() > 0).sum()
    # A quarter of a disc of radius 30 around the first pixel's centre: 4 r / (3 pi), less half a
    # pixel at the straight sides where the circle's own are none: measured 0.2.
    assert found.center[0] == pytest.approx(4 * 30 / (3 * np.pi), abs=0.3)
    assert found.center[0] == pytest.approx(found.center[1], abs=1e-12)
    assert found.angle == pytest.approx(45, abs=1e-9) or found.angle is None


@pytest.mark.parametrize("method", HULLS)
@pytest.mark.parametrize("name", KNOWN)
def test_every_method_describes_and_draws_awkward_contacts(method: str, name: str) -> None:
    mask = KNOWN[name].mask
    found = HULLS[method](mask)
    assert found is not None
    assert_defined(found)
    assert found.hull.shape[1] == 2
    # Within 6e-6 degrees of the vertical there is an angle, but no slope.
    assert (found.angle is None) == (found.slope is None) or abs(found.angle or 0) > 90 - 6e-6
    for view in ("frame", "contact"):
        picture = Annotator(ellipse=True, view=view)(  # type: ignore[arg-type]
            np.zeros((HEIGHT, WIDTH, 3), np.uint8), contact=found, contact_mask=mask
        )
        assert picture.any()


@pytest.mark.parametrize("method", HULLS)
@pytest.mark.parametrize("shape", [(0, 0), (0, 5), (5, 0), (1, 1), (1, 9), (9, 1), (13, 7)], ids=str)
def test_no_contact_is_no_contact_in_any_size(method: str, shape: tuple[int, int]) -> None:
    assert HULLS[method](np.zeros(shape, np.uint8)) is None
    if 0 in shape:
        return
    full = HULLS[method](np.full(shape, 255, np.uint8))
    assert full is not None
    assert_defined(full)


@pytest.mark.parametrize("min_area", [0.0, 1.0, 1.5, 100.0])
@pytest.mark.parametrize("max_gap", [0.0, 5.0, float("inf")])
def test_groups_of_awkward_blobs_are_defined(min_area: float, max_gap: float) -> None:
    for known in KNOWN.values():
        whole = contact_geometry(known.mask, min_area=min_area)
        parts = contact_parts(known.mask, min_area=min_area, max_gap=max_gap)
        assert_defined((whole, *parts))
        if min_area <= 1:
            assert whole is not None
            assert parts


def test_a_checkerboard_of_pixels_is_one_contact_of_the_whole_frame() -> None:
    rows, columns = np.indices((HEIGHT, WIDTH))
    found = contact_geometry(((rows + columns) % 2 * 255).astype(np.uint8))
    assert found is not None
    assert_defined(found)
    assert found.area > 0.99 * HEIGHT * WIDTH
    assert found.angle == pytest.approx(0, abs=0.2)


def test_random_specks_have_no_direction_or_a_finite_one() -> None:
    random = np.random.default_rng(0)
    for density in (0.001, 0.01, 0.1, 0.5, 0.9):
        for _ in range(20):
            mask = (random.random((HEIGHT, WIDTH)) < density).astype(np.uint8) * np.uint8(255)
            for method in HULLS:
                assert_defined(HULLS[method](mask))
            assert_defined(contact_parts(mask, max_gap=3.0))


# -- flow -------------------------------------------------------------------------------------------------


def grid_markers() -> Markers:
    """A marker at every tenth pixel, all moved by (3, -2)."""
    origin = np.stack(np.meshgrid(np.arange(5, 80, 10.0), np.arange(5, 60, 10.0)), axis=-1).reshape(-1, 2)
    count = len(origin)
    return Markers(origin, origin + np.array([3.0, -2.0]), np.zeros(count, np.uint8), np.full(count, 0.1))


# Markers are at (8, 3), (18, 3), ... now; how many of them each contact holds.
INSIDE = {
    "one pixel": 0,
    "one row": 0,
    "one column": 0,
    "the whole frame": 48,
    "the border alone": 0,
    "two far pixels": 0,
}


@pytest.mark.parametrize("method", FLOWS)
@pytest.mark.parametrize("name", KNOWN)
def test_the_flow_in_awkward_contacts_is_the_motion_of_who_is_inside(method: str, name: str) -> None:
    flow = FLOWS[method](grid_markers(), KNOWN[name].mask)
    assert_defined(flow)
    if name in INSIDE:
        assert flow.count == INSIDE[name]
    if flow.count:
        # Equal displacements: their mean is exact, and so is that nothing is left to explain.
        assert flow.mean == pytest.approx((3, -2), abs=1e-12)
        if method == "mean" and flow.count >= 3 and flow.rotation is not None:
            assert flow.rotation == pytest.approx(0, abs=1e-10)
            assert flow.divergence == pytest.approx(0, abs=1e-12)
            assert flow.residual == pytest.approx(0, abs=1e-12)
    else:
        assert flow.mean is None


def markers_at(origin: NDArray[np.float64], position: NDArray[np.float64]) -> Markers:
    count = len(origin)
    return Markers(origin, position, np.zeros(count, np.uint8), np.full(count, np.nan))


@pytest.mark.parametrize("method", FLOWS)
@pytest.mark.parametrize(
    "origin",
    [
        pytest.param(np.zeros((0, 2)), id="no marker"),
        pytest.param(np.array([[40.0, 30]]), id="one"),
        pytest.param(np.array([[40.0, 30], [50, 30]]), id="two"),
        pytest.param(np.array([[40.0, 30]] * 5), id="five in one place"),
        pytest.param(np.array([[10.0 * k, 30] for k in range(8)]), id="in a row"),
        pytest.param(np.array([[-500.0, 1e9], [40, 30], [1e300, 0]]), id="far outside"),
    ],
)
def test_few_or_flat_or_far_markers_have_a_defined_flow(method: str, origin: NDArray[np.float64]) -> None:
    for dilate in (0.0, 1.0, 7.5, 1e6):
        if method == "classic" and dilate > 100:
            continue
        flow = FLOWS[method](markers_at(origin, origin + 1), _whole(), dilate=dilate)
        assert_defined(flow)
        if len(np.unique(origin, axis=0)) < 3 or np.ptp(origin[:, 1]) == 0:
            assert flow.rotation is None


def test_markers_of_any_kind_are_drawn_without_complaint() -> None:
    random = np.random.default_rng(4)
    origin = random.uniform(-1e7, 1e7, (50, 2))
    origin[:25] = random.uniform(0, 60, (25, 2))
    position = origin + random.normal(0, 5, origin.shape)
    status = random.integers(0, 3, 50).astype(np.uint8)
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    picture = Annotator()(image, markers=Markers(origin, position, status, np.full(50, np.nan)))
    assert picture.shape == image.shape
    assert picture.any()
    assert not cv2.absdiff(image, np.zeros_like(image)).any()
