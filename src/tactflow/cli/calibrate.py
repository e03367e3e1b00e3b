"""`tactflow calibrate`: make the calibration file of a sensor, add a force fit, or check it."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Any, Final

from tactflow.api import load
from tactflow.calibration.check import check, check_force
from tactflow.calibration.file import Calibration
from tactflow.calibration.guide import Guide
from tactflow.calibration.reference import read_reference
from tactflow.calibration.session import (
    ENOUGH_PRESSES,
    Method,
    Wish,
    find_presses,
    instruction,
    learn,
    watch,
)
from tactflow.calibration.words import core_words
from tactflow.cli.calibrate_force import add_force, check_loads
from tactflow.cli.calibrate_session import file_and_pipeline, load_uncalibrated, page_of, player
from tactflow.cli.options import add_overwrite, add_sensor, refuse_output
from tactflow.engine.errors import ConfigError, StageError
from tactflow.engine.graph import Pipeline
from tactflow.system.arguments import number, positive
from tactflow.system.terminal import notes, say, show, typed

# Gels and balls have 1 to 100.
_millimetres = number(float, 1e-3, 1e4, "millimetres from 0.001 to 10000")


OPTIONS: Final[Mapping[str, Mapping[str, Any]]] = {
    "--out": {"type": Path, "metavar": "FILE", "help": "default: calibration/SENSOR.yaml"},
    "--realtime": {"action": "store_true", "help": "play a recording at its own pace, like a camera"},
    "--pitch": {
        "type": _millimetres,
        "metavar": "MM",
        "help": "spacing of the gel's dots, which form a square grid",
    },
    "--area": {
        "type": _millimetres,
        "nargs": 2,
        "metavar": ("WIDTH", "HEIGHT"),
        "help": "size of the whole processed picture, mm, if the gel has no dots of known pitch",
    },
    "--ball-radius": {
        "type": _millimetres,
        "metavar": "MM",
        "help": "radius of the ball; without it, only the scale is calibrated",
    },
    "--gel-thickness": {
        "type": _millimetres,
        "metavar": "MM",
        "help": "thickness of the gel: no depth exceeds it",
    },
    "--presses": {
        "type": positive,
        "metavar": "N",
        "help": f"end a live session after N presses ({ENOUGH_PRESSES['slopes']}; with --refine "
        f"{ENOUGH_PRESSES['refine']}, with --darkness, or to check such a file, "
        f"{ENOUGH_PRESSES['darkness']})",
    },
    "--view": {"action": "store_true", "help": "show the live page, which says where to press next"},
    "--refine": {
        "action": "store_true",
        "help": "start from the pipeline's calibration, such as the default of a kind of sensor, and adapt "
        "it to this sensor by one or more presses of the ball; the scale is kept unless --pitch or --area is "
        "given. Slopes are also fitted from scratch, and the better of the two is kept",
    },
    "--darkness": {
        "action": "store_true",
        "help": "fit depth to the darkening of the gel, for sensors in white light such as 9DTact; one press "
        "of the ball is enough",
    },
    "--csv": {
        "type": Path,
        "metavar": "FILE",
        "help": "for force and check: readings of the gauge, if not beside the recording; columns t (s) or "
        "frame, fz (N), and optionally fx and fy",
    },
    "--weights": {
        "nargs": "*",
        "metavar": "G",
        "help": "for force and check: weights, g, that are put on the gel one after the other in this order, "
        "or a CSV of them with a column g, kg or fz; without any, the readings of a scale are asked for",
    },
    "--like": {
        "type": Path,
        "metavar": "FILE",
        "help": "for force --weights: take the force of this calibration, of another sensor of the same "
        "kind, and fit one factor to two weights or more",
    },
    "--offset": {
        "type": float,
        "metavar": "S",
        "help": "for force: add this to the times of the CSV; up to 2 s more are estimated",
    },
}
"""Option -> its settings for argparse."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `calibrate`, before and after each of its verbs."""
    _add_options(parser)
    parser.set_defaults(calibrate=_make, words=[], offset=0.0)
    verbs = parser.add_subparsers(
        action=_Verbs,
        title="what to do",
        metavar="PIPELINE | check FILE [PIPELINE] | force FILE [PIPELINE]",
        required=False,
    )
    for name, (command, words, text, options) in VERBS.items():
        # An option that is not given here keeps its value from before the verb.
        verb = verbs.add_parser(
            name, help=text, description=text, allow_abbrev=False, argument_default=argparse.SUPPRESS
        )
        verb.add_argument("words", nargs="*", metavar=words, help=WORDS[words])
        _add_options(verb, options)
        verb.set_defaults(calibrate=command)


def _add_options(parser: argparse.ArgumentParser, shown: Sequence[str] = tuple(OPTIONS)) -> None:
    """Declare all options. shown : those that `--help` explains; the others have no effect."""
    parser.add_argument(
        "--source",
        "--from",
        dest="source",
        metavar="SRC",
        help="as in 'tactflow run': a camera, a recording or a folder of pictures, first of the untouched "
        "gel, then of presses of the ball. For force, a recording with a CSV of the same name beside it, or "
        "a folder of them",
    )
    add_sensor(parser)
    add_overwrite(parser)
    for name, settings in OPTIONS.items():
        parser.add_argument(name, **(settings if name in shown else {**settings, "help": argparse.SUPPRESS}))


