"""`tactflow calibrate`: make the calibration file of a sensor, add a force fit, or check it."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Mapping
from contextlib import nullcontext, suppress
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

from tactflow.api import Settings, ended_by_signals, load, make_runner
from tactflow.calibration import force, presses
from tactflow.calibration.darkness import Darkness, darkness_error, fit_darkness
from tactflow.calibration.file import (
    UNLIKE,
    Calibration,
    DarknessEntry,
    ForceEntry,
    LinearForceEntry,
    PhotometricEntry,
    ScaleEntry,
    raw_corners,
    small_picture,
)
from tactflow.calibration.guide import Guide
from tactflow.calibration.judgement import doubt
from tactflow.calibration.photometric import Photometry, fit_photometry
from tactflow.calibration.presses import PressFinder, Session
from tactflow.calibration.reference import Reference, read_reference, recordings_with_csv
from tactflow.calibration.refine import apparent_radius, refine_photometry
from tactflow.calibration.samples import press_errors, summary
from tactflow.calibration.scale import scale_from_area, scale_from_pitch
from tactflow.cli.options import add_overwrite, add_sensor, refuse_output
from tactflow.engine.collect import with_collector
from tactflow.engine.errors import ConfigError, TactflowError
from tactflow.engine.graph import Node, Pipeline
from tactflow.engine.run import Runner
from tactflow.message.result import Result
from tactflow.system.arguments import number, positive
from tactflow.system.signals import INTERRUPTED, Interrupted
from tactflow.system.terminal import notes, say, show, typed
from tactflow.vision.types import Scale

WORSE: Final = 1.5
"""Ratio of the error on new presses to the stored one above which a calibration counts as drifted."""
LOOSE: Final = 0.02
"""Relative error of a scale by pitch above which a better method is advised: grids of the simulator have less
than 0.01, the rings of a TacTip 0.1 to 0.15."""
ENOUGH: Final = {"slopes": 30, "refine": 9, "darkness": 1}
"""Number of presses that ends a live session, by the fit. With 9, a refined default has the errors of a
calibration of its own on two Minis; one curve of darkness holds all over the gel."""
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
    "--presses": {
        "type": positive,
        "metavar": "N",
        "help": f"end a live session after N presses ({ENOUGH['slopes']}; with --refine {ENOUGH['refine']}, "
        f"with --darkness, or to check such a file, {ENOUGH['darkness']})",
    },
    "--view": {"action": "store_true", "help": "show the live page, which says where to press next"},
    "--refine": {
        "action": "store_true",
        "help": "start from the pipeline's calibration, such as the default of a kind of sensor, and adapt "
        "it to this sensor by one or more presses of the ball; the scale is kept unless --pitch or --area is "
        "given",
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
    "--offset": {
        "type": float,
        "default": 0.0,
        "metavar": "S",
        "help": "for force: add this to the times of the CSV; up to 2 s more are estimated",
    },
}
"""Option -> its settings for argparse."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `calibrate`."""
    parser.add_argument(
        "what",
        nargs="*",
        metavar="PIPELINE | check FILE [PIPELINE] | force FILE [PIPELINE]",
        help="PIPELINE: calibrate the sensor of this pipeline (default: ./pipeline.yaml, else the packaged "
        "one). check: test how well a calibration still fits. force: fit the force, and add it to a "
        "calibration",
    )
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
        parser.add_argument(name, **settings)


def run(args: argparse.Namespace) -> int:
    """Make or check a calibration; returns the exit code: of a check 3 where it does not fit.

    Raises
    ------
    TactflowError
        If options are wrong, or the recording gives no calibration.
    """
    verb, *words = args.what if args.what[:1] in (["check"], ["force"]) else ["make", *args.what]
    with notes():
        if verb == "make":
            if len(words) > 1:
                raise ConfigError(f"calibrate: required one pipeline, got {', '.join(words)}")
            return _make(args, *words)
        if len(words) not in (1, 2):
            raise ConfigError(f"calibrate {verb}: required a calibration file, and a pipeline if wanted")
        command = _check if verb == "check" else _add_force
        return command(args, Path(words[0]), *words[1:])


