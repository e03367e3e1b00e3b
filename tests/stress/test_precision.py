"""What limited precision costs: large coordinates, single against double, angles across the seam."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.vision.change import ChangeProbe, noise, tiles
from tactflow.vision.change import probe as change_probe
from tactflow.vision.contact import (
    background,
    background_kernels,
    border,
    components,
    contact_outline,
    illumination,
    nearby,
    resolution,
    response,
)
from tactflow.vision.contact import detector as contact
from tactflow.vision.contact.detector import ContactResult
from tactflow.vision.flow import flow_in_mask
from tactflow.vision.geometry import Preprocessor
from tactflow.vision.geometry.hull import contact_geometry
from tactflow.vision.markers import detection as markers
from tactflow.vision.markers import template, tracking
from tactflow.vision.smooth import AlphaBeta, ContactSmoother, OneEuro
from tactflow.vision.types import Contact, Markers
from tests.oracles import border as oracle
from tests.oracles.border import change_of
from tests.stress.builders import DIFFERENCES, SIZE, apart, axis_difference, detector, gel
from tests.stress.doubles import in_double

FAR = 1e6
"""Offset of coordinates, px."""
ULP = float(np.spacing(FAR))
"""Distance of neighbouring float64 numbers at `FAR`: 1.2e-10 px."""

# -- coordinates that are far from zero -------------------------------------------------------------------


def test_a_contact_and_its_flow_a_million_pixels_away() -> None:
    """A mask a million pixels wide: the same contact and markers at its left and at its right end."""
    pictures = gel()
    wide = np.zeros((SIZE[1], 1_000_000 + SIZE[0]), np.uint8)
    wide[:, -SIZE[0] :] = pictures.mask
    here, there = contact_geometry(pictures.mask), contact_geometry(wide)
    assert here is not None
    assert there is not None
    assert here.ellipse is not None
    assert there.ellipse is not None
    np.testing.assert_array_equal(there.hull - (FAR, 0), here.hull)
    # Moments are taken relative to the contact, in whole numbers: only the final sum is rounded.
    assert abs(there.center[0] - FAR - here.center[0]) <= ULP
    assert (there.area, there.angle, there.ellipse.axes) == (here.area, here.angle, here.ellipse.axes)
    far, status, stderr = np.array([FAR, 0.0]), np.zeros(24, np.uint8), np.full(24, 0.1)
    near = flow_in_mask(Markers(pictures.origin, pictures.position, status, stderr), pictures.mask)
    moved = Markers(pictures.origin + far, pictures.position + far, status, stderr)
    distant = flow_in_mask(moved, wide)
    assert distant.count == near.count >= 3
    # Each displacement is a difference of two rounded coordinates, over a pitch of 28 px.
    assert distant.mean == pytest.approx(near.mean, abs=2 * ULP)
    assert distant.rotation == pytest.approx(near.rotation, abs=math.degrees(4 * ULP / 28))


def test_neighbours_a_million_pixels_away_are_the_same_neighbours() -> None:
    origin = gel().origin
    expected = markers.neighbour_graph(origin, 70)
    assert len(expected) == 38
    for offset in ((FAR, 0), (-FAR, FAR)):
        np.testing.assert_array_equal(markers.neighbour_graph(origin + offset, 70), expected)


def test_a_mapping_and_its_inverse_a_million_pixels_away() -> None:
    mapping = Preprocessor((800, 600), rotate=90, downsample=4, crop=(7, 5, 700, 500)).mapping
    points = np.random.default_rng(0).uniform(-FAR, FAR, (100, 2))
    # Affine: some ten operations, each of half an ulp.
    assert np.abs(mapping.to_raw(mapping.to_processed(points)) - points).max() <= 10 * ULP


# -- single against double --------------------------------------------------------------------------------


def both(compute: Callable[[], Any], *modules: Any) -> tuple[Any, Any]:
    """The result in single precision, and in double precision."""
    single = compute()
    illumination.positions.cache_clear()
    with in_double(*modules):
        double = compute()
    illumination.positions.cache_clear()
    return single, double


@pytest.mark.parametrize("method", DIFFERENCES)
def test_single_precision_costs_the_contact_nothing(method: str) -> None:
    pictures = gel(dots=False)
    rooms = border, components, contact_outline, illumination, nearby, resolution, response

    def compute() -> ContactResult:
        return detector(method, pictures.reference).detect(pictures.touched)

    single, double = both(compute, contact, background, background_kernels, *rooms)
    # The bound of the docstring; measured 0 px and 1.4e-7.
    assert apart(single.mask, double.mask) <= 1
    assert single.strength == pytest.approx(double.strength, rel=1e-5)


@pytest.mark.parametrize("kind", ["brightened", "tilted"])
def test_single_precision_costs_the_outline_nothing(kind: str) -> None:
    rows, columns = np.indices((64, 88)).astype(np.float64)
    away = np.hypot(columns - 44, rows - 32)
    if kind == "brightened":
        answer = np.repeat(0.2 / (1 + np.exp(away - 18))[..., None], 3, axis=2)
    else:
        slope = away / 18 * (away < 18) * 0.2
        turn = np.arctan2(rows - 32, columns - 44)
        answer = np.stack([slope * np.cos(turn + phase) for phase in (0, 2.1, 4.2)], axis=-1)
    answer += np.random.default_rng(0).normal(0, 0.003, answer.shape)
    inside = (away < 26).astype(np.uint8)

    def compute() -> NDArray[Any]:
        return contact_outline.contact_level(change_of(answer.astype(contact_outline.np.float32), inside))

    single, double = both(compute, border, contact_outline, nearby, oracle)
    assert (single > 0).any()
    assert double.dtype == np.float64
    # The bound of the docstring.
    assert np.abs(single - double).max() <= 1e-3


def test_single_precision_costs_the_fit_of_the_light_nothing() -> None:
    untouched, touched = (
        background._smoothed(background._halves(picture)[1])
        for picture in (gel(dots=False).reference, gel(dots=False).touched)
    )

    def compute() -> NDArray[Any]:
        return illumination.IlluminationModel(untouched, np.full_like(untouched, 0.25)).fit(touched)

    single, double = both(compute, illumination)
    assert double.dtype == np.float64
    # The bound of the docstring, grey levels; measured 2.4e-6.
    assert np.abs(single - double).max() <= 1e-3


def test_single_precision_costs_the_tracker_nothing() -> None:
    pictures = gel()
    found = markers.detect_markers(pictures.reference)

    def compute() -> Markers:
        return tracking.MarkerTracker(pictures.reference, found).track(pictures.touched)

    single, double = both(compute, tracking, template)
    # The bound of the docstring, px; measured 1.5e-7 and 4e-6.
    assert np.abs(single.position - double.position).max() <= 1e-4
    assert np.abs(single.stderr - double.stderr).max() <= 1e-4
    assert np.array_equal(single.status, double.status)


def test_single_precision_costs_the_search_for_marks_nothing() -> None:
    single, double = both(lambda: markers.detect_markers(gel().reference), markers)
    # The bound of the docstring, px: the search for centres ends within 1e-3 px.
    assert np.abs(single.centers - double.centers).max() <= 1e-3
    assert np.array_equal(single.edges, double.edges)


def test_single_precision_costs_the_probe_nothing() -> None:
    pictures = gel()

    def compute() -> list[float]:
        random = np.random.default_rng(0)
        probe = ChangeProbe(pictures.reference)
        values = []
        for _ in range(12):
            rough = pictures.reference + random.normal(0, 1, pictures.reference.shape)
            probe.look(np.clip(np.rint(rough), 0, 255).astype(np.uint8))
            values.append(probe.strongest)
        probe.look(pictures.touched)
        return [*values[8:], probe.strongest]

    single, double = both(compute, change_probe, noise, tiles)
    # The bound of the docstring; measured 1.3e-7.
    assert single == pytest.approx(double, rel=1e-5)


# -- angles across the seam -------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["one_euro", "alpha_beta"])
def test_an_axis_that_turns_through_the_vertical_is_smoothed_without_a_jump(method: str) -> None:
    smoother = ContactSmoother(method)  # type: ignore[arg-type]
    last = None
    for index, raw in enumerate(np.arange(60.0, 480.0, 0.5)):
        angle = float(raw - 180 * math.ceil(raw / 180 - 0.5))
        out = smoother.update(touched(angle), index / 60)
        assert out.angle is not None
        assert -90 < out.angle <= 90
        if abs(abs(out.angle) - 90) > 1e-3:
            assert out.slope == pytest.approx(-math.tan(math.radians(out.angle)), rel=1e-9)
        if last is not None:
            # alpha-beta overshoots its first step by less than that step; steps are half a degree.
            assert axis_difference(out.angle, last) < 1.0
        last = out.angle
    assert axis_difference(last or 0.0, angle) < 20


def touched(angle: float) -> Contact:
    return Contact(10.0, (5.0, 5.0), angle, None, np.zeros((3, 2)), None)


@pytest.mark.parametrize("method", ["one_euro", "alpha_beta"])
def test_an_axis_that_trembles_about_the_vertical_stays_there(method: str) -> None:
    """The mean of +89 and -89 degrees is 90, not 0."""
    smoother = ContactSmoother(method)  # type: ignore[arg-type]
    for index in range(200):
        out = smoother.update(touched(89.0 if index % 2 else -89.0), index / 60)
        assert out.angle is not None
        assert abs(out.angle) >= 88.9
    assert abs(out.angle) > 89


@pytest.mark.parametrize("period", [180.0, 360.0, 1.0])
@pytest.mark.parametrize("make", [OneEuro, AlphaBeta])
def test_a_filter_with_a_period_commutes_with_a_turn(make: type, period: float) -> None:
    random = np.random.default_rng(1)
    values = np.cumsum(random.normal(0, 0.02 * period, 200))
    turned = 0.31 * period

    def wrapped(value: float) -> float:
        return float(value - period * math.ceil(value / period - 0.5))

    plain, other = make(period=period), make(period=period)
    for value in values:
        a = plain.update(wrapped(value), 0.01)
        b = other.update(wrapped(value + turned), 0.01)
        off = abs(wrapped(b - a - turned))
        # Sums of numbers below one period: some ulps of it.
        assert min(off, period - off) <= 1e-12 * period
