"""`tactflow calibrate`: make the calibration file of a sensor, and see whether it still fits."""

from __future__ import annotations

import argparse
import math
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Final

from tactflow.api import Settings, load
from tactflow.calibration.file import UNLIKE, Calibration, PhotometricEntry, raw_corners, small_picture
from tactflow.calibration.keeping import KeptPresses
from tactflow.calibration.photometric import fit_photometry, try_photometry
from tactflow.calibration.presses import Press, Session, find_presses
from tactflow.calibration.scale import scale_from_corners, scale_from_pitch
from tactflow.cli.calibrate_force import add_force, add_force_arguments, check_force
from tactflow.cli.calibrate_lens import add_target_arguments, print_lens, target_scale
from tactflow.cli.guide import Guide, typed_lines
from tactflow.cli.options import positive
from tactflow.cli.terminal import notes, printable, say, typed
from tactflow.engine.errors import ConfigError
from tactflow.engine.graph import Node, Pipeline
from tactflow.view.guided import Guiding
from tactflow.vision.types import Scale

WORSE: Final = 1.5
"""Error on new presses over that in the file, from which on a calibration is called drifted. By hand."""
LOOSE: Final = 0.02
"""Relative error of a scale by pitch from which on it is told how to get a better one. Chosen by hand: grids
of the simulator have less than 0.01, the rings of a TacTip 0.1 to 0.15."""
SHORTEST: Final = 1e-3
LONGEST: Final = 1e4
"""Lengths that are taken, mm. Chosen by hand: gels and balls have 1 to 100."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `calibrate`."""
    parser.add_argument(
        "what",
        nargs="*",
        metavar="PIPELINE | check FILE [PIPELINE] | force FILE [PIPELINE] | lens PICTURES",
        help="a pipeline with the sensor's preprocess, to make a calibration (default: ./pipeline.yaml, else "
        "the packaged one); or check, and a calibration file, to see how well it fits today; or force, and a "
        "calibration file, to add to it how the force follows from the contact; or lens, and pictures of a "
        "printed target, to get undistort and homography of a preprocess",
    )
    parser.add_argument(
        "--source",
        "--from",
        dest="source",
        metavar="SRC",
        help="as in 'tactflow run': a camera, a recording or a folder of pictures. First the untouched gel, "
        "then presses of the ball. For force, a recording with a CSV of the same name beside it, or a folder "
        "of them",
    )
    parser.add_argument("--sensor", metavar="NAME", help="which one of a file with sensors")
    parser.add_argument("--out", type=Path, metavar="FILE", help="calibration/SENSOR.yaml unless given")
    parser.add_argument(
        "--realtime", action="store_true", help="play a recording at its own pace, like a camera, to try it"
    )
    parser.add_argument(
        "--fresh", action="store_true", help="forget the presses of a session that was broken off"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace FILE if it is there")
    parser.add_argument(
        "--pitch",
        type=_millimetres,
        metavar="MM",
        help="distance of neighbouring dots of the gel, which stand in a square grid, or of the target",
    )
    parser.add_argument(
        "--area",
        type=_millimetres,
        nargs=2,
        metavar=("WIDTH", "HEIGHT"),
        help="what the whole processed picture shows, mm, where the gel has no dots of known pitch",
    )
    parser.add_argument(
        "--ball-radius", type=_millimetres, metavar="MM", help="of the ball; without it, scale only"
    )
    parser.add_argument(
        "--presses", type=positive, default=30, metavar="N", help="of a live source: enough presses (30)"
    )
    parser.add_argument(
        "--view", action="store_true", help="show the live page, which says where to press next"
    )
    add_target_arguments(parser)
    add_force_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Make or check a calibration; returns the exit code: of a check 3 where it does not fit.

    Raises
    ------
    TactflowError
        If options are wrong, or what was recorded gives no calibration.
    """
    with notes():
        return _run(args, list(args.what))


def _run(args: argparse.Namespace, words: list[str]) -> int:
    if words[:1] == ["check"]:
        if len(words) not in (2, 3):
            raise ConfigError("calibrate check: required a calibration file, and a pipeline if wanted")
        return _check(args, Path(words[1]), words[2] if len(words) == 3 else None)
    if words[:1] == ["force"]:
        if len(words) not in (2, 3):
            raise ConfigError("calibrate force: required a calibration file, and a pipeline if wanted")
        return add_force(args, Path(words[1]), words[2] if len(words) == 3 else None)
    if words[:1] == ["lens"]:
        return print_lens(args, words[1:])
    if len(words) > 1:
        raise ConfigError(f"calibrate: required one pipeline, got {', '.join(words)}")
    return _make(args, words[0] if words else None)


def _make(args: argparse.Namespace, pipeline: str | None) -> int:
    if (args.pitch is None) == (args.area is None):
        raise ConfigError("calibrate: required one of --pitch MM and --area WIDTH HEIGHT, for the scale")
    loaded = _load(args, pipeline)
    out = args.out or Path("calibration") / f"{loaded.sensor}.yaml"
    if out.suffix != ".yaml":
        raise ConfigError(f"--out: required a file whose name ends in .yaml, got {out}")
    if out.exists() and not args.overwrite:
        raise ConfigError(f"--out: {out} is already there; give --overwrite to replace it")
    _instruct(args, args.ball_radius, "; what was pressed is kept")
    kept = KeptPresses(out.with_suffix(".presses"))
    if args.fresh:
        kept.clear()
    guide = Guide(args.presses, say, typed_lines())
    page = _page(args, pipeline, guide) if args.view else None
    if args.ball_radius is None:
        # The untouched gel is enough for a scale.
        session = find_presses(loaded, _at_once, watchers=page)
    else:
        session = find_presses(loaded, guide, kept, page)
    try:
        calibration = _learned(args, loaded, session)
    except ConfigError as error:
        if not kept.presses:
            raise
        raise ConfigError(
            f"{error}. {len(kept.presses)} presses are kept in {kept.folder}: run the command again to go "
            "on, or with --fresh to begin anew"
        ) from None
    calibration.save(out)
    if args.ball_radius is not None and len(kept.presses) >= args.presses:
        kept.clear()
    elif kept.presses:
        say(f"to go on to {args.presses} presses, run the command again with --overwrite")
    say(
        f"{out} is written. To use it, write into the pipeline file: calibration: {out}\n"
        f"or give it to a run: {typed('--set', f'calibration={out}')}"
    )
    return 0


def _learned(args: argparse.Namespace, loaded: Pipeline, session: Session) -> Calibration:
    """What a session gives. Raises ConfigError if that is no calibration."""
    scale = _scale(args, loaded, session)
    say(f"scale: {_scale_words(scale)}")
    error = max(scale.stderr[0] / scale.x, scale.stderr[1] / scale.y)
    if args.pitch is not None and args.target is None and error > LOOSE:
        say(
            f"that is an error of {100 * error:.1f} %: --pitch is for dots in a square grid, and these are "
            "in none (rings are not, for one), or the picture is stretched. Measure a length instead: --area "
            "WIDTH HEIGHT takes what the whole processed picture shows, --target a printed grid"
        )
    found = None
    if args.ball_radius is not None:
        say(f"{len(session.presses)} presses; learning from them ...")
        found = fit_photometry(session, scale, args.ball_radius)
        for press, kept, misfit in zip(session.presses, found.kept, found.misfit, strict=True):
            if not kept:
                say(f"the press of frame {press.seq} is left out: {misfit:.0f} degrees from a ball")
        say(_photometric_words(found.found.model_dump()))
    return Calibration(
        sensor=loaded.sensor,
        made_from=str(args.source or loaded.source.params.model_dump().get("source", "")),
        raw_size=session.mapping.raw_size,
        size=session.mapping.size,
        corners=raw_corners(session.mapping),
        look=small_picture(session.untouched),
        scale=scale,
        scale_by=_given(args),
        slopes=None if found is None else found.model,
        photometric=None if found is None else found.found,
    )


def _check(args: argparse.Namespace, path: Path, pipeline: str | None) -> int:
    calibration = Calibration.load(path)
    then = calibration.photometric
    _instruct(args, None if then is None else then.ball_radius)
    # The untouched gel is enough for a scale.
    report = _at_once if then is None else Guide(args.presses, say, typed_lines())
    session = find_presses(_load(args, pipeline), report)
    misfit = calibration.misfit(session.mapping)
    if misfit is not None:
        print(
            printable(f"does not fit: {misfit}; name the pipeline that it was made with, or calibrate anew")
        )
        return 3
    unlike = calibration.unlikeness(session.untouched)
    fits = unlike <= UNLIKE
    print(
        f"untouched gel: differs by {100 * unlike:.1f} % of its brightness; up to {100 * UNLIKE:.0f} % fits"
    )
    if not fits:
        print("so it does too with another sensor or light, or where something touches the gel at the start")
    if then is not None:
        fits = _check_presses(calibration, then, session) and fits
    if args.csv is not None:
        fits = check_force(args, path, calibration.force, pipeline, WORSE) and fits
    print("it still fits" if fits else "it does not fit; if none of this explains it, calibrate anew")
    return 0 if fits else 3


def _check_presses(calibration: Calibration, then: PhotometricEntry, session: Session) -> bool:
    """Whether a calibration fits the presses of today, which is told; True where there are none."""
    count = len(session.presses)
    if calibration.slopes is None or not count:
        print(
            "no presses today, so depth is not looked at: show the untouched gel, then a ball of radius "
            f"{then.ball_radius:g} mm"
        )
        return True
    now = try_photometry(session, calibration.slopes, calibration.scale, then.ball_radius)
    print(f"{count} {'press' if count == 1 else 'presses'} today: {_photometric_words(now)}")
    print(f"when it was made: {_photometric_words(then.model_dump())}")
    if now["normal_error"] <= WORSE * then.normal_error:
        return True
    print(
        f"normals up to {WORSE * then.normal_error:.1f} degrees off fit. They are more off too with few "
        f"presses, with a ball whose radius is not {then.ball_radius:g} mm, or where the source does not "
        "begin with the untouched gel"
    )
    return False


def _instruct(args: argparse.Namespace, ball_radius: float | None, ended: str = "") -> None:
    """Say what to do with the gel. ball_radius : mm; None without a ball. ended : what becomes of presses."""
    if ball_radius is None:
        say("Leave the gel untouched.")
        return
    say(
        "Leave the gel untouched at first. Then press the ball, lift it, and press it somewhere else, "
        f"all over the gel and to several depths. {args.presses} presses will do. Type u and Enter to "
        f"undo the last one, q and Enter or Ctrl-C to end earlier{ended}."
    )


def _at_once(_frames: int, _presses: list[Press], _lasts: bool) -> bool:
    """A `Report` for which the untouched gel is enough."""
    return True


def _load(
    args: argparse.Namespace, pipeline: str | None, settings: Settings = MappingProxyType({})
) -> Pipeline:
    return load(
        pipeline,
        source=args.source,
        sensor=args.sensor,
        settings={"calibration": None, **settings},
        realtime=args.realtime,
    )


def _scale(args: argparse.Namespace, loaded: Pipeline, session: Session) -> Scale:
    width, height = session.mapping.size
    try:
        if args.target is not None:
            return target_scale(args, loaded)
        if args.pitch is not None:
            return scale_from_pitch(session.dots, args.pitch, (width, height))
        # The picture reaches half a pixel beyond the centres of its outermost pixels.
        return scale_from_corners(
            [[-0.5, -0.5], [width - 0.5, height - 0.5]], [[0, 0], args.area], (width, height)
        )
    except ValueError as problem:
        raise ConfigError(f"calibrate: {problem}") from None


def _given(args: argparse.Namespace) -> str:
    """How the scale is found."""
    if args.target is not None:
        return f"target of {args.grid}, pitch of {args.pitch:g} mm"
    return f"pitch of {args.pitch:g} mm" if args.pitch else f"area of {args.area[0]:g} x {args.area[1]:g} mm"


def _page(args: argparse.Namespace, pipeline: str | None, guide: Guide) -> dict[str, Node]:
    """The live page as the pipeline sets it, or as it is by itself, made to guide."""
    choices: tuple[Settings, ...] = ({}, {"sinks.view": {}})
    for settings in choices:
        for id_, node in _load(args, pipeline, settings).nodes.items():
            if issubclass(node.component.cls, Guiding):
                component = replace(node.component, cls=node.component.cls.through(guide))
                return {id_: replace(node, component=component)}
    raise AssertionError("the sink view guides")


def _scale_words(scale: Scale) -> str:
    return (
        f"{scale.x:.5f} +- {scale.stderr[0]:.5f} mm per px in x, {scale.y:.5f} +- {scale.stderr[1]:.5f} in y"
    )


def _millimetres(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not SHORTEST <= value <= LONGEST:
        raise argparse.ArgumentTypeError(
            f"required millimetres from {SHORTEST:g} to {LONGEST:g}, got {text!r}"
        )
    return value


def _photometric_words(errors: dict[str, float]) -> str:
    return (
        f"normals {errors['normal_error']:.1f} degrees off in the mean, radius of the ball "
        f"{100 * errors['radius_error']:+.1f} %, heights {errors['sphere_rms']:.3f} mm RMS from it, standard "
        f"error of the depth {100 * errors['depth_stderr']:.0f} %"
    )
