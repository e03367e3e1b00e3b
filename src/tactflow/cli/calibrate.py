"""`tactflow calibrate`: make the calibration file of a sensor, add the force, see whether it still fits."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import numpy as np
import yaml

from tactflow.api import Settings, ended_by_signals, load, make_runner
from tactflow.calibration import force, presses, target
from tactflow.calibration.darkness import darkness_error, fit_darkness
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
from tactflow.calibration.judgement import doubt
from tactflow.calibration.keeping import KeptPresses
from tactflow.calibration.photometric import fit_photometry
from tactflow.calibration.presses import PressFinder, Session
from tactflow.calibration.reference import Reference, read_reference, recordings_with_csv
from tactflow.calibration.refine import apparent_radius, refine_photometry
from tactflow.calibration.samples import press_errors, summary
from tactflow.calibration.scale import scale_from_area, scale_from_pitch
from tactflow.cli.guide import Guide
from tactflow.cli.options import add_overwrite, add_sensor, refuse_output
from tactflow.engine.collect import with_collector
from tactflow.engine.errors import ConfigError, TactflowError
from tactflow.engine.graph import Node, Pipeline
from tactflow.engine.run import Runner
from tactflow.message.result import Result
from tactflow.sources import open_source
from tactflow.system.arguments import number, positive
from tactflow.system.signals import INTERRUPTED, Interrupted
from tactflow.system.terminal import notes, say, show, typed
from tactflow.view.guided import Guiding
from tactflow.vision.geometry import PixelMapping
from tactflow.vision.types import Scale

WORSE: Final = 1.5
"""Error on new presses over that in the file above which a calibration counts as drifted."""
LOOSE: Final = 0.02
"""Relative error of a scale by pitch above which a better method is advised: grids of the simulator have less
than 0.01, the rings of a TacTip 0.1 to 0.15."""
ENOUGH: Final = 30
"""Presses after which a live session ends by itself."""
ENOUGH_TO_REFINE: Final = 9
"""The same with --refine: the errors on two Minis are then those of a calibration of their own."""
ENOUGH_OF_DARKNESS: Final = 1
"""The same with --darkness: one curve holds all over the gel."""
# Gels and balls have 1 to 100.
_millimetres = number(float, 1e-3, 1e4, "millimetres from 0.001 to 10000")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `calibrate`."""
    option = parser.add_argument
    option(
        "what",
        nargs="*",
        metavar="PIPELINE | check FILE [PIPELINE] | force FILE [PIPELINE] | lens PICTURES",
        help="PIPELINE: calibrate the sensor of this pipeline (default: ./pipeline.yaml, else the packaged "
        "one). check: test how well a calibration still fits. force: fit the force, and add it to a "
        "calibration. lens: print undistort and homography for preprocess, from pictures of a printed target",
    )
    option(
        "--source",
        "--from",
        dest="source",
        metavar="SRC",
        help="as in 'tactflow run': a camera, a recording or a folder of pictures, first of the untouched "
        "gel, then of presses of the ball. For force, a recording with a CSV of the same name beside it, or "
        "a folder of them",
    )
    add_sensor(parser)
    option("--out", type=Path, metavar="FILE", help="default: calibration/SENSOR.yaml")
    option("--realtime", action="store_true", help="play a recording at its own pace, like a camera")
    option("--fresh", action="store_true", help="discard the presses of an interrupted session")
    add_overwrite(parser)
    option(
        "--pitch",
        type=_millimetres,
        metavar="MM",
        help="spacing of the gel's dots, which form a square grid, or of the target's",
    )
    option(
        "--area",
        type=_millimetres,
        nargs=2,
        metavar=("WIDTH", "HEIGHT"),
        help="size of the whole processed picture, mm, if the gel has no dots of known pitch",
    )
    option(
        "--ball-radius",
        type=_millimetres,
        metavar="MM",
        help="radius of the ball; without it, only the scale is calibrated",
    )
    option(
        "--presses",
        type=positive,
        metavar="N",
        help=f"end a live session after N presses ({ENOUGH}; with --refine {ENOUGH_TO_REFINE}, "
        f"with --darkness, or to check such a file, {ENOUGH_OF_DARKNESS})",
    )
    option("--view", action="store_true", help="show the live page, which says where to press next")
    _add_kind(parser)
    _add_target_and_force(parser)


