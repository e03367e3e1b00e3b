"""`tactflow calibrate lens` and `--target`: lens, perspective and scale from pictures of a printed target."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from tactflow.api import load
from tactflow.calibration.collecting import collect
from tactflow.calibration.target import BENT, Target, find_target, fit_lens, scale_from_target
from tactflow.cli.terminal import say
from tactflow.engine.contract import Sink, StageParams
from tactflow.engine.errors import ConfigError
from tactflow.engine.graph import Pipeline
from tactflow.ports import Image
from tactflow.sources import open_source
from tactflow.vision.types import Scale


def add_target_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of a printed target."""
    parser.add_argument(
        "--target",
        metavar="PICTURE",
        help="scale from this raw picture of a printed target where the gel is, of --grid and --pitch",
    )
    parser.add_argument(
        "--grid",
        metavar="COLUMNSxROWS",
        help="of the target: inner corners of its checkerboard, or dots with --dots",
    )
    parser.add_argument("--dots", action="store_true", help="the target is a grid of dots")


class _First(Sink):
    """Keeps the first processed frame."""

    def __init__(self, params: StageParams) -> None:
        super().__init__(params)
        self.image: NDArray[np.uint8] | None = None

    def write(self, image: Image) -> None:
        """Look at one frame."""
        self.image = image if self.image is None else self.image


def target_of(args: argparse.Namespace) -> Target:
    """The target that the options describe. Raises ConfigError if they do not."""
    if args.grid is None or args.pitch is None:
        raise ConfigError("calibrate: a target needs --grid COLUMNSxROWS and --pitch MM")
    columns, _, rows = str(args.grid).lower().partition("x")
    if not (columns.isdecimal() and rows.isdecimal()):
        raise ConfigError(f"--grid: required COLUMNSxROWS, as in 9x6, got {args.grid}")
    return Target(int(columns), int(rows), args.pitch, args.dots)


def target_scale(args: argparse.Namespace, loaded: Pipeline) -> Scale:
    """Scale from `--target`, after the pipeline's own preprocess.

    Raises ConfigError or ValueError if no target is found.
    """
    target = target_of(args)
    pictured = load(loaded.file, source=args.target, sensor=args.sensor, settings={"calibration": None})
    first: Any = collect(pictured, _First, {}, {"image": "preprocess"})
    points = None if first.image is None else find_target(first.image, target)
    if points is None:
        raise ConfigError(_none_found(target, args.target))
    scale, bent = scale_from_target(points, target, (first.image.shape[1], first.image.shape[0]))
    if bent > BENT:
        say(
            f"the target is off a plane grid by {100 * bent:.1f} % of its pitch: one scale is not right for "
            "all of the picture; give preprocess the undistort and homography of `tactflow calibrate lens`"
        )
    return scale


def print_lens(args: argparse.Namespace, words: Sequence[str]) -> int:
    """Print `undistort` and `homography` for a pipeline file; returns the exit code.

    Raises ConfigError if there are too few pictures with the target.
    """
    if len(words) != 1:
        raise ConfigError("calibrate lens: required one folder, pattern or video with pictures of the target")
    target = target_of(args)
    views, size = _views(words[0], target)
    try:
        found = fit_lens(views, target, size)
    except ValueError as problem:
        raise ConfigError(f"calibrate {problem}") from None
    say(
        f"{len(views)} pictures: {found.rms:.2f} px RMS; focal lengths to {found.stderr[0]:.1f} and "
        f"{found.stderr[1]:.1f} px, centre to {found.stderr[2]:.1f} and {found.stderr[3]:.1f} px. For the "
        "parameters of preprocess:"
    )
    undistort = {
        "camera_matrix": np.round(found.lens.camera_matrix, 3).tolist(),
        "distortion": np.round(found.lens.distortion, 6).tolist(),
    }
    corners, places = (np.round(part, 2).tolist() for part in (found.corners, found.places))
    homography = {"from": corners, "to": places, "size": list(found.size)}
    print(yaml.safe_dump({"undistort": undistort, "homography": homography}, default_flow_style=None), end="")
    return 0


def _views(source: str, target: Target) -> tuple[list[NDArray[np.float64]], tuple[int, int]]:
    """The target in each picture that shows all of it, and (width, height) of the pictures."""
    reader = open_source(source)
    views, size = [], (0, 0)
    try:
        while (read := reader.read()) is not None:
            image = read[0]
            size = (image.shape[1], image.shape[0])
            points = find_target(image, target)
            views += [] if points is None else [points]
    except ValueError as problem:
        raise ConfigError(f"calibrate: {problem}") from None
    finally:
        reader.close()
    if not views:
        raise ConfigError(_none_found(target, source))
    return views, size


def _none_found(target: Target, source: str) -> str:
    kind = "dots" if target.dots else "inner corners of a checkerboard"
    return (
        f"calibrate: {source} does not show {target.columns} x {target.rows} {kind}; all of the target must "
        "be in the picture, and --grid counts " + ("dots" if target.dots else "corners between four squares")
    )
