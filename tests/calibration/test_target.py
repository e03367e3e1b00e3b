"""Lens, perspective and scale from a printed target, against the camera that has seen it."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from numpy.typing import NDArray

from tactflow.calibration.target import Target, find_target, fit_lens, scale_from_target
from tactflow.cli.main import main
from tactflow.vision.geometry.homography import find_homography, project
from tactflow.vision.geometry.lens import Lens

TARGET = Target(7, 5, 2.0)
LENS = Lens(np.array([[300.0, 0, 165], [0, 305, 117], [0, 0, 1]]), np.array([-0.25, 0.08, 0, 0, 0]))
SIZE = (320, 240)
TURNS = (
    (0, 0, 0.05),
    (0.4, 0, 0),
    (-0.4, 0.1, 0),
    (0, 0.4, 0.1),
    (0, -0.4, 0),
    (0.3, 0.3, 0.2),
    (-0.3, 0.3, 0),
)
AWAY = np.array([-6.0, -4.0, 20.0])
"""Where the first point of the target is, from the camera, mm."""


@lru_cache
def picture(turn: tuple[float, float, float], dots: bool = False) -> NDArray[np.uint8]:
    """A target as the camera sees it: each of 2 x 2 samples of a pixel asks which part of it it shows."""
    matrix = cv2.Rodrigues(np.array(turn, float))[0]
    x, y = np.meshgrid(*(np.arange(2 * side) / 2 - 0.25 for side in SIZE))
    points = np.stack([x.ravel(), y.ravel()], axis=1)
    flat = cv2.undistortPoints(points[:, None], LENS.camera_matrix, LENS.distortion)[:, 0]
    rays = np.column_stack([flat, np.ones(len(flat))]) @ matrix
    start = -AWAY @ matrix
    u, v, _ = (start - rays * (start[2] / rays[:, 2:])).T / TARGET.pitch
    margin = 0.5 if dots else 1.0
    right, low = TARGET.columns - 1 + margin, TARGET.rows - 1 + margin
    inside = (u > -margin) & (u < right) & (v > -margin) & (v < low)
    printed = np.hypot(u - np.rint(u), v - np.rint(v)) < 0.25
    dark = inside & (printed if dots else (np.floor(u) + np.floor(v)) % 2 == 0)
    grey = np.where(dark, 40, 200).astype(np.uint8).reshape(2 * SIZE[1], 2 * SIZE[0])
    return cv2.merge([cv2.resize(grey, SIZE, interpolation=cv2.INTER_AREA)] * 3)


def views() -> list[NDArray[np.float64]]:
    found = [find_target(picture(turn), TARGET) for turn in TURNS]
    return [points for points in found if points is not None]


def test_the_lens_comes_out_within_its_stated_errors_and_the_target_square() -> None:
    seen = views()
    assert len(seen) == len(TURNS)
    found = fit_lens(seen, TARGET, SIZE)
    assert found.rms < 0.1
    focal = np.array([LENS.camera_matrix[k, m] for k, m in ((0, 0), (1, 1), (0, 2), (1, 2))])
    ours = np.array([found.lens.camera_matrix[k, m] for k, m in ((0, 0), (1, 1), (0, 2), (1, 2))])
    assert (np.abs(ours - focal) < 4 * found.stderr + 0.5).all()
    straight = found.lens.undistort(seen[0])
    flat = LENS.undistort(seen[0])
    assert np.abs(straight - flat).max() < 0.5
    rectified = project(find_homography(found.corners, found.places), straight)
    _, bent = scale_from_target(rectified, TARGET, found.size)
    assert bent < 0.005


@pytest.mark.parametrize("dots", [False, True])
def test_a_target_in_the_plane_of_the_gel_gives_the_scale_however_it_lies(dots: bool) -> None:
    target = Target(TARGET.columns, TARGET.rows, TARGET.pitch, dots)
    rectified = cv2.undistort(picture((0, 0, 0.3), dots), LENS.camera_matrix, LENS.distortion)
    points = find_target(np.asarray(rectified, np.uint8), target)
    assert points is not None
    scale, bent = scale_from_target(points, target, SIZE)
    assert scale.x == pytest.approx(20 / 300, rel=0.002)
    assert scale.y == pytest.approx(20 / 305, rel=0.002)
    assert bent < 0.01
    tilted = find_target(picture((0.5, 0, 0), dots), target)
    assert tilted is not None
    assert scale_from_target(tilted, target, SIZE)[1] > 0.02


def test_the_standard_error_of_a_scale_by_a_target_is_honest() -> None:
    rng, off = np.random.default_rng(1), []
    for _ in range(300):
        scale, _ = scale_from_target(TARGET.places * 10 + rng.normal(0, 0.3, (35, 2)), TARGET, SIZE)
        off += [(scale.x - 0.1) / scale.stderr[0], (scale.y - 0.1) / scale.stderr[1]]
    assert 0.61 <= np.mean(np.abs(off) < 1) <= 0.75
    assert 0.91 <= np.mean(np.abs(off) < 2) <= 0.99


def test_the_command_prints_what_a_pipeline_takes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for number, turn in enumerate(TURNS):
        cv2.imwrite(str(tmp_path / f"{number}.png"), picture(turn))
    assert main(["calibrate", "lens", str(tmp_path), "--grid", "7x5", "--pitch", "2"]) == 0
    told = yaml.safe_load(capsys.readouterr().out)
    settings = [f"stages.preprocess.{key}={yaml.safe_dump(value)}" for key, value in told.items()]
    words = ["--set", settings[0], "--set", settings[1], "--set", "stages.preprocess.rotate=0"]
    assert main(["check", "markerless", *words]) == 0
    (tmp_path / "blank").mkdir()
    cv2.imwrite(str(tmp_path / "blank" / "0.png"), np.full((48, 64, 3), 99, np.uint8))
    for options, said in (
        (["--grid", "7x5", "--pitch", "2"], "does not show 7 x 5 inner corners"),
        (["--grid", "seven", "--pitch", "2"], "required COLUMNSxROWS"),
        (["--grid", "7x5"], "needs --grid COLUMNSxROWS and --pitch MM"),
        (["--grid", "2x5", "--pitch", "2"], "3 columns and rows or more"),
    ):
        capsys.readouterr()
        assert main(["calibrate", "lens", str(tmp_path / "blank"), *options]) == 2
        assert said in capsys.readouterr().err


def test_too_few_views_for_a_lens_are_refused() -> None:
    with pytest.raises(ValueError, match="required 6 pictures with the whole target or more"):
        fit_lens([TARGET.places] * 3, TARGET, SIZE)