def _add_kind(parser: argparse.ArgumentParser) -> None:
    """Declare the options about calibrations of a kind of sensor."""
    option = parser.add_argument
    option(
        "--refine",
        action="store_true",
        help="start from the pipeline's calibration, such as the default of a kind of sensor, and adapt it "
        "to this sensor by one or more presses of the ball; the scale is kept unless --pitch, --area or "
        "--target is given",
    )
    option(
        "--darkness",
        action="store_true",
        help="fit depth to the darkening of the gel, for sensors in white light such as 9DTact; one press of "
        "the ball is enough",
    )
    option(
        "--kind",
        metavar="NAME",
        help="make a default for all sensors of a kind, such as 'GelSight Mini'; its stated errors are those "
        "on other sensors",
    )


def _add_target_and_force(parser: argparse.ArgumentParser) -> None:
    """Declare the options about a printed target, and those of `calibrate force`."""
    option = parser.add_argument
    option(
        "--target",
        metavar="PICTURE",
        help="take the scale from this raw picture of a printed target in the plane of the gel; it has the "
        "size of --grid and --pitch",
    )
    option(
        "--grid",
        metavar="COLUMNSxROWS",
        help="size of the target: inner corners of the checkerboard, or dots with --dots",
    )
    option("--dots", action="store_true", help="the target is a grid of dots")
    option(
        "--csv",
        type=Path,
        metavar="FILE",
        help="for force and check: readings of the gauge, if not beside the recording; columns t (s) or "
        "frame, fz (N), and optionally fx and fy",
    )
    option(
        "--offset",
        type=float,
        default=0.0,
        metavar="S",
        help="for force: add this to the times of the CSV; up to 2 s more are estimated",
    )


def run(args: argparse.Namespace) -> int:
    """Make or check a calibration; returns the exit code: of a check 3 where it does not fit.

    Raises
    ------
    TactflowError
        If options are wrong, or the recording gives no calibration.
    """
    verb, *words = args.what if args.what[:1] in (["check"], ["force"], ["lens"]) else ["make", *args.what]
    with notes():
        if verb == "lens":
            return _print_lens(args, words)
        if verb == "make":
            if len(words) > 1:
                raise ConfigError(f"calibrate: required one pipeline, got {', '.join(words)}")
            return _make(args, words[0] if words else None)
        if len(words) not in (1, 2):
            raise ConfigError(f"calibrate {verb}: required a calibration file, and a pipeline if wanted")
        command = _check if verb == "check" else _add_force
        return command(args, Path(words[0]), words[1] if len(words) > 1 else None)


def _make(args: argparse.Namespace, pipeline: str | None) -> int:
    ways = [args.pitch, args.area].count(None)
    if ways == 0 or (ways == 2 and not args.refine):
        raise ConfigError("calibrate: required one of --pitch MM and --area WIDTH HEIGHT, for the scale")
    if args.darkness and (args.refine or args.kind or args.ball_radius is None):
        raise ConfigError("calibrate --darkness: required --ball-radius MM, and neither --refine nor --kind")
    enough = ENOUGH_OF_DARKNESS if args.darkness else ENOUGH_TO_REFINE if args.refine else ENOUGH
    args.presses = args.presses or enough
    base = _base(args, pipeline)
    loaded = _load(args, pipeline)
    out = args.out or Path("calibration") / f"{loaded.sensor}.yaml"
    refuse_output("--out", out, overwrite=args.overwrite, suffixes=(".yaml",))
    _instruct(args, args.ball_radius, "; finished presses are kept")
    kept = KeptPresses(out.with_suffix(".presses"))
    if args.fresh:
        kept.clear()
    guide = Guide(args.presses, say)
    page = _page(args, pipeline, guide) if args.view else {}
    if args.ball_radius is None:
        session = _find_presses(loaded, None, page=page)
    else:
        session = _find_presses(loaded, guide, kept, page)
    try:
        calibration = _learned(args, loaded, session, base)
    except ConfigError as error:
        if not kept.presses:
            raise
        raise ConfigError(
            f"{error}. {len(kept.presses)} presses are kept in {kept.folder}: run the command again to "
            "continue, or with --fresh to start over"
        ) from None
    calibration.save(out)
    if args.ball_radius is not None and len(kept.presses) >= args.presses:
        kept.clear()
    elif kept.presses:
        say(f"to continue to {args.presses} presses, run the command again with --overwrite")
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
    if args.pitch is not None and args.target is None and error > LOOSE:
        say(
            f"that is an error of {100 * error:.1f} %: --pitch is for dots in a square grid, and either "
            "these form none or the picture is stretched. Use --area WIDTH HEIGHT, the size of the whole "
            "processed picture, or --target, a printed grid"
        )
    learned: dict[str, Any] = {}
    if args.ball_radius is not None:
        say(f"{len(session.presses)} presses; learning from them ...")
        learn = _darkness if args.darkness else _slopes
        learned = learn(args, session, scale, base)
    calibration = Calibration(
        sensor=loaded.sensor,
        made_from=str(args.source or loaded.source.params.model_dump().get("source", "")),
        raw_size=session.mapping.raw_size,
        size=session.mapping.size,
        corners=raw_corners(session.mapping),
        scale=ScaleEntry.of(scale, found_by),
        look=small_picture(session.untouched),
        **learned,
    )
    return calibration if args.kind is None else calibration.for_kind(args.kind)


