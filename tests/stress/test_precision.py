"""What limited precision costs: large coordinates, single against double."""

from __future__ import annotations

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
from tactflow.vision.geometry import Preprocessor
from tactflow.vision.markers import detection as markers
from tactflow.vision.markers import template, tracking
from tactflow.vision.types import Markers
from tests.oracles import border as oracle
from tests.oracles.border import change_of
from tests.stress.builders import DIFFERENCES, apart, detector, gel
from tests.stress.doubles import in_double

FAR = 1e6
"""Offset of coordinates, px."""
ULP = float(np.spacing(FAR))
"""Distance of neighbouring float64 numbers at `FAR`: 1.2e-10 px."""

# -- coordinates that are far from zero -------------------------------------------------------------------


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
