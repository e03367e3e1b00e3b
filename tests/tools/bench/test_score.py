from __future__ import annotations

from copy import copy
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.sim import Truth, open_scene
from tactflow.tools.bench import score
from tactflow.tools.bench.metrics import pixel_area
from tactflow.tools.bench.quantities import Tally
from tactflow.vision.geometry import Preprocessor
from tactflow.vision.types import Contact, Flow, Markers, MarkerStatus

PREPROCESSOR = Preprocessor((800, 600), rotate=90, downsample=2)


@pytest.fixture(scope="module")
def truth() -> Truth:
    return open_scene("cable?frames=20").truth(10, PREPROCESSOR)


@pytest.fixture
def tally() -> Tally:
    return Tally()


def perfect(truth: Truth) -> Contact:
    assert truth.center is not None
    return Contact(pixel_area(truth.hull), truth.center, truth.angle, None, truth.hull, None)


def markers(truth: Truth, **changes: Any) -> Markers:
    count = len(truth.origin)
    known = Markers(
        truth.origin.copy(), truth.position.copy(), np.zeros(count, np.uint8), np.full(count, np.nan)
    )
    return replace(known, **changes)


def marker_errors(truth: Truth, *frames: Markers) -> dict[str, float]:
    tally = Tally()
    marker_score = score.MarkerScore(tally)
    for frame in frames:
        marker_score.add(frame, truth)
    return tally.errors()


def test_the_truth_scores_perfectly(truth: Truth, tally: Tally) -> None:
    assert score.add_decision(tally, True, truth, deep=True)
    score.add_geometry(tally, perfect(truth), truth)
    score.add_mask(tally, truth.contact_mask.astype(np.uint8), truth)
    errors = tally.errors()
    assert errors.pop("hull_iou") == pytest.approx(1)
    assert errors.pop("contact_iou") == 1
    assert {"area_error", "center_error", "angle_mean", "angle_max", "angle_missing"} <= set(errors)
    assert set(errors.values()) == {0}


def test_a_shifted_and_turned_contact_is_off_by_as_much(truth: Truth, tally: Tally) -> None:
    contact = perfect(truth)
    assert contact.angle is not None
    center = (contact.center[0] + 3, contact.center[1] - 4)
    moved = replace(contact, center=center, angle=contact.angle + 2, area=contact.area * 1.1)
    score.add_geometry(tally, moved, truth)
    errors = tally.errors()
    assert errors["center_error"] == pytest.approx(5)
    assert errors["angle_mean"] == pytest.approx(2)
    assert errors["area_error"] == pytest.approx(10)


def test_missed_contacts_have_no_overlap_if_they_are_deep_and_contact_on_an_idle_gel_is_false(
    truth: Truth, tally: Tally
) -> None:
    idle = open_scene("idle?frames=2").truth(1, PREPROCESSOR)
    assert not score.add_decision(tally, False, truth, deep=True)
    assert not score.add_decision(tally, False, truth, deep=False)
    assert not score.add_decision(tally, True, idle, deep=False)
    assert not score.add_decision(tally, False, idle, deep=False)
    errors = {"hull_iou": 0, "contact_iou": 0, "missed_contacts": 100, "missed_half_depth": 100}
    assert tally.errors() == errors | {"false_contacts": 50}


def test_a_direction_is_invented_for_a_disc_and_missing_only_where_the_contact_is_long(
    truth: Truth, tally: Tally
) -> None:
    disc = open_scene("press?frames=20").truth(10, PREPROCESSOR)
    assert disc.angle is None
    score.add_geometry(tally, replace(perfect(disc), angle=12.0), disc)
    assert tally.errors()["angle_invented"] == 100
    nearly_round = np.zeros_like(truth.contact_mask)
    nearly_round[10:20, 10:25] = True
    without = replace(perfect(truth), angle=None)
    stubby = copy(truth)
    stubby.contact_mask = nearly_round
    score.add_geometry(tally, without, stubby)
    assert "angle_missing" not in tally.errors()
    score.add_geometry(tally, without, truth)
    assert tally.errors()["angle_missing"] == 100


