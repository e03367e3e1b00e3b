"""Geometry of the contact region."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from tactflow.vision.geometry.hull import contact_geometry, contact_parts
from tactflow.vision.types import Contact

Mask = NDArray[np.uint8]


def blank(width: int = 120, height: int = 100) -> Mask:
    return np.zeros((height, width), np.uint8)


def ellipse_mask(
    center: tuple[float, float], axes: tuple[float, float], angle: float, size: tuple[int, int] = (160, 140)
) -> Mask:
    """Pixels whose centre lies in the ellipse; axes are full lengths, angle in degrees as seen on screen."""
    y, x = np.mgrid[: size[1], : size[0]].astype(np.float64)
    theta = math.radians(-angle)
    along = (x - center[0]) * math.cos(theta) + (y - center[1]) * math.sin(theta)
    across = (y - center[1]) * math.cos(theta) - (x - center[0]) * math.sin(theta)
    return (((along / axes[0]) ** 2 + (across / axes[1]) ** 2) <= 0.25).astype(np.uint8) * 255


def described(mask: Mask, **kwargs: Any) -> Contact:
    contact = contact_geometry(mask, **kwargs)
    assert_sound(contact)
    return contact


def assert_sound(contact: Contact) -> None:
    """What holds for every contact: finite numbers in their ranges, slope and angle of one direction."""
    assert math.isfinite(contact.area)
    assert contact.area >= 0
    assert np.isfinite(contact.center).all()
    assert contact.hull.dtype == np.float64
    assert contact.hull.shape[1] == 2
    assert len(contact.hull) >= 1
    assert 0 <= contact.confidence <= 1
    if contact.angle is None:
        assert contact.slope is None
    else:
        assert -90 < contact.angle <= 90
        if contact.slope is None:
            assert abs(contact.angle) == pytest.approx(90, abs=1e-5)
        else:
            assert contact.slope == pytest.approx(-math.tan(math.radians(contact.angle)), rel=1e-6, abs=1e-12)
    if contact.ellipse is not None:
        major, minor = contact.ellipse.axes
        assert np.isfinite([major, minor, *contact.ellipse.center]).all()
        assert major >= minor > 0


def turned(first: float, second: float) -> float:
    """Degrees between two axes, in [0, 90]."""
    return abs((first - second + 90) % 180 - 90)


def test_nothing_is_no_contact() -> None:
    assert contact_geometry(blank()) is None
    assert contact_geometry(np.zeros((0, 0), np.uint8)) is None
    assert contact_geometry(np.zeros((1, 1), np.uint8)) is None


def test_one_pixel_is_a_point() -> None:
    mask = blank()
    mask[7, 11] = 255
    contact = described(mask)
    assert contact.center == (11, 7)
    assert contact.angle is None
    assert contact.ellipse is None
    assert contact.hull.tolist() == [[11, 7]]
    assert contact.region_area == 1
    assert contact.area == 1


@pytest.mark.parametrize("offset", [(0, 0), (13, 5), (119, 99)])
@pytest.mark.parametrize(
    ("step", "angle", "slope"),
    [((1, 0), 0.0, 0.0), ((0, 1), 90.0, None), ((1, 1), -45.0, 1.0), ((1, -1), 45.0, -1.0)],
    ids=["row", "column", "falling", "rising"],
)
def test_a_line_of_pixels_has_its_direction_exactly(
    step: tuple[int, int], angle: float, slope: float | None, offset: tuple[int, int]
) -> None:
    mask = blank(400, 400)
    for k in range(21):
        mask[100 + offset[1] + k * step[1], 100 + offset[0] + k * step[0]] = 255
    contact = described(mask)
    assert contact.angle == pytest.approx(angle, abs=1e-12)
    assert contact.slope == (None if slope is None else pytest.approx(slope, abs=1e-12))
    assert contact.confidence == pytest.approx(1.0, abs=1e-12)
    assert contact.ellipse is None
    assert contact.area == contact.region_area == 21
    assert contact.center == (100 + offset[0] + 10 * step[0], 100 + offset[1] + 10 * step[1])


@pytest.mark.parametrize("width", [3, 10, 41])
def test_a_vertical_bar_is_vertical_and_has_no_slope(width: int) -> None:
    mask = blank(201, 181)
    mask[11:170, 33 : 33 + width] = 255
    contact = described(mask)
    assert contact.angle == 90.0
    assert contact.slope is None
    assert contact.area == contact.region_area == width * 159


def test_a_disc_has_no_direction_wherever_it_lies() -> None:
    rng = np.random.default_rng(0)
    found = 0
    for radius in (3, 6, 12, 25, 45):
        for _ in range(60):
            x, y = rng.uniform(65, 75, 2)
            contact = described(ellipse_mask((x, y), (2 * radius, 2 * radius), 0))
            found += contact.angle is not None
    # 300 discs at a false alarm rate of 0.001 each: more than 4 have a chance of 2e-5.
    assert found <= 4


@pytest.mark.parametrize(("noise", "length"), [(1.0, 3.0), (2.0, 5.0)])
def test_a_rough_disc_has_no_direction_and_a_rough_ellipse_has(noise: float, length: float) -> None:
    rng = np.random.default_rng(5)

    def rough(stretch: float) -> Mask:
        knots = int(2 * math.pi * 30 / length)
        around = np.linspace(0, 2 * math.pi, 720, endpoint=False)
        bumps = rng.normal(0, noise, knots)
        at = np.linspace(0, 2 * math.pi, knots + 1)
        radius = 30 + np.interp(around, at, np.append(bumps, bumps[0]))
        outline = np.column_stack([radius * np.cos(around) * stretch, radius * np.sin(around) / stretch])
        mask = blank(160, 160)
        cv2.fillPoly(mask, [np.rint((outline + 80) * 256).astype(np.int32)], 255, shift=8)
        return mask

    found = sum(described(rough(1.0)).angle is not None for _ in range(200))
    # At a rate of 0.001, more than 4 of 200 have a chance of 3e-6; measured on 2000: 0.004 and 0.0015.
    assert found <= 4
    # An axis ratio of 1.69 and 2.
    for stretch in (1.3, math.sqrt(2)):
        for _ in range(20):
            contact = described(rough(stretch))
            assert turned(contact.angle, 0) < 8


@pytest.mark.parametrize("polygon", [3, 4, 5, 6, 8])
def test_a_regular_polygon_has_no_direction(polygon: int) -> None:
    corners = np.exp(2j * np.pi * (np.arange(polygon) / polygon + 0.013))
    points = np.column_stack([corners.real, corners.imag]) * 40 + [70.3, 60.8]
    mask = blank(160, 140)
    cv2.fillPoly(mask, [np.rint(points * 256).astype(np.int32)], 255, shift=8)
    assert described(mask).angle is None


@pytest.mark.parametrize("ratio", [1.2, 1.5, 3.0])
def test_a_rectangle_has_its_direction(ratio: float) -> None:
    for angle in (0, 20, 45, 77, 90, -60):
        theta = math.radians(-angle)
        y, x = np.mgrid[:180, :180] - 90.4
        along = x * math.cos(theta) + y * math.sin(theta)
        across = y * math.cos(theta) - x * math.sin(theta)
        mask = ((np.abs(along) <= 20 * ratio) & (np.abs(across) <= 20)).astype(np.uint8) * 255
        contact = described(mask)
        # Straight edges meet the grid coherently, so no law of random phases holds; measured: 0.5.
        assert turned(contact.angle, angle) < 1.0


@pytest.mark.parametrize("ratio", [1.3, 2.0, 4.0])
@pytest.mark.parametrize("angle", range(-85, 95, 5))
def test_an_ellipse_is_found_as_it_was_drawn(angle: int, ratio: float) -> None:
    minor = 28.0
    major = minor * ratio
    rng = np.random.default_rng(angle + 100)
    center = tuple(rng.uniform(68, 72, 2))
    contact = described(ellipse_mask(center, (major, minor), angle))  # type: ignore[arg-type]
    # Derived (see _anisotropy_limit): the grid moves the anisotropy by sqrt(0.122 / R^3) RMS per component,
    # and the angle by half of that over the anisotropy; five times the RMS never happens in 108 cases.
    radius = math.sqrt(major * minor) / 2
    scatter = math.degrees(0.5 * math.sqrt(0.122 / radius**3) / contact.confidence)
    assert turned(contact.angle, angle) < 5 * scatter
    # Area: Kendall's variance of the lattice points in an oval, 0.46 R times the oval's roundness; 6 sigma.
    area = math.pi / 4 * major * minor
    assert abs(contact.area - area) < 6 * math.sqrt(0.46 * major)
    # Centre: first moments vary by 0.68 R^1.5 / (pi R^2) px, below 0.02 px here; six times that.
    assert np.abs(np.subtract(contact.center, center)).max() < 6 * 0.68 / (math.pi * math.sqrt(minor / 2))
    ellipse = contact.ellipse
    assert ellipse.axes == pytest.approx((major, minor), rel=0.02)
    assert ellipse.angle == contact.angle
    assert contact.confidence == pytest.approx((ratio**2 - 1) / (ratio**2 + 1), abs=0.02)


@settings(max_examples=150, deadline=None)
@given(
    mask=hnp.arrays(
        np.uint8,
        hnp.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=14),
        elements=st.sampled_from([0, 0, 1, 255]),
    ),
    min_area=st.sampled_from([0.0, 1.0, 3.0]),
)
def test_any_mask_gives_sound_numbers_or_none(mask: Mask, min_area: float) -> None:
    kept = mask.copy()
    contact = contact_geometry(mask, min_area=min_area)
    parts = contact_parts(mask, min_area=min_area)
    np.testing.assert_array_equal(mask, kept)
    assert (contact is None) == (not parts)
    for found in [] if contact is None else [contact, *parts]:
        assert_sound(found)
    if not mask.any():
        assert contact is None


@settings(max_examples=100, deadline=None)
@given(
    mask=hnp.arrays(
        np.uint8,
        hnp.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=12),
        elements=st.sampled_from([0, 1, 128, 255]),
    )
)
def test_centre_and_area_are_those_of_the_pixels(mask: Mask) -> None:
    contact = contact_geometry(mask)
    if contact is None:
        assert not mask.any()
        return
    y, x = np.nonzero(mask)
    assert contact.region_area == len(x)
    assert contact.center == pytest.approx((x.mean(), y.mean()), abs=1e-9)
    inside = 0
    polygon = contact.hull.astype(np.int32)
    for v, u in np.ndindex(mask.shape):
        inside += cv2.pointPolygonTest(polygon, (float(u), float(v)), False) >= 0
    assert contact.area == inside


def test_specks_below_min_area_do_not_count() -> None:
    mask = ellipse_mask((60, 50), (50, 20), 30)
    alone = described(mask)
    mask[120:123, 130:133] = 255
    mask[5, 5] = 255
    cleaned = described(mask, min_area=10)
    assert cleaned.center == alone.center
    assert cleaned.angle == alone.angle
    assert cleaned.area == alone.area
    assert contact_geometry(mask, min_area=5000) is None
    assert described(mask, min_area=9).hull.max() == 132


def test_a_hole_belongs_to_the_hull_and_to_the_blob_size_but_not_to_the_region() -> None:
    mask = blank()
    mask[20:40, 20:40] = 255
    mask[25:35, 24:30] = 0
    contact = described(mask, min_area=400)
    assert contact.area == 400
    assert contact.region_area == 340
    assert contact.center[0] > 29.5


def test_a_large_frame_loses_no_precision() -> None:
    mask = np.zeros((2160, 3840), np.uint8)
    mask[500:1500, 1000:3000] = 255
    contact = described(mask)
    assert contact.center == (1999.5, 999.5)
    assert contact.angle == 0.0
    assert contact.area == 2_000_000
    # A row of n pixels has the variance (n^2 - 1) / 12.
    expected = (4 * math.sqrt((2000**2 - 1) / 12), 4 * math.sqrt((1000**2 - 1) / 12))
    assert contact.ellipse.axes == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(
    ("mask", "kwargs", "message"),
    [
        (np.zeros((3, 3), bool), {}, "uint8"),
        (np.zeros((3, 3, 3), np.uint8), {}, r"\(H, W\)"),
        (np.zeros((3, 3), np.uint8), {"min_area": -1}, "min_area"),
        (np.zeros((3, 3), np.uint8), {"min_confidence": 1.1}, "min_confidence"),
        (np.zeros((3, 3), np.uint8), {"min_confidence": math.nan}, "min_confidence"),
    ],
)
def test_bad_input_is_refused_with_a_reason(mask: Any, kwargs: dict[str, Any], message: str) -> None:
    for describe in (contact_geometry, contact_parts):
        with pytest.raises(ValueError, match=message):
            describe(mask, **kwargs)


def test_a_core_is_where_its_mask_is_not_0() -> None:
    mask, core = blank(), blank()
    mask[20:40, 20:50] = 1
    core[25:35, 25:45] = 2
    assert described(mask, core=core).core_area == 200
