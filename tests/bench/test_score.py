from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tactflow.bench.metrics import lattice_area
from tactflow.bench.score import (
    ContactScore,
    DetectionScore,
    FlowScore,
    MarkerScore,
    RemovalScore,
    aspect_ratio,
)
from tactflow.sim import Truth, open_scene
from tactflow.vision.geometry import Preprocessor
from tactflow.vision.types import Contact, Flow, Markers, MarkerStatus

PREPROCESSOR = Preprocessor((800, 600), rotate=90, downsample=2)


@pytest.fixture(scope="module")
def truth() -> Truth:
    return open_scene("cable?frames=20").truth(10, PREPROCESSOR)


def perfect(truth: Truth) -> Contact:
    assert truth.center is not None
    return Contact(lattice_area(truth.hull), truth.center, truth.angle, None, truth.hull, None)


def markers(truth: Truth, **changes: Any) -> Markers:
    count = len(truth.origin)
    known = Markers(
        truth.origin.copy(), truth.position.copy(), np.zeros(count, np.uint8), np.full(count, np.nan)
    )
    return replace(known, **changes)


def test_the_truth_scores_perfectly(truth: Truth) -> None:
    score = ContactScore()
    assert score.detected(True, truth, deep=True)
    score.geometry(perfect(truth), truth)
    score.mask(truth.contact_mask.astype(np.uint8), truth)
    errors = score.errors()
    assert errors["hull_iou"] == pytest.approx(1)
    assert errors["contact_iou"] == 1
    for name in ("area_error", "center_error", "angle_mean", "angle_max", "angle_missing", "missed_contacts"):
        assert errors[name] == 0


def test_a_shifted_and_turned_contact_is_off_by_as_much(truth: Truth) -> None:
    contact = perfect(truth)
    assert contact.angle is not None
    moved = replace(
        contact,
        center=(contact.center[0] + 3, contact.center[1] - 4),
        angle=contact.angle + 2,
        area=contact.area * 1.1,
    )
    score = ContactScore()
    score.geometry(moved, truth)
    errors = score.errors()
    assert errors["center_error"] == pytest.approx(5)
    assert errors["angle_mean"] == pytest.approx(2)
    assert errors["area_error"] == pytest.approx(10)


def test_a_deep_contact_that_is_missed_has_no_overlap(truth: Truth) -> None:
    score = ContactScore()
    assert not score.detected(False, truth, deep=True)
    assert not score.detected(False, truth, deep=False)
    errors = score.errors()
    assert errors["hull_iou"] == 0
    assert errors["missed_contacts"] == 100
    assert errors["missed_half_depth"] == 100
    assert "center_error" not in errors


def test_contact_on_an_idle_gel_is_false() -> None:
    idle = open_scene("idle?frames=2").truth(1, PREPROCESSOR)
    score = ContactScore()
    assert not score.detected(True, idle, deep=False)
    assert not score.detected(False, idle, deep=False)
    assert score.errors() == {"false_contacts": 50.0}


def test_a_direction_given_to_a_disc_is_invented() -> None:
    disc = open_scene("press?frames=20").truth(10, PREPROCESSOR)
    assert disc.angle is None
    score = ContactScore()
    score.geometry(replace(perfect(disc), angle=12.0), disc)
    assert score.errors()["angle_invented"] == 100


def test_markers_at_their_true_places_score_perfectly(truth: Truth) -> None:
    score = MarkerScore()
    score.add(markers(truth), truth)
    assert score.errors() == {
        "displacement_rms": 0,
        "displacement_p99": 0,
        "wrong_percent": 0,
        "lost_percent": 0,
        "markers_missed": 0,
        "markers_false": 0,
    }


def test_the_order_of_the_markers_does_not_matter(truth: Truth) -> None:
    order = np.random.default_rng(3).permutation(len(truth.origin))
    score = MarkerScore()
    score.add(markers(truth, origin=truth.origin[order], position=truth.position[order]), truth)
    assert score.errors()["displacement_rms"] == 0
    assert score.errors()["wrong_percent"] == 0


def test_a_constant_error_of_the_reference_is_part_of_the_displacement_error(truth: Truth) -> None:
    score = MarkerScore()
    score.add(markers(truth, origin=truth.origin + np.array((0.03, 0.04))), truth)
    assert score.errors()["displacement_rms"] == pytest.approx(0.05)


def test_markers_that_were_never_found_are_lost(truth: Truth) -> None:
    count = len(truth.origin)
    assert truth.visible.all()
    score = MarkerScore()
    some = Markers(truth.origin[4:], truth.position[4:], np.zeros(count - 4, np.uint8), np.zeros(count - 4))
    score.add(some, truth)
    assert score.errors()["lost_percent"] == pytest.approx(100 * 4 / count)
    assert score.errors()["markers_missed"] == 4


