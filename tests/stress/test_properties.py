"""Properties that hold whatever comes, searched for counter-examples by hypothesis.

A failure prints the smallest example that was found, with a line (and in a random search the seed) that
reproduces it.
"""

from __future__ import annotations

import os
from typing import Any

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from tactflow.vision.flow import flow_in_mask
from tactflow.vision.markers.detection import detect_markers
from tactflow.vision.types import Markers, MarkerStatus
from tests.stress.builders import DIFFERENCES, assert_defined, detector

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
