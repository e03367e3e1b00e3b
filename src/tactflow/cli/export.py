"""`tactflow export`: make a dataset of recordings."""

from __future__ import annotations

import argparse
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console

from tactflow.cli.notes import notes_on, say
from tactflow.engine.errors import ConfigError, StageError
from tactflow.system.files import claim_path, make_folder

FASTEST = 1000
"""Frames per second of a dataset at most; cameras of gels are slower. Chosen by hand."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `export`."""
    parser.add_argument("format", choices=("lerobot",), help="a LeRobot dataset, layout v3.0")
    parser.add_argument(
        "recordings",
        nargs="+",
        metavar="RECORDING",
        help="each becomes an episode: whatever --source of `tactflow run` takes that ends",
    )
    parser.add_argument(
        "--out", required=True, type=Path, metavar="DATASET", help="folder; must not be there"
    )
    parser.add_argument(
        "--pipeline", metavar="PIPELINE", help="what finds contact and flow (default: as `tactflow run`)"
    )
    parser.add_argument("--fps", type=int, help="of the dataset (default: that of the first recording)")
    parser.add_argument(
        "--task", default="touch", help="what is done, in words: LeRobot keeps it (default: touch)"
    )
    parser.add_argument(
        "--pictures",
        choices=("video", "png"),
        default="video",
        help="video: H.264, small, loses a little (default); png: every bit",
    )


def run(args: argparse.Namespace) -> int:
    """Write the dataset; returns the exit code.

    Raises
    ------
    ConfigError : the folder is there already, or the rate is none. Nothing was written.
    TactflowError : as `tactflow run`; nothing is left behind.
    """
    from tactflow.adapters.lerobot import DatasetWriter
    from tactflow.streaming import stream

    if args.out.exists():
        raise ConfigError(f"--out: {args.out} is already there; give another folder")
    fps = _rate(args.recordings[0]) if args.fps is None else args.fps
    if not 1 <= fps <= FASTEST:
        raise ConfigError(f"--fps: required 1 to {FASTEST}, got {fps}")
    settings: dict[str, object] = {"sinks": {}}
    recording = ""
    notes = notes_on(Console(stderr=True, highlight=False, soft_wrap=True))
    try:
        with notes, _unfinished(args.out) as folder:
            writer = DatasetWriter(folder, fps, args.task, film=args.pictures == "video")
            for recording in args.recordings:
                frames = writer.add(stream(args.pipeline, source=recording, settings=settings, images=True))
                say(f"{recording}: {frames} frames")
            writer.finish()
            folder.replace(args.out)
    except StageError as error:
        raise StageError(f"{recording}: {error}" if recording else str(error)) from error
    except OSError as error:
        raise StageError(f"{args.out}: cannot be written: {error.strerror or error}") from error
    count = len(args.recordings)
    say(f"{args.out}: {count} {'episode' if count == 1 else 'episodes'} at {fps} fps")
    return 0


@contextmanager
def _unfinished(out: Path) -> Iterator[Path]:
    """An empty folder to make a dataset in; removed at the end unless it was moved.

    Raises
    ------
    ConfigError : another export makes the same dataset. OSError : it cannot be made.
    """
    folder = out.with_name(f".unfinished-{out.name}")
    make_folder(folder)
    try:
        claim = claim_path(folder)
    except BlockingIOError:
        raise ConfigError(
            f"--out: another tactflow export makes {out}; wait for it, or name another one"
        ) from None
    try:
        # Of one that was killed.
        for left in folder.iterdir():
            shutil.rmtree(left)
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        if claim is not None:
            os.close(claim)


def _rate(recording: str) -> int:
    """Frames per second of a recording, whole."""
    from tactflow.sources import open_source

    source = open_source(recording)
    rate, live = source.fps, source.live
    source.close()
    if live:
        raise ConfigError(f"{recording}: required a recording, not a camera or a stream")
    if rate is None:
        raise ConfigError(f"{recording}: does not say how many frames come in a second; give --fps")
    return max(round(rate), 1)
