"""Properties that hold whatever comes, searched for counter-examples by hypothesis.

A failure prints the smallest example that was found, with a line (and in a random search the seed) that
reproduces it.
"""

from __future__ import annotations

import os
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from numpy.typing import NDArray

from tactflow.vision.flow import flow_in_mask
from tactflow.vision.geometry import Preprocessor
from tactflow.vision.geometry.hull import contact_geometry, contact_parts
from tactflow.vision.markers.detection import detect_markers
from tactflow.vision.markers.inpaint import remove_markers
from tactflow.vision.markers.lattice import neighbour_graph
from tactflow.vision.markers.matching import choose_spots
from tactflow.vision.types import Markers, MarkerStatus
from tests.stress.builders import DIFFERENCES, INPAINTING, assert_defined, detector

# The same examples on every run, so that a change is judged by itself; TACTFLOW_STRESS=random searches anew.
RANDOM = os.environ.get("TACTFLOW_STRESS") == "random"
thorough = settings(
    max_examples=60,
    derandomize=not RANDOM,
    deadline=None,
    database=None,
    print_blob=True,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)

MASKS = arrays.arrays(
    np.uint8, arrays.array_shapes(min_dims=2, max_dims=2, max_side=24), elements=st.sampled_from([0, 255])
)
PICTURES = arrays.arrays(
    np.uint8, st.tuples(st.integers(1, 20), st.integers(1, 20), st.just(3)), elements=st.integers(0, 255)
)
COORDINATES = st.floats(-1e4, 1e4, allow_nan=False, width=32)


def points(least: int = 1, most: int = 20) -> st.SearchStrategy[NDArray[Any]]:
    return arrays.arrays(np.float64, st.tuples(st.integers(least, most), st.just(2)), elements=COORDINATES)


@thorough
@given(MASKS, st.floats(0, 50), st.none() | st.floats(0, 50))
def test_geometry_lies_within_its_mask(mask: Any, min_area: float, max_gap: float | None) -> None:
    found = contact_geometry(mask, min_area=min_area)
    if max_gap is not None:
        found = next(iter(contact_parts(mask, min_area=min_area, max_gap=max_gap)), None)
    assert_defined(found)
    if found is None:
        return
    rows, columns = np.nonzero(mask)
    assert found.hull[:, 0].min() >= columns.min()
    assert found.hull[:, 1].max() <= rows.max()
    assert found.region_area <= found.area
    assert found.hull[:, 0].min() <= found.center[0] <= found.hull[:, 0].max()
    assert found.hull[:, 1].min() <= found.center[1] <= found.hull[:, 1].max()
    assert 0 <= found.confidence <= 1
    assert found.angle is None or -90 < found.angle <= 90


@st.composite
def marker_sets(draw: Any) -> Markers:
    count = draw(st.integers(0, 15))
    shape = (count, 2)
    near = st.floats(-30, 50, allow_nan=False, width=32)
    origin = draw(arrays.arrays(np.float64, shape, elements=near))
    move = draw(arrays.arrays(np.float64, shape, elements=st.floats(-20, 20, width=32)))
    status = draw(arrays.arrays(np.uint8, count, elements=st.integers(0, 2)))
    return Markers(origin, origin + move, status, np.full(count, np.nan))


@thorough
@given(marker_sets(), MASKS, st.floats(0, 30), st.randoms(use_true_random=False))
def test_the_flow_is_a_mean_of_displacements_in_any_order(
    markers: Markers, mask: Any, dilate: float, random: Any
) -> None:
    flow = flow_in_mask(markers, mask, dilate=dilate)
    assert_defined(flow)
    order = list(range(len(markers.status)))
    random.shuffle(order)
    parts = (markers.origin, markers.position, markers.status, markers.stderr)
    again = flow_in_mask(Markers(*(part[order] for part in parts)), mask, dilate=dilate)
    assert again.count == flow.count <= np.count_nonzero(markers.status != MarkerStatus.LOST)
    if flow.mean is None:
        assert flow.count == 0
        return
    moved = markers.displacement
    np.testing.assert_allclose(again.mean, flow.mean, rtol=0, atol=1e-12)
    assert (np.array(flow.mean) <= moved.max(axis=0) + 1e-12).all()
    assert (np.array(flow.mean) >= moved.min(axis=0) - 1e-12).all()