class _Verbs(argparse._SubParsersAction):  # type: ignore[type-arg]
    """Subcommands, of which the first is the default."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        # Any other word is a pipeline.
        self.choices = None  # type: ignore[assignment]

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: str | Sequence[Any] | None,
        option_string: str | None = None,
    ) -> None:
        words = list(values or ())
        if words[0] not in VERBS:
            words.insert(0, next(iter(VERBS)))
        super().__call__(parser, namespace, words, option_string)


def run(args: argparse.Namespace) -> int:
    """Make or check a calibration; returns the exit code: of a check 3 where it does not fit.

    Raises
    ------
    TactflowError
        If options are wrong, or the recording gives no calibration.
    """
    with notes():
        return int(args.calibrate(args))


def _make(args: argparse.Namespace) -> int:
    """Calibrate the sensor of a pipeline."""
    if len(args.words) > 1:
        raise ConfigError(f"calibrate: required one pipeline, got {', '.join(args.words)}")
    (pipeline,) = args.words or [None]
    if args.darkness and args.refine:
        raise ConfigError("calibrate --darkness: required --ball-radius MM, and not --refine")
    method: Method = "darkness" if args.darkness else "refine" if args.refine else "slopes"
    wish = Wish(args.pitch, args.area, args.ball_radius, method, args.gel_thickness)
    base = _base(args, pipeline)
    loaded = load_uncalibrated(args, pipeline)
    out = args.out or Path("calibration") / f"{loaded.sensor}.yaml"
    refuse_output("--out", out, overwrite=args.overwrite, suffixes=(".yaml",))
    presses = args.presses or ENOUGH_PRESSES[method]
    say(instruction(args.ball_radius, presses))
    guide = Guide(presses, say)
    page = page_of(args, pipeline, guide) if args.view else {}
    session = find_presses(player(loaded, page), None if args.ball_radius is None else guide)
    made_from = str(args.source or loaded.source.params.model_dump().get("source", ""))
    learned = learn(session, wish, base, say, sensor=loaded.sensor, made_from=made_from)
    learned.save(out)
    _compare_core(learned, loaded)
    say(
        f"{out} is written. To use it, add to the pipeline file: calibration: {out}\n"
        f"or to the command: {typed('--set', f'calibration={out}')}"
    )
    return 0


def _compare_core(learned: Calibration, pipeline: Pipeline) -> None:
    """Say how the cores of the contacts compare with the ball, if its presses have told."""
    ratio = None if learned.photometric is None else learned.photometric.core_ratio
    cores = [node.params.core for node in pipeline.nodes.values() if hasattr(node.params, "core")]
    if ratio is not None and cores:
        say(core_words(ratio, cores[0]))


def _base(args: argparse.Namespace, pipeline: str | None) -> Calibration | None:
    """The calibration of the pipeline, which --refine starts from; None without one, or without a ball."""
    if args.ball_radius is None:
        return None
    # Without --refine it only helps to judge; the pipeline may name a file that is yet to be made.
    with nullcontext() if args.refine else suppress(ConfigError):
        path = load(pipeline, source=args.source, sensor=args.sensor).calibration
        if path is not None:
            return Calibration.load(path)
    return None


def _check(args: argparse.Namespace) -> int:
    """Test how well a calibration still fits."""
    path, pipeline = file_and_pipeline(args, "check")
    calibration = Calibration.load(path)
    if args.weights is not None:
        return check_loads(args, path, pipeline, calibration)
    pressed = calibration.photometric or calibration.darkness
    presses = args.presses or ENOUGH_PRESSES["slopes" if calibration.darkness is None else "darkness"]
    say(instruction(None if pressed is None else pressed.ball_radius, presses))
    guide = None if pressed is None else Guide(presses, say)
    session = find_presses(player(load_uncalibrated(args, pipeline)), guide)

    if (misfit := calibration.misfit(session.mapping)) is not None:
        show([f"does not fit: {misfit}; use the pipeline that it was made with, or calibrate again"])
        return StageError.exit_code
    fits, lines = check(calibration, session)
    show(lines)
    if args.csv is not None:
        if calibration.force is None:
            raise ConfigError(f"calibrate check: {path} has no force that --csv could be compared with")
        watched = watch(player(load_uncalibrated(args, pipeline)), path)
        force_fits, lines = check_force(
            calibration.force,
            calibration.field_force,
            watched,
            read_reference(args.csv, args.source or "").later(args.offset),
        )
        show(lines)
        fits = fits and force_fits
    show(["it still fits" if fits else "it does not fit; unless a reason above applies, calibrate again"])
    return 0 if fits else StageError.exit_code


VERBS: Final[Mapping[str, tuple[Callable[[argparse.Namespace], int], str, str, Sequence[str]]]] = {
    "make": (
        _make,
        "PIPELINE",
        "calibrate the sensor of a pipeline; the word make can be left out",
        [name for name in OPTIONS if name not in ("--csv", "--offset", "--weights", "--like")],
    ),
    "check": (
        _check,
        "FILE [PIPELINE]",
        "test how well a calibration still fits",
        ("--realtime", "--presses", "--csv", "--offset", "--weights", "--view"),
    ),
    "force": (
        add_force,
        "FILE [PIPELINE]",
        "fit the force, and add it to a calibration",
        ("--realtime", "--csv", "--offset", "--weights", "--like", "--view"),
    ),
}
"""Verb -> what it does, its words, its description, and the options that matter to it."""
WORDS: Final = {
    "PIPELINE": "default: ./pipeline.yaml, else the packaged one",
    "FILE [PIPELINE]": "the calibration file; the pipeline as in 'tactflow run'",
}
"""Words of a verb -> their description."""