def test_markers_at_their_true_places_score_perfectly_in_any_order(truth: Truth) -> None:
    order = np.random.default_rng(3).permutation(len(truth.origin))
    mixed = markers(truth, origin=truth.origin[order], position=truth.position[order])
    for found in (markers(truth), mixed):
        assert marker_errors(truth, found) == {
            "displacement_rms": 0,
            "displacement_p99": 0,
            "wrong_percent": 0,
            "lost_percent": 0,
            "markers_missed": 0,
            "markers_false": 0,
        }


def test_markers_that_were_never_found_are_lost_and_false_ones_are_counted(truth: Truth) -> None:
    count = len(truth.origin)
    assert truth.visible.all()
    some = Markers(truth.origin[4:], truth.position[4:], np.zeros(count - 4, np.uint8), np.zeros(count - 4))
    errors = marker_errors(truth, some)
    assert errors["lost_percent"] == pytest.approx(100 * 4 / count)
    assert errors["markers_missed"] == 4
    places = np.concatenate([truth.origin, [(-30.0, -30.0), (-60.0, -60.0)]])
    status = np.full(len(places), MarkerStatus.TRACKED, np.uint8)
    # An inferred place is not a false marker.
    status[-1] = MarkerStatus.INFERRED
    errors = marker_errors(truth, Markers(places, places, status, np.zeros(len(places))))
    assert (errors["markers_false"], errors["markers_missed"]) == (1, 0)


def test_a_swap_counts_as_wrong_and_a_lost_marker_is_not_judged_by_its_position(truth: Truth) -> None:
    position, count = truth.position.copy(), len(truth.position)
    position[[0, 1]] = position[[1, 0]]
    errors = marker_errors(truth, markers(truth), markers(truth, position=position))
    assert errors["wrong_percent"] == pytest.approx(100 * 2 / (2 * count))
    assert errors["displacement_rms"] == 0
    assert errors["displacement_p99"] > 1
    position, status = truth.position.copy(), np.zeros(count, np.uint8)
    position[0], status[0] = (-900, -900), MarkerStatus.LOST
    errors = marker_errors(truth, markers(truth, position=position, status=status))
    assert errors["wrong_percent"] == errors["displacement_p99"] == 0
    assert errors["lost_percent"] == pytest.approx(100 / count)


def test_flow_is_compared_where_both_know_it_and_with_its_own_standard_error(
    truth: Truth, tally: Tally
) -> None:
    assert truth.contact_flow is not None
    x, y = truth.contact_flow
    score.add_flow(tally, Flow((x + 0.3, y + 0.4), 5, stderr=(0.5, 0.3)), truth)
    score.add_flow(tally, Flow((x + 0.4, y - 0.3), 5, stderr=(0.19, 0.4)), truth)
    score.add_flow(tally, Flow(None, 0), truth)
    score.add_flow(tally, None, truth)
    within = {"flow_within_one": 50, "flow_within_two": pytest.approx(75)}
    assert tally.errors() == {"flow_error": pytest.approx(0.5), "flow_rms": pytest.approx(0.5)} | within


def test_a_field_is_compared_in_the_contact_alone(truth: Truth, tally: Tally) -> None:
    class Shifted:
        """The true field, off by (0.3, 0.4) px."""

        def at(self, rest: NDArray[np.float64]) -> NDArray[np.float64]:
            columns, rows = rest.astype(int).T
            assert truth.contact_mask[rows, columns].all()
            return truth.displacement(rest) + np.array([0.3, 0.4])

    score.add_field(tally, Shifted(), truth)  # type: ignore[arg-type]
    score.add_field(tally, None, truth)
    assert tally.errors() == {"field_rms": pytest.approx(0.5)}