def _slopes(
    args: argparse.Namespace, session: Session, scale: Scale, base: Calibration | None
) -> dict[str, Any]:
    """The fit of the slopes, as fields of `Calibration`."""
    apparent = None
    if base is not None and base.slopes is not None:
        apparent = apparent_radius(session, scale, args.ball_radius, base)
    if args.refine:
        assert base is not None
        fitted = refine_photometry(session, scale, args.ball_radius, base)
    else:
        fitted = fit_photometry(session, scale, args.ball_radius)
    if (question := doubt(session, scale, args.ball_radius, apparent)) is not None:
        say(question)
    for press, kept, misfit in zip(session.presses, fitted.kept, fitted.misfit, strict=True):
        if not kept:
            say(f"the press of frame {press.seq} is left out: {misfit:.0f} degrees off the surface of a ball")
    say(_photometric_words(fitted.found.model_dump()))
    return {"photometric": fitted.found, "slopes": fitted.model, "information": fitted.information}


def _darkness(
    args: argparse.Namespace, session: Session, scale: Scale, _: Calibration | None
) -> dict[str, Any]:
    """The fit of the darkening, as fields of `Calibration`."""
    fitted = fit_darkness(session, scale, args.ball_radius)
    if (question := doubt(session, scale, args.ball_radius)) is not None:
        say(question)
    for press, kept in zip(session.presses, fitted.kept, strict=True):
        if not kept:
            say(f"the press of frame {press.seq} is left out: too small, or larger than the ball")
    found = fitted.found
    say(
        f"depth up to {found.depth[-1]:.2f} mm, where the gel is {100 * found.darkening[-1]:.0f} % darker; "
        f"standard error {found.stderr:.3f} mm"
    )
    return {"darkness": found}


def _check(args: argparse.Namespace, path: Path, pipeline: str | None) -> int:
    calibration = Calibration.load(path)
    then, pressed = calibration.photometric, calibration.photometric or calibration.darkness
    args.presses = args.presses or (ENOUGH if then is not None else ENOUGH_OF_DARKNESS)
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
    if then is not None:
        fits.append(_check_presses(calibration, then, session))
    elif calibration.darkness is not None:
        fits.append(_check_darkness(calibration, calibration.darkness, session))
    if args.csv is not None:
        fits.append(_check_force(args, path, calibration.force, pipeline))
    show(
        ["it still fits" if all(fits) else "it does not fit; unless a reason above applies, calibrate again"]
    )
    return 0 if all(fits) else 3


def _check_presses(calibration: Calibration, then: PhotometricEntry, session: Session) -> bool:
    """Print how well a calibration fits the presses of today; True where there are none."""
    count, radius = len(session.presses), f"{then.ball_radius:g} mm"
    if calibration.slopes is None or not count:
        show(
            [f"no presses today: to check the depth, show the untouched gel, then a ball of radius {radius}"]
        )
        return True
    now = summary(press_errors(session, calibration.slopes, calibration.scale, then.ball_radius))
    limit = WORSE * then.normal_error
    show([f"presses today, {count}: {_photometric_words(now)}"])
    show([f"when it was made: {_photometric_words(then.model_dump())}"])
    if now["normal_error"] > limit:
        others = f"few presses, a ball whose radius is not {radius}, or no untouched gel at first"
        show([f"normals up to {limit:.1f} degrees off fit; {others} also give larger errors"])
    return now["normal_error"] <= limit


