from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from tactflow.bench.gels import GELS, GelJudge, measure_gels
from tactflow.bench.labels import (
    Label,
    labels_of,
    outlines_by_eye,
    touch_of,
)
from tactflow.bench.lockstep import TimedResult
from tactflow.bench.pipelines import Bench
from tactflow.bench.quantities import Tally
from tactflow.bench.results import BenchResult
from tactflow.bench.timing import CopyUnit
from tactflow.config.load import load_pipeline
from tactflow.config.shipped import find_pipeline
from tactflow.engine.frame import Frame
from tactflow.sim import open_scene
from tactflow.vision.geometry import Preprocessor
from tactflow.vision.types import Contact

SQUARE = np.array([(10, 10), (29, 10), (29, 29), (10, 29)], dtype=np.float64)


def contact(hull: np.ndarray, angle: float | None = None) -> Contact:
    x, y = hull.mean(axis=0)
    return Contact(400.0, (float(x), float(y)), angle, None, hull, None)


def test_the_overlap_is_that_of_the_filled_outline_and_the_hull() -> None:
    label, tally = Label((SQUARE,), center=(19.5, 19.5), angle=80.0), Tally()
    assert label.compare(tally, contact(SQUARE, -85.0), (60, 80)) == 1
    assert label.compare(tally, contact(SQUARE + np.array((10, 0))), (60, 80)) == pytest.approx(1 / 3)
    assert label.compare(tally, None, (60, 80)) == 0
    assert tally.errors() == {
        "outline_iou_p50": pytest.approx(1 / 3),
        "outline_iou_min": 0,
        "label_distance_p50": 5,
        "line_angle_p50": 15,
        "line_angle_max": 15,
    }


def test_outlines_are_scaled_to_the_frame_that_is_judged(tmp_path: Path) -> None:
    (tmp_path / "handmade_dots").mkdir()
    entry = {"rec": "handmade_dots", "frame": 3, "downsample": 2, "polygon": SQUARE.tolist()}
    (tmp_path / "polygons.json").write_text(json.dumps([entry]))
    drawn = outlines_by_eye(tmp_path)
    labels = labels_of(tmp_path / "handmade_dots" / "video.avi", tmp_path, 1, drawn)
    np.testing.assert_array_equal(labels[3].outlines[0], 2 * SQUARE)
    halved = labels_of(tmp_path / "handmade_dots" / "video.avi", tmp_path, 2, drawn)
    np.testing.assert_array_equal(halved[3].outlines[0], SQUARE)


def test_a_circle_and_an_edge_are_read_with_angles_that_grow_counter_clockwise(tmp_path: Path) -> None:
    edge = {"line_angle": 4.0, "rect1": SQUARE.tolist(), "rect2": (SQUARE + 5).tolist()}
    stored = {"001": {"center": [20, 30], "radius": 10}, "002": edge}
    (tmp_path / "labels.json").write_text(json.dumps(stored))
    labels = labels_of(tmp_path, tmp_path, 1, {})
    assert labels[1].center == (20, 30)
    # The pixels on the outline belong to it: half a pixel more on every side.
    assert np.count_nonzero(labels[1].mask((60, 60))) == pytest.approx(np.pi * 10.5**2, rel=0.05)
    assert labels[2].angle == -4


def test_the_outlines_of_the_bench_belong_to_known_recordings(tmp_path: Path) -> None:
    drawn = outlines_by_eye(tmp_path)
    assert {name.split("/")[0] for name in drawn} <= {gel.folder for gel in GELS}
    assert sum(len(frames) for frames in drawn.values()) > 80


def test_rest_and_touch_of_a_recording_are_read(tmp_path: Path) -> None:
    touch = touch_of(tmp_path / "franka_mini" / "ball_white_thread-1-0.avi", tmp_path)
    assert touch is not None
    assert touch.tolist() == [1] * 5 + [0] * 8 + [1] * 184
    assert touch_of(tmp_path / "sts_640" / "video.mp4", tmp_path) is not None
    assert touch_of(tmp_path / "mini_box", tmp_path) is None


def test_decisions_count_only_where_something_is_known() -> None:
    touched = np.array([1, 0, 0, -1, 1, 1, 1, 1, 1, 1], np.int8)
    tally = Tally()
    judge = GelJudge(GELS[0], {}, touched, tally)
    for found in (0, 1, 0, 1, 0, 0, 0, 0, 1, 1):
        frame = Frame("main", 5, 0.0, np.zeros((4, 4, 3), np.uint8))
        judge.add(TimedResult(frame, {"contact": contact(SQUARE)} if found else {}))
    judge.finish()
    assert tally.errors() == {"false_contacts": 50.0, "missed_contacts": pytest.approx(100 * 5 / 7)}


def test_simulated_balls_in_the_place_of_real_ones_are_measured_against_their_circles(tmp_path: Path) -> None:
    folder = tmp_path / "gels" / "mini_ball"
    folder.mkdir(parents=True)
    scene = open_scene("press?frames=60&noise=1")
    smaller = Preprocessor(scene.size, downsample=2)
    labels = {}
    for number, index in enumerate((0, 20, 25)):
        cv2.imwrite(str(folder / f"{number:03d}.png"), smaller(scene.frame(index)))
        truth = scene.truth(index, smaller)
        if truth.center is not None:
            radius = float(np.sqrt(truth.contact_mask.sum() / np.pi))
            labels[f"{number:03d}"] = {"center": truth.center, "radius": radius}
    (folder / "labels.json").write_text(json.dumps(labels))
    marked, bare = ((name, load_pipeline(find_pipeline(name))) for name in ("default", "markerless"))
    result, pictures = BenchResult(quick=True), tmp_path / "pictures"
    measure_gels(Bench(result, CopyUnit(), tmp_path, pictures), marked, bare, tmp_path)
    assert not result.failures
    (found,) = result.measured
    assert found.key == "pipeline/default/data:mini_ball"
    assert found.values["frames"] == 3
    assert found.errors["false_contacts"] == found.errors["missed_contacts"] == 0
    assert found.errors["outline_iou_min"] > 0.85
    assert found.errors["label_distance_p50"] < 1
    assert found.errors["dots_found"] == 100
    assert [path.name for path in pictures.iterdir()] == ["mini_ball-default.png"]