def _make(args: argparse.Namespace, pipeline: str | None = None) -> int:
    ways = [args.pitch, args.area].count(None)
    if ways == 0 or (ways == 2 and not args.refine):
        raise ConfigError("calibrate: required one of --pitch MM and --area WIDTH HEIGHT, for the scale")
    if args.darkness and (args.refine or args.ball_radius is None):
        raise ConfigError("calibrate --darkness: required --ball-radius MM, and not --refine")
    args.presses = (
        args.presses or ENOUGH["darkness" if args.darkness else "refine" if args.refine else "slopes"]
    )
    base = _base(args, pipeline)
    loaded = _load(args, pipeline)
    out = args.out or Path("calibration") / f"{loaded.sensor}.yaml"
    refuse_output("--out", out, overwrite=args.overwrite, suffixes=(".yaml",))
    _instruct(args, args.ball_radius)
    guide = Guide(args.presses, say)
    page = _page(args, pipeline, guide) if args.view else {}
    session = _find_presses(loaded, None if args.ball_radius is None else guide, page)
    _learned(args, loaded, session, base).save(out)
    say(
        f"{out} is written. To use it, add to the pipeline file: calibration: {out}\n"
        f"or to the command: {typed('--set', f'calibration={out}')}"
    )
    return 0


def _base(args: argparse.Namespace, pipeline: str | None) -> Calibration | None:
    """The calibration of the pipeline, which --refine starts from; None without one, or without a ball."""
    if args.ball_radius is None:
        if args.refine:
            raise ConfigError("calibrate --refine: required --ball-radius MM, of the ball that is pressed")
        return None
    # Without --refine it only helps to judge; the pipeline may name a file that is yet to be made.
    with nullcontext() if args.refine else suppress(ConfigError):
        path = load(pipeline, source=args.source, sensor=args.sensor).calibration
        if path is not None:
            return Calibration.load(path)
    if args.refine:
        raise ConfigError(
            "calibrate --refine: required a pipeline with a calibration, such as mini, mini_plain or digit"
        )
    return None


def _learned(
    args: argparse.Namespace, loaded: Pipeline, session: Session, base: Calibration | None
) -> Calibration:
    """The calibration that a session gives. base : of the pipeline, or None.

    Raises ConfigError if it gives none.
    """
    if base is not None and (misfit := base.misfit(session.mapping)) is not None:
        if args.refine:
            raise ConfigError(f"calibrate --refine: the calibration of the pipeline does not fit: {misfit}")
        base = None
    scale, found_by = _scale(args, session, base if args.refine else None)
    say(
        f"scale: {scale.x:.5f} +- {scale.stderr[0]:.5f} mm per px in x, "
        f"{scale.y:.5f} +- {scale.stderr[1]:.5f} in y"
    )
    error = max(scale.stderr[0] / scale.x, scale.stderr[1] / scale.y)
    if args.pitch is not None and error > LOOSE:
        say(
            f"that is an error of {100 * error:.1f} %: --pitch is for dots in a square grid; these are "
            "not, or the picture is stretched. Use --area WIDTH HEIGHT, the size of the whole picture"
        )
    learned: dict[str, Any] = {}
    if args.ball_radius is not None:
        say(f"{len(session.presses)} presses; learning from them ...")
        learned = _depth(args, session, scale, base)
    return Calibration(
        sensor=loaded.sensor,
        made_from=str(args.source or loaded.source.params.model_dump().get("source", "")),
        raw_size=session.mapping.raw_size,
        size=session.mapping.size,
        corners=raw_corners(session.mapping),
        scale=ScaleEntry.of(scale, found_by),
        look=small_picture(session.untouched),
        **learned,
    )