def _check_darkness(calibration: Calibration, then: DarknessEntry, session: Session) -> bool:
    """Print how well the depth by darkening fits the presses of today; True where there are none."""
    radius = f"{then.ball_radius:g} mm"
    if not session.presses:
        show([f"no presses today: to check the depth, press a ball of radius {radius} on the gel"])
        return True
    now, limit = darkness_error(session, then, calibration.scale), WORSE * then.stderr
    if not np.isfinite(now):
        count = len(session.presses)
        show([f"none of the {count} presses today can be used: press a ball of radius {radius}"])
        return False
    show([f"presses today, {len(session.presses)}: depth {now:.3f} mm RMS off; up to {limit:.3f} mm fits"])
    return now <= limit


def _check_force(
    args: argparse.Namespace, path: Path, entry: ForceEntry | None, pipeline: str | None
) -> bool:
    """Print the error of a calibration's force today; whether it is still small enough."""
    if entry is None:
        raise ConfigError(f"calibrate check: {path} has no force that --csv could be compared with")
    watched = _watch(_load(args, pipeline), path)
    now = force.try_force(entry, args.csv.name, watched, _read(args.csv, args.offset))
    show([f"force: {now:.2f} N RMS from the gauge today; when it was made: {entry.press.rmse:.2f} N"])
    return now <= WORSE * entry.press.rmse


def _add_force(args: argparse.Namespace, path: Path, pipeline: str | None) -> int:
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
        f"{100 * part.r2:.0f} % of the variance explained, by {groups} that the fit has not seen; "
        f"standard error {absolute:.2f} N and {100 * relative:.0f} % of the force"
    )


def _print_lens(args: argparse.Namespace, words: Sequence[str]) -> int:
    """Print `undistort` and `homography` for a pipeline file."""
    if len(words) != 1:
        raise ConfigError("calibrate lens: required one folder, pattern or video with pictures of the target")
    printed = _target(args)
    reader = open_source(words[0])
    try:
        views, size = [], (0, 0)
        for image, *_ in iter(reader.read, None):
            size = (image.shape[1], image.shape[0])
            if (points := target.find_target(image, printed)) is not None:
                views.append(points)
        if not views:
            raise ConfigError(_not_shown(printed, words[0]))
        fit = target.fit_lens(views, printed, size)
    except ValueError as problem:
        raise ConfigError(f"calibrate {problem}") from None
    finally:
        reader.close()
    say(
        f"{len(views)} pictures: {fit.rms:.2f} px RMS; focal lengths to {fit.stderr[0]:.1f} and "
        f"{fit.stderr[1]:.1f} px, centre to {fit.stderr[2]:.1f} and {fit.stderr[3]:.1f} px. For the "
        "parameters of preprocess:"
    )
    undistort = {
        "camera_matrix": np.round(fit.lens.camera_matrix, 3).tolist(),
        "distortion": np.round(fit.lens.distortion, 6).tolist(),
    }
    corners, places = (np.round(part, 2).tolist() for part in (fit.corners, fit.places))
    homography = {"from": corners, "to": places, "size": list(fit.size)}
    print(yaml.safe_dump({"undistort": undistort, "homography": homography}, default_flow_style=None), end="")
    return 0


def _scale(args: argparse.Namespace, session: Session, base: Calibration | None) -> tuple[Scale, str]:
    """Millimetres per pixel, and how they were found. base : to take it from where no option tells it."""
    width, height = session.mapping.size
    try:
        if base is not None and args.pitch is None and args.area is None:
            return base.scale_at((width, height)), base.scale_entry.found_by
        if args.target is not None:
            return _target_scale(args, session.mapping), f"target of {args.grid}, pitch of {args.pitch:g} mm"
        if args.pitch is not None:
            scale = scale_from_pitch(session.dots, args.pitch, (width, height))
            return scale, f"pitch of {args.pitch:g} mm"
        scale = scale_from_area(args.area, (width, height))
        return scale, f"area of {args.area[0]:g} x {args.area[1]:g} mm"
    except ValueError as problem:
        raise ConfigError(f"calibrate: {problem}") from None


def _target(args: argparse.Namespace) -> target.Target:
    """The target that the options describe."""
    if args.grid is None or args.pitch is None:
        raise ConfigError("calibrate: a target needs --grid COLUMNSxROWS and --pitch MM")
    columns, _, rows = str(args.grid).lower().partition("x")
    if not (columns.isdecimal() and rows.isdecimal()):
        raise ConfigError(f"--grid: required COLUMNSxROWS, as in 9x6, got {args.grid}")
    return target.Target(int(columns), int(rows), args.pitch, args.dots)


