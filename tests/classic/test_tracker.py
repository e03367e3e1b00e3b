"""The original's tracking: contour centres and the depth-first search on a grid."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from tactflow.classic.functions import marker_center, mask_marker
from tactflow.classic.tracker import GridTracker, Matcher, grid_of
from tactflow.vision.markers.detection import NoMarkersError
from tactflow.vision.types import MarkerStatus
from tests.vision.dots import grid, match, render

TRUTH = grid(10, 8, 34.0, corner=(30.2, 45.7), jitter=0.4)


def test_centres_are_the_moments_of_the_masks_contours() -> None:
    image = render((300, 400), TRUTH, 4.6)
    contours, _ = cv2.findContours(mask_marker(image), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    first = cv2.moments(contours[0])
    centers = marker_center(image)
    assert len(centers) == 80
    assert centers[0].tolist() == [first["m10"] / first["m00"], first["m01"] / first["m00"]]
    # The mask is enlarged with a half-pixel shift; measured: within 0.9 px of the truth.
    assert match(centers, TRUTH)[1].max() < 1.5


def test_contours_too_small_too_large_or_oblong_do_not_count() -> None:
    image = render((300, 400), TRUTH[:2], 4.6)
    assert len(marker_center(image)) == 2
    cv2.rectangle(image, (100, 200), (160, 206), (20, 20, 20), -1)
    cv2.circle(image, (300, 100), 2, (20, 20, 20), -1)
    cv2.circle(image, (300, 200), 20, (20, 20, 20), -1)
    assert len(marker_center(image)) == 2


def test_the_grid_is_read_off_the_centres_in_any_order() -> None:
    order = np.random.default_rng(1).permutation(80)
    read, spacing = grid_of(TRUTH[order])
    np.testing.assert_array_equal(read.reshape(-1, 2), TRUTH)
    assert spacing == pytest.approx(34, abs=0.5)


def test_a_grid_with_holes_keeps_its_rows_and_columns() -> None:
    read, _ = grid_of(np.delete(TRUTH, [20, 43], axis=0))
    assert read.shape == (10, 8, 2)
    assert np.isnan(read.reshape(-1, 2)[[20, 43]]).all()


@pytest.mark.parametrize("count", [0, 3])
def test_too_few_centres_are_an_error_with_advice(count: int) -> None:
    with pytest.raises(NoMarkersError, match=f"{count} markers found: is the sensor marker-less"):
        grid_of(TRUTH[:count])


def test_small_motions_are_followed() -> None:
    under_test = GridTracker(render((300, 400), TRUTH, 4.6))
    markers = under_test.track(render((300, 400), TRUTH + np.array([3.0, -2.0]), 4.6))
    assert (markers.status == MarkerStatus.TRACKED).all()
    # The mask has whole pixels, doubled: measured 0.5 px at most.
    np.testing.assert_allclose(markers.displacement, np.tile([3.0, -2.0], (80, 1)), atol=1.0)
    assert np.isnan(markers.stderr).all()


def test_a_marker_without_a_centre_follows_its_neighbours_and_is_inferred() -> None:
    under_test = GridTracker(render((300, 400), TRUTH, 4.6))
    shown = np.arange(80) != 35
    markers = under_test.track(render((300, 400), (TRUTH + np.array([4.0, 1.0]))[shown], 4.6))
    assert np.flatnonzero(markers.status == MarkerStatus.INFERRED).tolist() == [35]
    np.testing.assert_allclose(markers.displacement[35], [4.0, 1.0], atol=1.0)


def test_centres_in_any_order_are_matched_to_the_rows_of_the_grid() -> None:
    position, matched = Matcher(TRUTH.reshape(10, 8, 2), 34.0).match(TRUTH[::-1] + 1.5)
    np.testing.assert_allclose(position - TRUTH, 1.5)
    assert matched.tolist() == list(range(79, -1, -1))


def test_the_search_stops_after_its_visits_with_the_same_answer_every_time() -> None:
    centers = TRUTH + np.random.default_rng(4).uniform(-15, 15, TRUTH.shape)
    grid = TRUTH.reshape(10, 8, 2)
    first, second, longer = (Matcher(grid, 34.0, max_visits=n).match(centers)[1] for n in (90, 90, 4000))
    np.testing.assert_array_equal(first, second)
    used = longer[longer >= 0]
    assert len(used) == len(set(used.tolist()))


def test_a_search_without_centres_leaves_everything_where_it_was() -> None:
    position, matched = Matcher(TRUTH.reshape(10, 8, 2), 34.0).match(np.zeros((0, 2)))
    assert (matched == -1).all()
    np.testing.assert_array_equal(position, TRUTH)