@thorough
@given(PICTURES, st.sampled_from(INPAINTING), st.floats(0.5, 30), st.data())
def test_inpainting_touches_nothing_but_its_mask_and_invents_no_colours(
    image: Any, method: Any, radius: float, data: Any
) -> None:
    mask = data.draw(arrays.arrays(np.uint8, image.shape[:2], elements=st.sampled_from([0, 255])))
    filled = remove_markers(image, mask, method=method, radius=radius)
    assert np.array_equal(filled[mask == 0], image[mask == 0])
    if method == "normalized":
        # A weighted mean lies between the pixels it is made of, to its rounding.
        assert int(filled.max()) <= int(image.max()) + 1
        assert int(filled.min()) >= int(image.min()) - 1


@thorough
@given(PICTURES, st.sampled_from(DIFFERENCES), st.data())
def test_any_pair_of_pictures_has_a_mask(reference: Any, method: Any, data: Any) -> None:
    image = data.draw(arrays.arrays(np.uint8, reference.shape, elements=st.integers(0, 255)))
    contact = detector(method, reference)
    assert not contact.detect(reference).touching
    result = contact.detect(image)
    assert_defined(result.strength)
    assert result.touching == bool(result.mask.any())
    assert set(np.unique(result.mask).tolist()) <= {0, 255}


@thorough
@given(PICTURES)
def test_any_picture_has_marks_within_it_or_none(image: Any) -> None:
    try:
        found = detect_markers(image)
    except ValueError as error:
        if "markers found" not in str(error):
            raise
        return
    assert_defined(found.centers)
    height, width = image.shape[:2]
    assert (found.centers > -1).all()
    assert (found.centers < (width, height)).all()


@thorough
@given(points(2, 12), points(0, 15), st.floats(1, 100), st.data())
def test_no_spot_is_given_to_two_marks(origin: Any, spots: Any, farthest: float, data: Any) -> None:
    count = len(origin)
    edges = neighbour_graph(origin, 1e5)
    lengths = np.linalg.norm(origin[edges[:, 0]] - origin[edges[:, 1]], axis=1)
    edges = edges[lengths > 1e-3]
    settled = data.draw(arrays.arrays(np.bool_, count))
    free = np.flatnonzero(~settled)
    strength = data.draw(arrays.arrays(np.float64, len(spots), elements=st.floats(0, 3)))
    chosen = choose_spots(
        origin,
        edges,
        free,
        settled,
        np.zeros((count, 2)),
        origin[free][None],
        spots,
        strength,
        pitch=10.0,
        farthest=farthest,
    )
    taken = chosen[chosen >= 0]
    assert len(set(taken.tolist())) == len(taken)
    away = np.linalg.norm(spots[taken] - origin[free[chosen >= 0]], axis=1)
    assert (away <= farthest + 1e-6).all()


@thorough
@given(
    st.integers(1, 60),
    st.integers(1, 60),
    st.sampled_from([0, 90, 180, 270]),
    st.sampled_from([1, 2, 4, 8]),
    st.sampled_from(["area", "pyramid"]),
    points(1, 5),
)
def test_a_mapping_undoes_itself(
    width: int, height: int, rotate: int, downsample: int, method: Any, cloud: Any
) -> None:
    if method == "area" and min(width, height) < downsample:
        with pytest.raises(ValueError, match="required both sides"):
            Preprocessor((width, height), rotate=rotate, downsample=downsample, method=method)
        return
    process = Preprocessor((width, height), rotate=rotate, downsample=downsample, method=method)
    assert process(np.zeros((height, width, 3), np.uint8)).shape[1::-1] == process.mapping.size
    back = process.mapping.to_raw(process.mapping.to_processed(cloud))
    # Powers of two, whole shifts: some ulps of coordinates up to 1e4.
    assert np.abs(back - cloud).max() <= 1e-10