def test_what_was_taken_for_a_marker_is_counted_and_an_inferred_place_is_not(truth: Truth) -> None:
    places = np.concatenate([truth.origin, [(-30.0, -30.0), (-60.0, -60.0)]])
    status = np.full(len(places), MarkerStatus.TRACKED, np.uint8)
    status[-1] = MarkerStatus.INFERRED
    score = MarkerScore()
    score.add(Markers(places, places, status, np.zeros(len(places))), truth)
    assert score.errors()["markers_false"] == 1
    assert score.errors()["markers_missed"] == 0


def test_a_swap_counts_as_wrong_and_does_not_enter_the_rms(truth: Truth) -> None:
    position = truth.position.copy()
    position[[0, 1]] = position[[1, 0]]
    score = MarkerScore()
    score.add(markers(truth), truth)
    score.add(markers(truth, position=position), truth)
    errors = score.errors()
    assert errors["wrong_percent"] == pytest.approx(100 * 2 / (2 * len(position)))
    assert errors["displacement_rms"] == 0
    assert errors["displacement_p99"] > 1


def test_a_marker_declared_lost_is_not_judged_by_its_position(truth: Truth) -> None:
    status = np.zeros(len(truth.origin), np.uint8)
    status[0] = MarkerStatus.LOST
    position = truth.position.copy()
    position[0] = (-900, -900)
    score = MarkerScore()
    score.add(markers(truth, position=position, status=status), truth)
    errors = score.errors()
    assert errors["wrong_percent"] == 0
    assert errors["displacement_p99"] == 0
    assert errors["lost_percent"] == pytest.approx(100 / len(position))


def test_a_gel_without_markers_gives_no_marker_errors() -> None:
    bare = open_scene("unmarked?frames=2").truth(0, PREPROCESSOR)
    score = MarkerScore()
    score.add(Markers(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, np.uint8), np.zeros(0)), bare)
    assert score.errors() == {}


def test_flow_is_compared_where_both_know_it(truth: Truth) -> None:
    assert truth.contact_flow is not None
    x, y = truth.contact_flow
    score = FlowScore()
    score.add(Flow((x + 0.3, y + 0.4), 5), truth)
    score.add(Flow(None, 0), truth)
    score.add(None, truth)
    assert score.errors() == {"flow_error": pytest.approx(0.5), "flow_rms": pytest.approx(0.5)}


def test_errors_of_the_flow_are_held_against_its_own_standard_error(truth: Truth) -> None:
    assert truth.contact_flow is not None
    x, y = truth.contact_flow
    score = FlowScore()
    score.add(Flow((x + 0.3, y + 0.4), 5, stderr=(0.5, 0.3)), truth)
    score.add(Flow((x + 0.1, y + 0.9), 5, stderr=(0.2, 0.4)), truth)
    errors = score.errors()
    assert (errors["flow_within_one"], errors["flow_within_two"]) == (50, 75)


def test_detected_dots_are_compared_with_visible_ones(truth: Truth) -> None:
    score = DetectionScore()
    score.add(truth.position[truth.visible] + np.array((0.6, 0.8)), truth)
    errors = score.errors()
    assert errors["marker_recall"] == errors["marker_precision"] == 1
    assert errors["localisation_rms"] == pytest.approx(1)


def test_removal_is_judged_inside_the_mask_only() -> None:
    true = np.full((10, 10, 3), 100, np.uint8)
    image = true.copy()
    image[:5] += 7
    mask = np.zeros((10, 10), np.uint8)
    mask[:5] = 255
    score = RemovalScore()
    score.add(image, true, mask)
    assert score.errors()["inpaint_mae"] == 7
    score = RemovalScore()
    score.add(image, true, 255 - mask)
    assert score.errors()["inpaint_mae"] == 0


def test_the_ratio_of_axes_is_that_of_a_rectangle() -> None:
    mask = np.zeros((100, 100), bool)
    mask[10:20, 10:50] = True
    # The variance of a block of n pixels with their own extent is n^2 / 12: the ratio is exact.
    assert aspect_ratio(mask) == pytest.approx(4)
    assert aspect_ratio(np.zeros((5, 5))) == 1


def test_the_direction_of_a_nearly_round_contact_is_not_judged(truth: Truth) -> None:
    mask = np.zeros_like(truth.contact_mask)
    mask[10:20, 10:25] = True
    score = ContactScore()
    score.geometry(replace(perfect(truth), angle=None), replace(truth, contact_mask=mask))
    assert "angle_missing" not in score.errors()
    score.geometry(replace(perfect(truth), angle=None), truth)
    assert score.errors()["angle_missing"] == 100
