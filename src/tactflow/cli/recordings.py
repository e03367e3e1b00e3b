"""Commands about recordings: `tactflow export`, which makes a dataset of them, and `tactflow repair`."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, cast

from tactflow.cli.options import (
    add_overwrite,
    add_quiet,
    add_sources,
    listed_sources,
    refuse_output,
    writing,
)
from tactflow.engine.errors import ConfigError, SourceError, StageError
from tactflow.outputs import locked_folder
from tactflow.recording import missing_packages
from tactflow.system.arguments import number
from tactflow.system.files import completed
from tactflow.system.plugins import plugins
from tactflow.system.spelling import did_you_mean
from tactflow.system.terminal import notes, progress_bar, say

if TYPE_CHECKING:
    from tactflow.message.episodes import Results

EXPORTS = "tactflow.exports"
"""Group of entry points: name of a format -> function that writes a dataset. It is called with a folder to
fill, `(name, results)` of each recording, and `fps`, `task` and `pictures` as keywords. One whose
`fps` is None by default can keep every frame and its time. One that has `sensors` takes episodes of several
sensors, of which `results` is then a mapping."""
frame_rate = number(int, 1, 1000, "1 to 1000 frames a second")
"""Parses the frame rate of a dataset."""


def add_arguments_export(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `export`."""
    parser.add_argument(
        "format",
        help="hdf5 (all frames and numbers as plain arrays), lerobot (a dataset of layout v3.0), "
        "replay-buffer (Zarr, for Diffusion Policy), or that of a plug-in",
    )
    add_sources(
        parser,
        "recordings",
        "SRC",
        "each becomes an episode: whatever `tactflow run --source` takes, except live sources",
    )
    parser.add_argument(
        "--sensor",
        action="append",
        nargs="+",
        default=[],
        metavar=("NAME", "SRC"),
        help="instead of SRC, for lerobot: a sensor and its recordings; once for each sensor. The first "
        "recordings of all become an episode, with frames of the same time, then the second ones, and so on",
    )
    parser.add_argument(
        "--out", required=True, type=Path, metavar="DATASET", help="folder; must not exist yet"
    )
    parser.add_argument(
        "--pipeline",
        metavar="PIPELINE",
        help="pipeline that computes the results (default: as `tactflow run`)",
    )
    parser.add_argument(
        "--fps",
        type=frame_rate,
        help="frame rate of the dataset (default: that of the first recording; hdf5: every frame)",
    )
    parser.add_argument(
        "--task", default="touch", help="description of the task, stored in the dataset (default: touch)"
    )
    parser.add_argument(
        "--pictures",
        choices=("video", "png"),
        default="video",
        help="for lerobot: video is H.264, small and slightly lossy (default); png is lossless",
    )


def run_export(args: argparse.Namespace) -> int:
    """Write the dataset; returns the exit code.

    Raises
    ------
    ConfigError : there is no such format, or the folder is there already. Nothing was written.
    TactflowError : as `tactflow run`, or another run is writing to the folder; nothing is left behind.
    """
    from tactflow.cli.sessions import of_sensors
    from tactflow.streaming import stream

    exporter = find_exporter(args.format)
    sensors = _sensors(args)
    if sensors and "sensors" not in signature(exporter).parameters:
        raise ConfigError(f"--sensor: {args.format} takes the recordings of one sensor")
    recordings = next(iter(sensors.values())) if sensors else listed_sources(args, "recordings")
    if args.out.is_file() or (args.out.is_dir() and any(args.out.iterdir())):
        raise ConfigError(f"--out: {args.out} already exists; give another folder")

    sessions = iter([dict(zip(sensors, own, strict=True)) for own in zip(*sensors.values(), strict=True)])

    def results(recording: str) -> Results:
        if sensors:
            return of_sensors(args.pipeline, next(sessions))
        return stream(args.pipeline, source=recording, settings={"sinks": {}}, images=True)

    options = {"fps": args.fps, "task": args.task, "pictures": args.pictures, "sensors": list(sensors)}
    say(write_dataset(args.format, recordings, results, args.out, **options))
    return 0


def _sensors(args: argparse.Namespace) -> dict[str, list[str]]:
    """Sensor -> its recordings. Raises ConfigError unless each is named once, with as many recordings."""
    sensors = {name: recordings for name, *recordings in args.sensor}
    counts = {len(recordings) for recordings in sensors.values()}
    if not sensors:
        return {}
    if args.recordings or args.source:
        raise ConfigError("--sensor: name the sensor of every recording, or of none")
    if len(sensors) < max(2, len(args.sensor)) or len(counts) > 1 or 0 in counts:
        found = ", ".join(f"{name} with {len(recordings)}" for name, *recordings in args.sensor)
        raise ConfigError(
            f"--sensor: required two or more, each once and with as many recordings, such as --sensor left "
            f"left-1.mcap left-2.mcap --sensor right right-1.mcap right-2.mcap; got {found}"
        )
    return sensors