def _depth(
    args: argparse.Namespace, session: Session, scale: Scale, base: Calibration | None
) -> dict[str, Any]:
    """The fit of the depth, as fields of `Calibration`. base : of the pipeline, or None."""
    radius, apparent = args.ball_radius, None
    fitted: Darkness | Photometry
    if args.darkness:
        fitted = fit_darkness(session, scale, radius)
        fields: dict[str, Any] = {"darkness": fitted.found}
        words, rejected = _darkness_words(fitted.found), "too small, or larger than the ball"
    else:
        if base is not None and base.slopes is not None:
            apparent = apparent_radius(session, scale, radius, base)
        if args.refine and base is not None:
            fitted = refine_photometry(session, scale, radius, base)
        else:
            fitted = fit_photometry(session, scale, radius)
        fields = {"photometric": fitted.found, "slopes": fitted.model, "information": fitted.information}
        words, rejected = _photometric_words(fitted.found.model_dump()), "{:.0f} degrees off a ball's surface"
    if (question := doubt(session, scale, radius, apparent)) is not None:
        say(question)
    for press, kept, misfit in zip(session.presses, fitted.kept, fitted.misfit, strict=True):
        if not kept:
            say(f"the press of frame {press.seq} is left out: {rejected.format(misfit)}")
    say(words)
    return fields


def _check(args: argparse.Namespace, path: Path, pipeline: str | None = None) -> int:
    calibration = Calibration.load(path)
    pressed = calibration.photometric or calibration.darkness
    args.presses = args.presses or ENOUGH["slopes" if calibration.darkness is None else "darkness"]
    _instruct(args, None if pressed is None else pressed.ball_radius)
    guide = None if pressed is None else Guide(args.presses, say)
    session = _find_presses(_load(args, pipeline), guide)
    misfit = calibration.misfit(session.mapping)
    if misfit is not None:
        show([f"does not fit: {misfit}; use the pipeline that it was made with, or calibrate again"])
        return 3
    unlike = calibration.unlikeness(session.untouched)
    limit = f"up to {100 * UNLIKE:.0f} % fits"
    show([f"untouched gel: differs by {100 * unlike:.1f} % of its brightness; {limit}"])
    fits = [unlike <= UNLIKE]
    if unlike > UNLIKE:
        show(["another sensor or light, or an object on the gel at the start, also make it differ"])
    if pressed is not None:
        fits.append(_check_depth(calibration, pressed, session))
    if args.csv is not None:
        fits.append(_check_force(args, path, calibration.force, pipeline))
    show(
        ["it still fits" if all(fits) else "it does not fit; unless a reason above applies, calibrate again"]
    )
    return 0 if all(fits) else 3


def _check_depth(calibration: Calibration, then: PhotometricEntry | DarknessEntry, session: Session) -> bool:
    """Print how well a calibration fits the presses of today; True where there are none."""
    radius, scale = f"{then.ball_radius:g} mm", calibration.scale
    if not session.presses:
        show([f"no presses today: to check the depth, press a ball of radius {radius} on the untouched gel"])
        return True
    if isinstance(then, DarknessEntry):
        error, limit, unit = darkness_error(session, then, scale), WORSE * then.stderr, "mm RMS"
        now_words = f"depth {error:.3f} mm RMS off" if math.isfinite(error) else "none can be used"
        words = now_words, _darkness_words(then)
    else:
        assert calibration.slopes is not None
        now = summary(press_errors(session, calibration.slopes, scale, then.ball_radius))
        error, limit, unit = now["normal_error"], WORSE * then.normal_error, "degrees"
        words = _photometric_words(now), _photometric_words(then.model_dump())
    show([f"presses today, {len(session.presses)}: {words[0]}", f"when it was made: {words[1]}"])
    if error > limit:
        others = f"few presses, a ball whose radius is not {radius}, or no untouched gel at first"
        show([f"up to {limit:.2g} {unit} fit; {others} also give larger errors"])
    return error <= limit


def _check_force(
    args: argparse.Namespace, path: Path, entry: ForceEntry | None, pipeline: str | None
) -> bool:
    """Print today's error of the force; returns whether it is still small enough."""
    if entry is None:
        raise ConfigError(f"calibrate check: {path} has no force that --csv could be compared with")
    watched = _watch(_load(args, pipeline), path)
    now = force.try_force(entry, args.csv.name, watched, _read(args.csv, args.offset))
    show([f"force: {now:.2f} N RMS from the gauge today; when it was made: {entry.press.rmse:.2f} N"])
    return now <= WORSE * entry.press.rmse


