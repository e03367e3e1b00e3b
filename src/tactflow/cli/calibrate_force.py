"""`tactflow calibrate force`: add the force to a calibration file, from recordings with a gauge's CSV."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from tactflow.api import load
from tactflow.calibration.file import Calibration, ForceEntry, LinearForceEntry
from tactflow.calibration.force import Fit, Watched, fit_force, try_force, watch
from tactflow.calibration.reference import Reference, read_reference
from tactflow.cli.terminal import say
from tactflow.engine.errors import ConfigError
from tactflow.system.files import expanded


def add_force_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `calibrate force`."""
    parser.add_argument(
        "--csv",
        type=Path,
        metavar="FILE",
        help="for force, and to check it: what the gauge said, where it does not lie beside the recording; "
        "columns t (s) or "
        "frame, fz (N), and fx and fy if there are",
    )
    parser.add_argument(
        "--offset",
        type=float,
        default=0.0,
        metavar="S",
        help="for force: add so much to the time of the CSV; what is left, up to 2 s, is estimated",
    )


def add_force(args: argparse.Namespace, path: Path, pipeline: str | None) -> int:
    """Fit the force and write it into the calibration file; returns the exit code.

    Raises ConfigError if options, CSVs or recordings give no fit, TactflowError if a recording fails.
    """
    calibration = Calibration.load(path)
    if calibration.force is not None and not args.overwrite:
        raise ConfigError(f"calibrate force: {path} has a force already; give --overwrite to replace it")
    if args.source is None:
        raise ConfigError(
            "calibrate force: required --from, a recording with a CSV of the same name beside it"
        )
    pairs = [(args.source, args.csv)] if args.csv else recordings_with_csv(args.source)
    references = {source: _read(file, args.offset) for source, file in pairs}
    watched: dict[str, Watched] = {}
    for source in references:
        settings = {"calibration": None}
        loaded = load(pipeline, source=source, sensor=args.sensor, settings=settings)
        watched[source] = watch(loaded, path)
        seen = watched[source]
        say(f"{source}: {len(seen.times)} frames, {seen.touched.sum()} of them with contact")
    fit = fit_force(watched, references)
    for words in _words(fit, references):
        say(words)
    replace(calibration, force=fit.entry).save(path)
    say(f"{path} has the force now")
    return 0


def check_force(
    args: argparse.Namespace, path: Path, entry: ForceEntry | None, pipeline: str | None, worse: float
) -> bool:
    """Print how right the force of a calibration is today; whether its error has not grown `worse` times.

    path, entry : the calibration's file, and its force.

    Raises ConfigError as `add_force` does.
    """
    if entry is None:
        raise ConfigError(f"calibrate check: {path} has no force that --csv could be compared with")
    reference = _read(args.csv, args.offset)
    loaded = load(pipeline, source=args.source, sensor=args.sensor, settings={"calibration": None})
    now = try_force(entry, args.csv.name, watch(loaded, path), reference)
    print(f"force: {now:.2f} N RMS from the gauge today; when it was made: {entry.press.rmse:.2f} N")
    return now <= worse * entry.press.rmse


def recordings_with_csv(source: str) -> list[tuple[str, Path]]:
    """(recording, its CSV): a recording with a CSV of the same name beside it, or all such in a folder.

    Raises ConfigError if there is none.
    """
    path = expanded(source)
    if path.is_file() and path.with_suffix(".csv").is_file():
        return [(source, path.with_suffix(".csv"))]
    pairs = []
    for file in sorted(path.glob("*.csv")) if path.is_dir() else []:
        beside = [other for other in sorted(path.glob("*")) if other.stem == file.stem and other != file]
        pairs += [(str(beside[0]), file)] if len(beside) == 1 else []
    if not pairs:
        raise ConfigError(
            f"calibrate force: found no recording with a CSV of the same name beside it in {source}; name "
            "the CSV with --csv"
        )
    return pairs


def _read(file: Path, offset: float) -> Reference:
    reference = read_reference(file)
    return reference if reference.by_frame else replace(reference, time=reference.time + offset)


def _words(fit: Fit, references: dict[str, Reference]) -> list[str]:
    entry = fit.entry
    said = [
        f"{name}: its clock is {offset:+.3f} s ahead of its CSV's"
        for name, offset in entry.recordings.items()
    ]
    said.append(f"force, {entry.presses} presses: {_quality(entry.press, entry.left_out)}")
    if entry.press.hysteresis is not None:
        said.append(f"hysteresis: {100 * entry.press.hysteresis:.0f} % of the largest force of a press")
    if "volume" not in entry.press.stiffness:
        said.append(
            "heights are not known, so it is by the change of the light and the area: good for objects "
            "like these only"
        )
    if fit.turned is not None:
        side = ", mirrored" if fit.mirrored else ""
        said.append(
            f"the gauge's x axis lies {fit.turned:+.0f} degrees counter-clockwise in the picture{side}"
        )
        if entry.drag is None:
            said.append("fx and fy do not follow the flow of the contact, and are left out")
        else:
            said.append(f"force sideways: {_quality(entry.drag, entry.left_out)}")
    elif any(reference.sideways for reference in references.values()):
        said.append("fx and fy are left out: not every CSV has them")
    return said


def _quality(part: LinearForceEntry, left_out: str) -> str:
    absolute, relative = part.error
    many = "recordings" if left_out == "recording" else "presses"
    return (
        f"RMS error {part.rmse:.2f} N of {part.range[0]:.1f} to {part.range[1]:.1f} N, "
        f"{100 * part.r2:.0f} % of the variance explained, by {many} that the fit has not seen; "
        f"standard error {absolute:.2f} N and {100 * relative:.0f} % of the force"
    )
