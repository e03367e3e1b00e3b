"""`tactflow calibrate force` and `check --weights`: newtons from a gauge, weights or another sensor."""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path

from tactflow.calibration.file import Calibration
from tactflow.calibration.force_samples import Watched
from tactflow.calibration.known_loads import FEWEST_LOADS_TO_CARRY, at_rest_of, carry, gain
from tactflow.calibration.reference import recordings_with_csv
from tactflow.calibration.session import learn_force, learn_weights, watch, weigh
from tactflow.calibration.weights import FEWEST_LOADS, Weighed, WeightGuide, read_weights
from tactflow.calibration.words import gain_words
from tactflow.cli.calibrate_session import file_and_pipeline, load_uncalibrated, page_of, player
from tactflow.engine.errors import ConfigError, StageError
from tactflow.system.terminal import say, show


def add_force(args: argparse.Namespace) -> int:
    """Fit the force and write it into the calibration file."""
    path, pipeline = file_and_pipeline(args, "force")
    calibration = Calibration.load(path)
    if calibration.force is not None and not args.overwrite:
        raise ConfigError(f"calibrate force: {path} has a force already; give --overwrite to replace it")
    if args.weights is not None:
        _force_by_weights(args, path, pipeline, calibration).save(path)
        say(f"the force is added to {path}")
        return 0
    if args.like is not None:
        raise ConfigError("calibrate force --like: required --weights, two or more that are put on the gel")
    if args.source is None:
        raise ConfigError(
            "calibrate force: required --source, a recording with a CSV of the same name beside it"
        )
    gauges = {args.source: args.csv} if args.csv else recordings_with_csv(args.source)

    def watched(source: str) -> Watched:
        return watch(player(load_uncalibrated(args, pipeline, source=source)), path)

    learn_force(calibration, gauges, watched, args.offset, say).save(path)
    say(f"the force is added to {path}")
    return 0


def _force_by_weights(
    args: argparse.Namespace, path: Path, pipeline: str | None, calibration: Calibration
) -> Calibration:
    """The calibration with a force that is fitted to known weights, or carried from another sensor."""
    if args.like is None:
        weighed = _weigh(args, path, pipeline, FEWEST_LOADS, fits=True)
        return learn_weights(calibration, weighed, str(args.source or "live"), say)
    other = Calibration.load(args.like)
    _require_force(other, args.like)
    weighed = _weigh(args, path, pipeline, FEWEST_LOADS_TO_CARRY)
    other = at_rest_of(weighed, other)
    found = gain(other, weighed)
    say(gain_words(found, str(args.like)))
    return carry(calibration, other, found)


def _require_force(calibration: Calibration, path: Path) -> None:
    """Raise ConfigError if a calibration has no force part. path : of it."""
    if calibration.force is None:
        raise ConfigError(f"calibrate --weights: {path} has no force; add it with `tactflow calibrate force`")


def _weigh(
    args: argparse.Namespace, path: Path, pipeline: str | None, fewest: int, fits: bool = False
) -> Weighed:
    """The loads of a session. path : of the calibration, for the scale. fewest : loads that are needed.
    fits : see `WeightGuide`."""
    if args.csv is not None:
        raise ConfigError("calibrate: --weights and --csv both give the forces; leave one of them out")
    forces = read_weights(args.weights)
    if 0 < len(forces) < fewest:
        raise ConfigError(f"calibrate --weights: required {fewest} weights or more, got {len(forces)}")
    if not forces and not sys.stdin.isatty():
        raise ConfigError("calibrate --weights: required the weights in g, as nobody can be asked for them")
    guide = WeightGuide(forces, say, fits)
    page = page_of(args, pipeline, guide) if args.view else {}
    weigh(player(load_uncalibrated(args, pipeline), page), path, guide)
    return guide.finish(_reading)


def _reading(time: float) -> float:
    """The force of a load, N, by the reading of a scale; NaN without one."""
    while True:
        try:
            answer = input(f"reading of the scale at {time:.1f} s, g (Enter leaves this load out): ").strip()
        except EOFError:
            return math.nan
        if not answer:
            return math.nan
        try:
            (force,) = read_weights([answer])
        except ConfigError as problem:
            say(str(problem))
        else:
            return force


def check_loads(args: argparse.Namespace, path: Path, pipeline: str | None, calibration: Calibration) -> int:
    """Compare the force with known loads; with --overwrite, results tell from then on."""
    _require_force(calibration, path)
    found = gain(calibration, _weigh(args, path, pipeline, fewest=1))
    show([gain_words(found, str(path))])
    fits = found.is_one
    if args.overwrite and calibration.force is not None:
        drift = 0.0 if fits else abs(found.value - 1)
        force = calibration.force.model_copy(update={"drift": drift})
        calibration.model_copy(update={"force": force}).save(path)
        show([f"{path}: standard errors of the force are {'as fitted' if fits else 'wider by as much'}"])
    elif not fits:
        show(["with --overwrite, the standard errors of results become wider by as much"])
    show(["it still fits" if fits else "it does not fit; calibrate the force again"])
    return 0 if fits else StageError.exit_code