def _add_force(args: argparse.Namespace, path: Path, pipeline: str | None = None) -> int:
    """Fit the force and write it into the calibration file."""
    calibration = Calibration.load(path)
    if calibration.force is not None and not args.overwrite:
        raise ConfigError(f"calibrate force: {path} has a force already; give --overwrite to replace it")
    if args.source is None:
        raise ConfigError(
            "calibrate force: required --source, a recording with a CSV of the same name beside it"
        )
    pairs = {args.source: args.csv} if args.csv else recordings_with_csv(args.source)
    watched, references = {}, {}
    for source, file in pairs.items():
        try:
            reference = _read(file, args.offset)
            features = _watch(_load(args, pipeline, source=source), path)
            force.align(source, features, reference, features.change_at_rest)
        except TactflowError as problem:
            if len(pairs) == 1:
                raise
            say(f"{source} is left out: {problem}")
            continue
        watched[source], references[source] = features, reference
        say(f"{source}: {len(features.touched)} frames, {features.touched.sum()} of them with contact")
    if not watched:
        raise ConfigError(f"calibrate force: none of the {len(pairs)} recordings can be used")
    fit = force.fit_force(watched, references)
    for words in _force_words(fit, references):
        say(words)
    calibration.model_copy(update={"force": fit.entry}).save(path)
    say(f"the force is added to {path}")
    return 0


def _force_words(fit: force.Fit, references: Mapping[str, Reference]) -> list[str]:
    entry = fit.entry
    words = [f"{name}: its clock is {s:+.3f} s ahead of its CSV's" for name, s in entry.recordings.items()]
    words.append(f"force, {entry.presses} presses: {_quality(entry.press, entry.left_out)}")
    if "volume" not in entry.press.stiffness:
        words.append(
            "heights are not known, so the force is fitted to the change of light and the area: it is valid "
            "only for objects like these"
        )
    if fit.turned is not None:
        side = ", mirrored" if fit.mirrored else ""
        words.append(
            f"the gauge's x axis lies {fit.turned:+.0f} degrees counter-clockwise in the picture{side}"
        )
        if entry.drag is None:
            words.append("fx and fy do not follow the flow of the contact, and are left out")
        else:
            words.append(f"force sideways: {_quality(entry.drag, entry.left_out)}")
    elif any(reference.sideways for reference in references.values()):
        words.append("fx and fy are left out: not every CSV has them")
    return words


def _quality(part: LinearForceEntry, left_out: str) -> str:
    absolute, relative = part.error
    groups = {"object": "objects", "recording": "recordings", "press": "presses"}[left_out]
    return (
        f"RMS error {part.rmse:.2f} N of {part.range[0]:.1f} to {part.range[1]:.1f} N, "
        f"{100 * part.r2:.0f} % of the variance explained, on {groups} left out of the fit; "
        f"standard error {absolute:.2f} N and {100 * relative:.0f} % of the force"
    )


def _scale(args: argparse.Namespace, session: Session, base: Calibration | None) -> tuple[Scale, str]:
    """Millimetres per pixel, and how they were found. base : its scale is kept unless an option gives one."""
    width, height = session.mapping.size
    try:
        if base is not None and args.pitch is None and args.area is None:
            return base.scale_at((width, height)), base.scale_entry.found_by
        if args.pitch is not None:
            scale = scale_from_pitch(session.dots, args.pitch, (width, height))
            return scale, f"pitch of {args.pitch:g} mm"
        scale = scale_from_area(args.area, (width, height))
        return scale, f"area of {args.area[0]:g} x {args.area[1]:g} mm"
    except ValueError as problem:
        raise ConfigError(f"calibrate: {problem}") from None