def _target_scale(args: argparse.Namespace, mapping: PixelMapping) -> Scale:
    """Scale from `--target`. mapping : from raw to processed pixels, by the pipeline's preprocess."""
    printed = _target(args)
    reader = open_source(args.target)
    try:
        shown = reader.read()
    finally:
        reader.close()
    if shown is None:
        raise ConfigError(_not_shown(printed, args.target))
    image, *_ = shown
    size = (image.shape[1], image.shape[0])
    if size != mapping.raw_size:
        raise ConfigError(
            f"calibrate: {args.target} has {size[0]} x {size[1]} px, required "
            f"{mapping.raw_size[0]} x {mapping.raw_size[1]} as the frames of the sensor"
        )
    points = target.find_target(image, printed)
    if points is None:
        raise ConfigError(_not_shown(printed, args.target))
    scale, bent = target.scale_from_target(mapping.to_processed(points), printed, mapping.size)
    if bent > target.BENT:
        say(
            f"the target is off a plane grid by {100 * bent:.1f} % of its pitch: one scale is not right for "
            "all of the picture; give preprocess the undistort and homography of `tactflow calibrate lens`"
        )
    return scale


def _not_shown(printed: target.Target, source: str) -> str:
    kind = "dots" if printed.dots else "inner corners of a checkerboard"
    counted = "dots" if printed.dots else "corners between four squares"
    return (
        f"calibrate: {source} does not show {printed.columns} x {printed.rows} {kind}; all of the target "
        f"must be in the picture, and --grid counts {counted}"
    )


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
    """The features that the force follows from. calibration : the file, with a scale."""
    watcher = force.Watcher()
    _run(pipeline, lambda result, _: watcher.add(result), force.NEEDED, calibration)
    return watcher.watched()


def _find_presses(
    pipeline: Pipeline,
    guide: Guide | None,
    kept: KeptPresses | None = None,
    page: Mapping[str, Node] = MappingProxyType({}),
) -> Session:
    """The presses that a source shows; of a live one until there are enough.

    guide : None if the untouched gel is enough. kept : has the presses so far of a live session.
    """
    finder = PressFinder()
    enough = guide is None

    def take(result: Result, runner: Runner) -> None:
        nonlocal enough
        live = runner.source is not None and runner.source.live
        finder.pictures = runner.source is not None and runner.source.pictures
        if live and kept is not None and not finder.frames:
            finder.presses[:] = kept.presses
        finder.add(result)
        enough = (guide is not None and guide(finder)) or enough
        if live and kept is not None:
            kept.update(finder)
        # All frames of the reference count, however many presses there are.
        if enough and live and not result.frame.reference:
            runner.stop()

    _run(pipeline, take, presses.NEEDED, page=page)
    return finder.session()


def _read(file: Path, offset: float) -> Reference:
    reference = read_reference(file)
    return reference if reference.by_frame else replace(reference, time=reference.time + offset)


def _instruct(args: argparse.Namespace, ball_radius: float | None, ended: str = "") -> None:
    """Print instructions. ball_radius : mm; None without a ball. ended : what Ctrl-C does."""
    if ball_radius is None:
        say("Leave the gel untouched.")
        return
    number = "One press" if args.presses == 1 else f"{args.presses} presses"
    say(
        "Leave the gel untouched at first. Then press the ball, lift it, and press it somewhere else, all "
        f"over the gel and to several depths. {number} are enough; Ctrl-C ends earlier{ended}."
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
    """The live page as the pipeline sets it, or as it is by itself, made to guide."""
    own, added = _load(args, pipeline), _load(args, pipeline, {"sinks.view": {}})
    for node in (*own.sinks, *added.sinks):
        if issubclass(node.component.cls, Guiding):
            component = replace(node.component, cls=node.component.cls.through(guide))
            return {node.id: replace(node, component=component)}
    raise AssertionError("the sink view guides")


def _photometric_words(errors: dict[str, float]) -> str:
    return (
        f"normals {errors['normal_error']:.1f} degrees off in the mean, radius of the ball "
        f"{100 * errors['radius_error']:+.1f} %, heights {errors['sphere_rms']:.3f} mm RMS from it, standard "
        f"error of the depth {100 * errors['depth_stderr']:.0f} %"
    )
