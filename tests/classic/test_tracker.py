"""The original's tracking: contour centres and the depth-first search on a grid."""

from __future__ import annotations

import numpy as np
import pytest

from tactflow.classic.tracker import GridTracker, Matcher, grid_of
from tactflow.vision.markers.detection import NoMarkersError
from tactflow.vision.types import MarkerStatus
from tests.vision.dots import grid, render

TRUTH = grid(10, 8, 34.0, corner=(30.2, 45.7), jitter=0.4)


@pytest.mark.parametrize("count", [0, 3])
def test_too_few_centres_are_an_error_with_advice(count: int) -> None:
    with pytest.raises(NoMarkersError, match=f"{count} markers found: is the sensor marker-less"):
        grid_of(TRUTH[:count])


def test_a_marker_without_a_centre_follows_its_neighbours_and_is_inferred() -> None:
    under_test = GridTracker(render((300, 400), TRUTH, 4.6))
    shown = np.arange(80) != 35
    markers = under_test.track(render((300, 400), (TRUTH + np.array([4.0, 1.0]))[shown], 4.6))
    assert np.flatnonzero(markers.status == MarkerStatus.INFERRED).tolist() == [35]
    np.testing.assert_allclose(markers.displacement[35], [4.0, 1.0], atol=1.0)


def test_the_search_stops_after_its_visits_with_the_same_answer_every_time() -> None:
    centers = TRUTH + np.random.default_rng(4).uniform(-15, 15, TRUTH.shape)
    grid = TRUTH.reshape(10, 8, 2)
    first, second, longer = (Matcher(grid, 34.0, max_visits=n).match(centers)[1] for n in (90, 90, 4000))
    np.testing.assert_array_equal(first, second)
    used = longer[longer >= 0]
    assert len(used) == len(set(used.tolist()))
