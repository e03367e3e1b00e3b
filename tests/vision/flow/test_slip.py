"""Motion of the object against the gel, gross and incipient slip."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
import pytest

from tactflow.sim import open_scene
from tactflow.vision.flow import FieldModel, SlipTracker
from tactflow.vision.flow.registration import cells, light_change
from tactflow.vision.flow.slip import stick_ratio
from tactflow.vision.geometry.preprocess import Preprocessor
from tactflow.vision.types import Markers, MarkerStatus

MAPPING = Preprocessor((800, 600), rotate=90, downsample=2).mapping
NOISE = 0.015


def judged(spec: str, frames: range) -> Iterator[tuple[int, bool, float, Any]]:
    """Frame, whether it truly slips, its true stick ratio, and the slip, from true outlines and depths."""
    scene, tracker, rng = open_scene(spec), SlipTracker(), np.random.default_rng(3)
    model = FieldModel(scene.truth(0, MAPPING).origin, MAPPING.size)
    for index in frames:
        truth = scene.truth(index, MAPPING)
        if not truth.touching or truth.stick_ratio is None:
            tracker.reset()
            continue
        seen = np.where(truth.visible, MarkerStatus.TRACKED, MarkerStatus.LOST).astype(np.uint8)
        position = truth.position + rng.normal(0, NOISE, truth.position.shape)
        markers = Markers(truth.origin, position, seen, np.full(len(seen), NOISE))
        field = model(markers)
        mask = np.uint8(255) * truth.contact_mask
        picture = np.repeat(np.rint(2 * truth.sunk).astype(np.uint8)[..., None], 3, axis=2)
        slip = tracker(index, index / 60, light_change(picture, cells(0 * picture), None), field, mask)
        if slip is not None:
            yield index, truth.slipping, truth.stick_ratio, slip


@pytest.mark.parametrize(
    "spec", ["slide?frames=140", "stick_slip?frames=150", "scrape?frames=140", "spin?frames=140"]
)
def test_a_contact_that_slides_is_noticed_within_0_1_seconds_and_not_before(spec: str) -> None:
    told = [(index, true, slip.slipping) for index, true, _, slip in judged(spec, range(14, 110))]
    first = next(index for index, true, _ in told if true)
    found = next(index for index, _, slipping in told if slipping)
    assert first <= found <= first + 6
    # From then on without a gap, for as long as it slides.
    assert all(slipping for index, true, slipping in told if true and index >= found)


def test_a_slip_is_noticed_where_no_dot_is_where_the_gel_clings_to_the_object() -> None:
    told = list(judged("stick_slip?seed=13", range(190, 226)))
    first = next(index for index, true, _, _ in told if true)
    mostly = next(index for index, _, sticks, _ in told if sticks < 0.5)
    scene = open_scene("stick_slip?seed=13")
    truth, (press,) = scene.truth(first, MAPPING), scene.presses(first)
    away = np.hypot(*(truth.position - truth.center).T)
    clings = press.radius * math.sqrt(truth.contact_mask.sum() / math.pi) / math.sqrt(2 * 95 * press.depth)
    assert away.min() > clings
    # Without a dot there, the gel that slips at the edge looks like all of it.
    assert mostly <= next(index for index, *_, slip in told if slip.slipping) <= first + 6


def test_what_rolls_sticks_also_where_it_has_left_the_gel_that_it_touched_first() -> None:
    told = [slip.stick_ratio for *_, slip in judged("roll?frames=140&seed=11", range(30, 110, 2))]
    assert np.mean(told) > 0.85
    assert min(told) > 0.5


@pytest.mark.parametrize("spec", ["press?frames=150", "twist?frames=140", "roll?frames=140"])
def test_what_presses_or_turns_and_sticks_or_rolls_does_not_slip(spec: str) -> None:
    told = [slip.slipping for *_, slip in judged(spec, range(14, 110))]
    assert len(told) > 40
    assert not any(told)


@pytest.mark.parametrize("spec", ["twist?frames=140&seed=11", "box?frames=80"])
def test_a_flat_contact_that_turns_or_is_pressed_harder_sticks_as_a_whole(spec: str) -> None:
    told = [slip.stick_ratio for *_, slip in judged(spec, range(14, 74, 2))]
    assert len(told) > 15
    assert np.mean(told) > 0.93
    assert min(told) > 0.8


def test_the_stick_ratio_falls_from_the_edge_of_the_contact_inwards() -> None:
    told = [
        (true, slip.stick_ratio)
        for _, _, true, slip in judged("stick_slip?frames=150&markers=16x12", range(14, 86))
    ]
    whole = [ratio for true, ratio in told if true > 0.95]
    half = [ratio for true, ratio in told if 0.4 < true < 0.6]
    last = [ratio for true, ratio in told if true < 0.2]
    assert np.mean(whole) > np.mean(half) + 0.15 > np.mean(last) + 0.25
    assert np.sqrt(np.mean([(true - ratio) ** 2 for true, ratio in told])) < 0.3


def test_gel_that_stays_behind_does_not_stick() -> None:
    points = np.stack(np.meshgrid(np.arange(0.0, 90, 10), np.arange(0.0, 90, 10)), axis=-1)
    share = (np.hypot(*(points - 40).transpose(2, 0, 1)) < 35).astype(float)
    # A turn and a shift of everything, but for one side.
    moved = np.stack([4 - 0.02 * (points[..., 1] - 40), 0.02 * (points[..., 0] - 40)], axis=-1)
    left = points[..., 0] < 15
    moved[left] *= 0.3
    expected = 1 - share[left].sum() / share.sum()
    assert stick_ratio(share, share, points, moved, NOISE) == pytest.approx(expected)
    assert stick_ratio(share, share, points, 0 * moved, NOISE) == 1
    assert stick_ratio(share, 0 * share, points, moved, NOISE) == 0


def test_another_contact_starts_anew_and_what_moves_against_the_drag_is_no_slip() -> None:
    steps = ((60, 0), (None, None), (80, 0), (72, 0), (64, 0), (80, 0), (90, 0), (98, 1))
    tracker = SlipTracker()
    for seq, (left, expected) in enumerate(steps):
        slip = step(tracker, seq, left)
        assert (None if slip is None else slip.slipping) == expected


def test_one_measurement_goes_on_while_the_outline_flickers() -> None:
    tracker = SlipTracker()
    for seq in range(12):
        slip = step(tracker, seq, 60 + 3 * seq, shown=0.5 + 0.5 * (seq % 2))
        assert slip.since == 0
        assert slip.slipping == (seq > 1)
    assert slip.translation == pytest.approx((33, 0), abs=0.5)
    assert slip.speed == pytest.approx(180, abs=5)
    assert slip.rotation == pytest.approx(0, abs=0.5)


def test_the_picture_of_another_object_starts_the_measurement_anew() -> None:
    tracker = SlipTracker()
    assert step(tracker, 0, 60) is not None
    slip = step(tracker, 1, 60, striped=True)
    assert (slip.since, slip.slipping, slip.speed) == (1, False, None)


def test_what_shows_another_side_and_springs_the_gel_within_a_frame_has_slipped() -> None:
    tracker = SlipTracker()
    for seq in range(8):
        assert not step(tracker, seq, 60, drag=8.0).slipping
    for seq, (slipping, kind) in ((8, (False, None)), (9, (True, "lost")), (10, (True, "lost"))):
        slip = step(tracker, seq, 60, striped=True)
        assert (slip.since, slip.slipping, slip.kind) == (0, slipping, kind)
    assert slip.onset == 8 / 60


def test_an_object_that_moves_by_118_px_in_a_frame_has_slipped_by_about_that_much() -> None:
    tracker = SlipTracker()
    reported = [step(tracker, seq, 10, drag=8.0).slipping for seq in range(8)]
    slips = [step(tracker, seq, 128) for seq in range(8, 12)]
    assert reported + [slip.slipping for slip in slips] == 9 * [False] + 3 * [True]
    error, stderr = slips[-1].translation[0] - 118, slips[-1].translation_stderr[0]
    assert abs(error) < 10
    assert 10 < stderr < 60


@pytest.mark.parametrize("drag", [3.0, 8.0])
def test_a_single_frame_with_another_picture_is_never_reported(drag: float) -> None:
    tracker = SlipTracker()
    for seq in range(40):
        odd = seq % 8 == 7
        slip = step(tracker, seq, 60, striped=odd, drag=drag if odd else 3.0)
        assert not slip.slipping
        assert (slip.since, slip.translation) == (0, pytest.approx((0, 0), abs=0.5)) or odd


def test_a_picture_that_changes_while_the_gel_rests_has_not_slipped() -> None:
    tracker = SlipTracker()
    assert not any(step(tracker, seq, 60, striped=seq > 9).slipping for seq in range(20))


def test_an_object_that_is_shaken_together_with_the_gel_does_not_slip() -> None:
    tracker = SlipTracker()
    for seq in range(60):
        shift = 12 * math.sin(seq / 3)
        slip = step(tracker, seq, round(60 + shift), drag=float(round(shift)))
        assert not slip.slipping


def test_an_object_that_creeps_is_told_from_one_that_slides() -> None:
    kinds = []
    for pixels in (1, 4):
        tracker = SlipTracker()
        slips = [step(tracker, seq, 60 + pixels * (seq // 3)) for seq in range(40)]
        kinds.append({slip.kind for slip in slips[12:]})
    assert kinds[0] <= {"creeping", None}
    assert "sliding" in kinds[1]


def test_markers_that_join_start_the_measurement_anew_and_are_no_slip() -> None:
    tracker = SlipTracker()
    for seq in range(10):
        slip = step(tracker, seq, 60, pitch=20.0 if seq < 8 else 18.0)
        assert (slip.since, slip.slipping) == (8 * (seq >= 8), False)


@pytest.mark.parametrize("spec", ["slide?frames=140", "scrape?frames=140", "spin?frames=140"])
def test_translation_and_rotation_are_right_and_their_errors_honest(spec: str) -> None:
    scene, start, misses = open_scene(spec), (np.zeros(2), 0.0), []
    for index, _, _, slip in judged(spec, range(14, 75)):
        press = scene.presses(index)[0]
        gel = np.array([[press.x, press.y]]) - press.shear
        place = MAPPING.to_processed(scene.camera.to_raw(gel))[0]
        turn = -math.degrees(press.angle - press.twist)
        if slip.since == index:
            start = place, turn
        away = np.array(slip.translation) - (place - start[0])
        turned = slip.rotation - (turn - start[1])
        stderr = np.array([*slip.translation_stderr, slip.rotation_stderr])
        misses.append(np.array([*away, turned]) / np.maximum(stderr, 0.1))
    assert np.hypot(*away) < 6
    assert abs(turned) < 3 or slip.rotation_stderr > 10
    assert np.mean(np.abs(misses) < 2) > 0.9


SHADE = np.random.default_rng(5).integers(20, 120, (60, 60), np.uint8)
STRIPES = np.tile(np.repeat(np.array([30, 110], np.uint8), 10), (60, 3))


def step(
    tracker: SlipTracker,
    seq: int,
    left: int | None,
    shown: float = 1.0,
    striped: bool = False,
    pitch: float = 20.0,
    drag: float = 3.0,
) -> Any:
    """Slip of a square with texture on gel that is dragged to the right; None where no pixel is in contact.

    shown : the part of it that the outline holds. pitch : of the markers, px. drag : of the gel, px."""
    x, y = np.meshgrid(np.arange(10.0, 200, pitch), np.arange(10.0, 200, pitch))
    origin = np.column_stack([x.ravel(), y.ravel()])
    count = len(origin)
    markers = Markers(origin, origin + np.array([drag, 0]), np.zeros(count, np.uint8), np.full(count, NOISE))
    field = FieldModel(origin, (200, 200))(markers)
    mask, picture = np.zeros((200, 200), np.uint8), np.zeros((200, 200, 3), np.uint8)
    if left is not None:
        shade = STRIPES if striped else cv2.GaussianBlur(SHADE, None, 4)
        picture[70:130, left : left + 60] = shade[..., None]
        mask[70:130, left : left + round(60 * shown)] = 255
    return tracker(seq, seq / 60, light_change(picture, cells(0 * picture), None), field, mask)
