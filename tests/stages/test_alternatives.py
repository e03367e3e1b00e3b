"""The usual alternatives to the built-in stages: they do the work, and answer honestly where they cannot."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import tactflow
from tactflow import Frame
from tactflow.calibration.file import small_picture
from tactflow.config.registry import resolve
from tactflow.engine.frame import Absent
from tactflow.sim import open_scene
from tactflow.vision.depth.slopes import SlopeModel
from tactflow.vision.geometry import Preprocessor
from tactflow.vision.types import MarkerStatus, Scale
from tests.calibrations import bare_calibration
from tests.vision.dots import grid, render

TRACKERS = ["lucas_kanade", "dis_flow", "rlof", "nearest_dots"]
MASKS = ["adaptive_threshold", "top_hat", "blob_detector"]
DETECTORS = ["mog2", "knn", "otsu", "ssim"]
HULLS = ["fit_line", "min_area_rect"]
DOTS = grid(6, 6, 30.0, corner=(25.0, 28.0), jitter=0.4)
Picture = NDArray[np.uint8]


def picture(points: NDArray[np.float64], seed: int = 0) -> Picture:
    return render((205, 210), points, 4.2, noise=1.0, seed=seed)


@pytest.mark.parametrize("name", ["depth", "frankot_chellappa"])
def test_heights_are_those_of_the_ball_that_has_these_slopes(name: str) -> None:
    # Of this sensor, two channels change in proportion to the horizontal part of the normal.
    coefficients = np.zeros((6, 19, 2))
    coefficients[0, 0, 0] = coefficients[0, 1, 1] = 1.0
    radius, rim, mm = 60.0, 24.0, 0.1
    y, x = np.mgrid[:160, :200] - np.array([80.0, 100.0])[:, None, None]
    away = np.minimum(np.hypot(x, y), rim)
    depth = mm * (np.sqrt(radius**2 - away**2) - np.sqrt(radius**2 - rim**2))
    normal = np.where(away < rim, 1, 0) / radius * np.stack([x, y])
    untouched = np.full((160, 200, 3), 100, np.uint8)
    pressed = untouched.copy()
    pressed[..., :2] = np.rint(100 + 120 * np.moveaxis(normal, 0, -1))
    mask = ((away < rim) * 255).astype(np.uint8)
    scale = Scale(mm, mm, (0.0, 0.0), (99.5, 79.5))
    parts = {"look": small_picture(untouched), "slopes": SlopeModel(coefficients)}
    calibration = bare_calibration((200, 160), scale, **parts)
    component = resolve(name, "stages")
    stage: Any = component.make(component.params(), calibration=calibration)
    found = stage.process(pressed, untouched, mask, calibration.scale)
    np.testing.assert_allclose(found.heights, depth, atol=0.03)
    assert found.greatest == pytest.approx(depth.max(), abs=0.03)


@pytest.mark.parametrize("name", TRACKERS)
def test_a_tracker_follows_every_dot_step_by_step(name: str) -> None:
    stage = tactflow.stage(name)
    stage.process(picture(DOTS))
    for step in range(1, 5):
        markers = stage.process(picture(DOTS + np.array([3.0, 1.5]) * step, seed=step))
    assert (markers.status == MarkerStatus.TRACKED).all()
    error = markers.displacement - np.array([12.0, 6.0])
    assert np.sqrt((error**2).sum(axis=1).mean()) < 0.6


@pytest.mark.parametrize("name", TRACKERS)
def test_a_dot_that_vanishes_is_lost_where_it_was_and_found_again(name: str) -> None:
    stage = tactflow.stage(name)
    stage.process(picture(DOTS))
    before = stage.process(picture(DOTS + 1.0, seed=1))
    hidden = int(np.linalg.norm(before.origin - DOTS[14], axis=1).argmin())
    covered = picture(np.delete(DOTS, 14, axis=0) + 1.5, seed=2)
    # Something of another brightness covers it: there is no dot, nor gel.
    x, y = np.rint(DOTS[14]).astype(int)
    covered[y - 14 : y + 15, x - 14 : x + 15] = np.random.default_rng(5).integers(90, 250, (29, 29, 1))
    lost = stage.process(covered)
    assert lost.status[hidden] == MarkerStatus.LOST
    np.testing.assert_array_equal(lost.position[hidden], before.position[hidden])
    assert np.isfinite(lost.position).all()
    found = stage.process(picture(DOTS + 2.0, seed=3))
    assert found.status[hidden] == MarkerStatus.TRACKED
    np.testing.assert_allclose(found.displacement[hidden], [2.0, 2.0], atol=0.6)


@pytest.mark.parametrize("name", TRACKERS)
def test_nothing_is_tracked_in_a_picture_without_dots(name: str) -> None:
    stage = tactflow.stage(name)
    first = stage.process(picture(DOTS))
    markers = stage.process(np.full_like(picture(DOTS), 128))
    assert (markers.status == MarkerStatus.LOST).all()
    np.testing.assert_array_equal(markers.position, first.position)


@pytest.mark.parametrize("name", TRACKERS)
def test_a_tracker_takes_a_new_reference_after_reset(name: str) -> None:
    stage = tactflow.stage(name)
    stage.process(picture(DOTS))
    stage.reset()
    markers = stage.process(picture(DOTS + 4.0, seed=1))
    np.testing.assert_allclose(markers.displacement, 0, atol=0.3)


@pytest.mark.parametrize(("name", "polarity"), list(product(MASKS, ["dark", "bright"])))
def test_a_mask_covers_the_dots_of_either_polarity_and_little_else(name: str, polarity: str) -> None:
    image = picture(DOTS)
    image = image if polarity == "dark" else np.asarray(255 - image, np.uint8)
    mask = tactflow.stage(name).process(image)
    x, y = np.rint(DOTS).astype(int).T
    assert (mask[y, x] == 255).all()
    away = np.hypot(*(np.indices(mask.shape)[::-1, None] - DOTS.T[..., None, None])).min(axis=0) > 9
    assert (mask[away] > 0).mean() < 0.002


@pytest.mark.parametrize("name", MASKS)
def test_a_gel_without_dots_has_an_empty_mask(name: str) -> None:
    gel = np.random.default_rng(0).normal(128, 2, (120, 160, 3)).astype(np.uint8)
    assert not tactflow.stage(name).process(gel).any()


def test_only_masked_pixels_are_filled_and_by_the_texture_around() -> None:
    y, x = np.indices((48, 64))
    texture = np.rint(128 + 30 * np.sin(x * np.pi / 4) + 0 * y).astype(np.uint8)
    image = np.stack([texture] * 3, axis=2)
    mask = np.zeros(texture.shape, np.uint8)
    mask[20:28, 30:38] = 255
    dotted = np.where(mask[..., None] > 0, 0, image).astype(np.uint8)
    stage = tactflow.stage("frequency_selective")
    filled = stage.process(dotted, mask)
    np.testing.assert_array_equal(filled[mask == 0], dotted[mask == 0])
    assert np.abs(filled[mask > 0].astype(int) - image[mask > 0]).mean() < 6
    for trivial in (np.zeros_like(mask), np.full_like(mask, 255)):
        np.testing.assert_array_equal(stage.process(dotted, trivial), dotted)


@pytest.fixture(scope="module")
def press() -> list[Picture]:
    """The untouched gel, the same with other noise, and a contact, without dots."""
    scene, preprocess = open_scene("unmarked?frames=40"), Preprocessor((800, 600), downsample=2)
    return [preprocess(scene.frame(index)).copy() for index in (0, 1, 20)]


def detect(stage: Any, image: Picture, seq: int, valid: Picture | None = None) -> Any:
    return stage.process(image, Frame("main", seq, seq / 30, image, reference=seq == 0), valid)


@pytest.mark.parametrize("name", DETECTORS)
def test_a_contact_is_found_at_its_place_and_none_at_rest(name: str, press: list[Picture]) -> None:
    stage, truth = (
        tactflow.stage(name),
        open_scene("unmarked?frames=40").truth(20, Preprocessor((800, 600), downsample=2)),
    )
    masks = [detect(stage, image, seq) for seq, image in enumerate([*press, press[1]])]
    assert [found.touching for found in masks] == [False, False, True, False]
    found = masks[2].contact_mask > 0
    # The change of the light reaches beyond the contact.
    assert (found & (truth.contact_mask > 0)).sum() > 0.3 * found.sum()


@pytest.mark.parametrize("name", DETECTORS)
def test_a_contact_that_lasts_stays_one_and_leaves_no_trace(name: str, press: list[Picture]) -> None:
    stage = tactflow.stage(name)
    detect(stage, press[0], 0)
    lasting = [detect(stage, press[2], seq) for seq in range(1, 30)]
    np.testing.assert_array_equal(lasting[-1].contact_mask, lasting[0].contact_mask)
    assert lasting[-1].touching
    assert not detect(stage, press[1], 30).touching


@pytest.mark.parametrize("name", DETECTORS)
def test_nothing_outside_of_the_gel_counts(name: str, press: list[Picture]) -> None:
    stage, valid = tactflow.stage(name), np.zeros(press[0].shape[:2], np.uint8)
    valid[:20] = 255
    assert [detect(stage, image, seq, valid).touching for seq, image in enumerate(press)] == [False] * 3


@pytest.mark.parametrize("name", DETECTORS)
def test_a_new_reference_replaces_the_old_one(name: str, press: list[Picture]) -> None:
    stage = tactflow.stage(name)
    assert not detect(stage, press[2], 0).touching
    stage.reset()
    assert not detect(stage, press[0], 0).touching
    assert detect(stage, press[2], 1).touching


def bar(angle: float, length: float = 60, width: float = 12) -> Picture:
    """A bar at an angle, degrees, counter-clockwise on the screen."""
    y, x = np.indices((120, 140))
    turn = np.deg2rad(angle)
    u = (x - 70) * np.cos(turn) - (y - 60) * np.sin(turn)
    v = (x - 70) * np.sin(turn) + (y - 60) * np.cos(turn)
    return np.where((abs(u) <= length / 2) & (abs(v) <= width / 2), 255, 0).astype(np.uint8)


@pytest.mark.parametrize(("name", "angle"), list(product(HULLS, [0.0, 30.0, 72.0, 90.0, -20.0, -65.0])))
def test_the_direction_of_a_bar_is_that_on_the_screen(name: str, angle: float) -> None:
    contact = tactflow.stage(name).process(bar(angle))
    assert abs((contact.angle - angle + 90) % 180 - 90) < 1.5
    np.testing.assert_allclose(contact.center, (70, 60), atol=0.7)
    assert contact.slope is None or contact.slope == pytest.approx(-np.tan(np.deg2rad(contact.angle)))


@pytest.mark.parametrize("name", HULLS)
def test_a_disc_has_no_direction_and_a_few_pixels_no_contact(name: str) -> None:
    y, x = np.indices((80, 80))
    disc = np.where(np.hypot(x - 40, y - 40) < 20, 255, 0).astype(np.uint8)
    assert tactflow.stage(name).process(disc).angle is None
    speck = np.zeros((80, 80), np.uint8)
    speck[10:12, 10:12] = 255
    assert isinstance(tactflow.stage(name).process(speck), Absent)
    smallest = tactflow.stage(name, min_area=0).process(speck)
    assert smallest.area == 4


def test_huber_is_moved_less_by_a_long_spur_than_least_squares() -> None:
    spur = bar(0.0)
    spur[20:54, 95:99] = 255
    l2, huber = (tactflow.stage("fit_line", distance=kind).process(spur) for kind in ("l2", "huber"))
    assert abs(huber.angle) < abs(l2.angle)


def test_the_median_flow_ignores_one_wrong_dot() -> None:
    origin = DOTS[:9].copy()
    moved = origin + np.array([2.0, 1.0])
    moved[4] += [20.0, 0.0]
    markers = tactflow.Markers(origin, moved, np.zeros(9, np.uint8), np.full(9, 0.01))
    mask = np.full((205, 210), 255, np.uint8)
    mean, median = (
        tactflow.stage("flow_in_mask", method=method).process(markers, mask) for method in ("mean", "median")
    )
    assert median.mean == pytest.approx((2.0, 1.0))
    assert mean.mean == pytest.approx((2 + 20 / 9, 1.0))
    assert median.stderr[0] > mean.stderr[0]