def write_dataset(
    format_: str,
    recordings: Sequence[str],
    results: Callable[[str], Results],
    out: Path,
    *,
    fps: int | None = None,
    task: str = "touch",
    pictures: str = "video",
    sensors: Sequence[str] = (),
) -> str:
    """Write a dataset with an episode for each recording; returns a line about it.

    Parameters
    ----------
    format_ : name of an export.
    recordings : sources; of several sensors, those of the first.
    results : gives the results of a recording, with pictures, or those of each sensor.
    out : folder; replaced if it exists.
    fps : frame rate of the dataset, Hz; None: that of the first recording, or every frame if the format can.
    task, pictures : as for `tactflow export`.
    sensors : names of several sensors, which only some formats take.

    Raises
    ------
    ConfigError : there is no such format. TactflowError : as `tactflow run`, or another run is writing to the
        folder; nothing is left behind.
    """
    exporter = find_exporter(format_)
    rate = signature(exporter).parameters.get("fps")
    keeps_every_frame = rate is not None and rate.default is None
    fps = fps if fps or keeps_every_frame else _rate(recordings[0])
    started: list[str] = []

    def episodes() -> Iterator[tuple[str, Results]]:
        for recording in recordings:
            started.append(recording)
            yield recording, results(recording)

    try:
        with notes(), writing(out), locked_folder(out), completed(out.resolve()) as folder:
            several = {"sensors": sensors} if sensors else {}
            exporter(folder, episodes(), fps=fps, task=task, pictures=pictures, **several)
    except StageError as error:
        raise StageError(f"{started[-1]}: {error}" if started else str(error)) from error
    count = len(recordings)
    return f"{out}: {count} {'episode' if count == 1 else 'episodes'}{f' at {fps} fps' if fps else ''}"


def find_exporter(name: str) -> Callable[..., None]:
    """The function that writes datasets of a format. Raises ConfigError if there is no such format."""
    formats = {entry.name: entry for entry in plugins(EXPORTS)}
    if name not in formats:
        raise ConfigError(f"there is no format {name}{did_you_mean(name, formats)}")
    try:
        return cast(Callable[..., None], formats[name].load())
    except Exception as error:
        raise ConfigError(f"{name}: {formats[name].value} cannot be loaded: {error}") from error


def _rate(recording: str) -> int:
    """Frame rate of a recording, rounded, Hz."""
    from tactflow.sources import open_source

    source = open_source(recording)
    rate, live = source.fps, source.live
    source.close()
    if live:
        raise ConfigError(f"{recording}: required a recording, not a camera or a stream")
    if rate is None:
        raise ConfigError(f"{recording}: does not state its frame rate; give --fps")
    return max(round(rate), 1)


def add_arguments_repair(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `repair`."""
    parser.add_argument(
        "file",
        type=Path,
        metavar="FILE",
        help="an .mcap file that is damaged or was not finished; it is not changed",
    )
    parser.add_argument(
        "--out", type=Path, metavar="FILE", help="where the copy goes; default: FILE-repaired.mcap, beside it"
    )
    add_overwrite(parser, "the copy")
    add_quiet(parser)


def run_repair(args: argparse.Namespace) -> int:
    """Write a copy of everything intact in a damaged recording; returns the exit code.

    The copy gets its name only when it is complete, so an interrupted repair leaves nothing behind.

    Raises
    ------
    ConfigError
        If a path is wrong (nothing was written). SourceError if the file cannot be read or is not an MCAP
        file. StageError if the copy cannot be written.
    """
    from tactflow.recording.records import NotARecordingError
    from tactflow.recording.repair import repair

    problem = missing_packages()
    if problem is not None:
        raise ConfigError(problem)
    path: Path = args.file
    if not path.is_file():
        raise SourceError(f"{path}: no such file")
    out: Path = args.out or path.with_name(f"{path.stem}-repaired{path.suffix}")
    if out.exists() and out.samefile(path):
        raise ConfigError(f"--out: {out} is the file to repair; name another one")
    refuse_output("--out", out, overwrite=args.overwrite)
    bar = progress_bar(path.name, path.stat().st_size, shown=not args.quiet)
    with writing(f"--out {out}"), completed(out) as copy, bar as update:
        try:
            result = repair(path, copy, lambda done: update(completed=done))
        except NotARecordingError as error:
            raise SourceError(f"{path}: {error}") from None
        summary = f"{out}: {result.messages} messages; {path} is unchanged"
        if result.lost:
            summary += f"; {result.lost} bytes of it were damaged and are left out"
        if result.finished:
            copy.unlink()
            summary = f"{path}: is intact; nothing to repair ({result.messages} messages)"
        else:
            copy.chmod(path.stat().st_mode & 0o777)
    if not args.quiet:
        say(summary)
    return 0
