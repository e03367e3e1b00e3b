"""`tactflow repair`: a copy of all that is intact in a damaged or unfinished recording."""

from __future__ import annotations

import argparse
import os
import tempfile
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn

from tactflow.cli.notes import say
from tactflow.engine.errors import ConfigError, SourceError, StageError
from tactflow.recording import missing_packages


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `repair`."""
    parser.add_argument(
        "file",
        type=Path,
        metavar="FILE",
        help="an .mcap file that is damaged, or was not finished; it stays as it is",
    )
    parser.add_argument(
        "--out", type=Path, metavar="FILE", help="where the copy goes; default: FILE-repaired.mcap, beside it"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace the copy if it is there")
    parser.add_argument("--quiet", action="store_true", help="no progress display and no summary")


def run(args: argparse.Namespace) -> int:
    """Repair the file; returns the exit code.

    The copy gets its name only when it is complete, so an interrupted repair leaves nothing behind.

    Raises
    ------
    ConfigError
        If a path is wrong (nothing was written). SourceError if the file cannot be read or is no MCAP file.
        StageError if the copy cannot be written.
    """
    problem = missing_packages()
    if problem is not None:
        raise ConfigError(problem)
    path: Path = args.file
    if not path.is_file():
        raise SourceError(f"{path}: no such file")
    out: Path = args.out or path.with_name(f"{path.stem}-repaired{path.suffix}")
    if out.is_dir():
        raise ConfigError(f"--out: {out} is a folder; name a file in it, as in {out / path.name}")
    if out.exists() and out.samefile(path):
        raise ConfigError(f"--out: {out} is the file to repair; name another one")
    if out.exists() and not args.overwrite:
        raise ConfigError(f"{out} is already there; give --overwrite to replace it, or --out FILE")
    try:
        handle, name = tempfile.mkstemp(dir=out.absolute().parent, prefix=f".{out.stem}-", suffix=".mcap")
        os.close(handle)
    except OSError as error:
        raise StageError(f"{out}: cannot be written: {error.strerror or error}") from error
    copy = Path(name)
    try:
        return _repair(path, copy, out, quiet=args.quiet)
    finally:
        copy.unlink(missing_ok=True)


def _repair(path: Path, copy: Path, out: Path, *, quiet: bool) -> int:
    from tactflow.recording.records import NotARecordingError
    from tactflow.recording.repair import repair

    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), DownloadColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, disable=quiet or not console.is_terminal) as progress:
        task = progress.add_task(path.name, total=path.stat().st_size)
        try:
            result = repair(path, copy, lambda done: progress.update(task, completed=done))
        except NotARecordingError as error:
            raise SourceError(f"{path}: {error}") from None
        except OSError as error:
            raise StageError(
                f"{copy.parent}: the repaired copy cannot be written: {error.strerror or error}; "
                "--out puts it on another disk"
            ) from error
    if result.finished:
        _say(f"{path}: is whole already, nothing to repair ({result.messages} messages)", quiet=quiet)
        return 0
    os.chmod(copy, path.stat().st_mode & 0o777)
    os.replace(copy, out)
    lost = f", {result.lost} bytes belonged to nothing intact" if result.lost else ""
    _say(f"{out}: {result.messages} messages{lost}; {path} stays as it is", quiet=quiet)
    return 0


def _say(text: str, *, quiet: bool) -> None:
    if not quiet:
        say(text)