def _run(
    pipeline: Pipeline,
    take: Callable[[Result, Runner], None],
    needed: Mapping[str, str],
    calibration: Path | None = None,
    page: Mapping[str, Node] = MappingProxyType({}),
) -> None:
    """Run a pipeline without its sinks, nothing skipped, and call `take` with every result and the run.

    needed : port -> the stage that gives it. page : sinks that look on. A signal such as Ctrl-C ends it.
    """
    ports = {port.name for node in pipeline.nodes.values() for port in node.component.ports.outputs}
    for port, stage in needed.items():
        if port not in ports:
            raise ConfigError(f"calibrate: required a pipeline that gives {port}; add the stage {stage}")
    plain = replace(pipeline, skipping=False, calibration=calibration)
    name = "tactflow.calibrate"
    collecting = with_collector(
        plain, Result, lambda result: take(result, runner), name=name, references=True
    )
    runner = make_runner(replace(collecting, nodes={**collecting.nodes, **page}))
    with ended_by_signals(runner):
        ended = runner.run()
    if ended.exit_code == INTERRUPTED:
        raise Interrupted
    if ended.failure is not None:
        raise ended.failure


def _watch(pipeline: Pipeline, calibration: Path) -> force.Watched:
    """Features for the force fit. calibration : the file, with a scale."""
    watcher = force.Watcher()
    _run(pipeline, lambda result, _: watcher.add(result), force.NEEDED, calibration)
    return watcher.watched()


def _find_presses(
    pipeline: Pipeline,
    guide: Guide | None,
    page: Mapping[str, Node] = MappingProxyType({}),
) -> Session:
    """The presses that a source shows; of a live one until there are enough.

    guide : None if the untouched gel is enough. page : sinks that show the session.
    """
    finder = PressFinder()
    enough = guide is None

    def take(result: Result, runner: Runner) -> None:
        nonlocal enough
        live = runner.source is not None and runner.source.live
        finder.pictures = runner.source is not None and runner.source.pictures
        finder.add(result)
        enough = (guide is not None and guide(finder)) or enough
        # All frames of the reference count, however many presses there are.
        if enough and live and not result.frame.reference:
            runner.stop()

    _run(pipeline, take, presses.NEEDED, page=page)
    return finder.session()


def _read(file: Path, offset: float) -> Reference:
    reference = read_reference(file)
    return reference if reference.by_frame else replace(reference, time=reference.time + offset)


def _instruct(args: argparse.Namespace, ball_radius: float | None) -> None:
    """Print instructions. ball_radius : mm; None without a ball."""
    if ball_radius is None:
        say("Leave the gel untouched.")
        return
    number = "One press" if args.presses == 1 else f"{args.presses} presses"
    say(
        "Leave the gel untouched at first. Then press the ball, lift it, and press it somewhere else, all "
        f"over the gel and to several depths. {number} are enough; Ctrl-C ends earlier."
    )


def _load(
    args: argparse.Namespace,
    pipeline: str | None,
    settings: Settings = MappingProxyType({}),
    source: str | None = None,
) -> Pipeline:
    """The pipeline without a calibration. source : default: --source."""
    settings = {"calibration": None, **settings}
    source = args.source if source is None else source
    return load(pipeline, source=source, sensor=args.sensor, settings=settings, realtime=args.realtime)


def _page(args: argparse.Namespace, pipeline: str | None, guide: Guide) -> dict[str, Node]:
    """The live page of the pipeline, or else one with defaults, showing the guided session."""
    own, added = _load(args, pipeline), _load(args, pipeline, {"sinks.view": {}})
    node = next(node for node in (*own.sinks, *added.sinks) if node.component.name == "view")
    return {node.id: replace(node, component=node.component.with_arguments(session=guide))}


def _darkness_words(found: DarknessEntry) -> str:
    return (
        f"depth up to {found.depth[-1]:.2f} mm, where the gel is {100 * found.darkening[-1]:.0f} % darker; "
        f"standard error {found.stderr:.3f} mm"
    )


def _photometric_words(errors: dict[str, float]) -> str:
    return (
        f"normals {errors['normal_error']:.1f} degrees off in the mean, "
        f"standard error of the depth {100 * errors['depth_stderr']:.0f} %"
    )
