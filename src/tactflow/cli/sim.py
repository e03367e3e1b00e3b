"""`tactflow sim`: write a simulated recording and its ground truth."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path

from tactflow.cli.terminal import progress_bar, say, table
from tactflow.engine.errors import ConfigError, StageError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `sim`."""
    parser.add_argument(
        "name",
        nargs="?",
        metavar="NAME",
        help="a scene, with settings if wanted, as in 'press?frames=300&seed=7' (see --list)",
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="FILE",
        help=".npy, .avi or .mkv (lossless), or a folder for numbered PNG files",
    )
    parser.add_argument(
        "--truth",
        type=Path,
        metavar="FILE",
        help=".jsonl (one line a frame) or .npz (with contact masks), in raw pixels; .csv for force",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace files that are already there")
    parser.add_argument("--list", action="store_true", help="print the scenes and the settings they know")
    parser.add_argument("--quiet", action="store_true", help="no progress display and no summary")


def run(args: argparse.Namespace) -> int:
    """Write the recording; returns the exit code.

    Raises ConfigError where the scene or a path is wrong (nothing was written), StageError where writing
    failed.
    """
    from tactflow.sim import open_scene
    from tactflow.sim.export import TRUTH_SUFFIXES, frames_kind, write_frames, write_truth

    if args.list:
        _list()
        return 0
    if args.name is None:
        raise ConfigError("required the NAME of a scene; tactflow sim --list shows them")
    if args.out is None and args.truth is None:
        raise ConfigError("required --out FILE, --truth FILE, or both: there is nothing to write")
    try:
        scene = open_scene(args.name.removeprefix("sim:"))
        if args.out is not None:
            frames_kind(args.out)
    except ValueError as error:
        raise ConfigError(str(error)) from None
    if args.truth is not None and args.truth.suffix.lower() not in TRUTH_SUFFIXES:
        raise ConfigError(f"--truth: required a {', '.join(TRUTH_SUFFIXES)} file, got {args.truth}")
    jobs = [("--out", args.out, write_frames), ("--truth", args.truth, write_truth)]
    for option, path, _write in jobs:
        if path is not None:
            _check_place(option, path, args.overwrite)
    if args.out is not None and args.truth is not None and args.out.absolute() == args.truth.absolute():
        raise ConfigError(f"--out and --truth are the same file: {args.out}")
    for option, path, write in jobs:
        if path is None:
            continue
        try:
            with progress_bar(path.name, len(scene), shown=not args.quiet) as update:
                write(scene, path, partial(_show, update))
        except OSError as error:
            # Its text names the unfinished file.
            raise StageError(f"{option} {path}: cannot be written: {error.strerror or error}") from error
        if not args.quiet:
            say(f"{path}: {len(scene)} frames of {scene.name}")
    return 0


def _show(update: Callable[..., None], done: int) -> None:
    update(completed=done)


def _check_place(option: str, path: Path, overwrite: bool) -> None:
    if path.is_dir() and option == "--truth":
        raise ConfigError(f"{option}: {path} is a folder; required a file")
    if path.exists() and not overwrite:
        raise ConfigError(f"{option}: {path} is already there; give --overwrite to replace it")
    # Replacing a folder deletes it: only one that holds nothing but images of ours may go.
    if path.is_dir() and any(item.suffix != ".png" or not item.stem.isdecimal() for item in path.iterdir()):
        raise ConfigError(f"{option}: {path} holds other files than numbered PNG images; name another folder")
    parent = path.absolute().parent
    while not parent.exists():
        parent = parent.parent
    if not parent.is_dir():
        raise ConfigError(f"{option}: {path} cannot be made, because {parent} is not a folder")


def _list() -> None:
    from tactflow.sim import scene_descriptions
    from tactflow.sim.settings import setting_descriptions

    for title, lines in (
        ("scenes:", scene_descriptions()),
        ("settings, as in NAME?key=value&key=value:", setting_descriptions()),
    ):
        print(title)
        for line in table(list(lines.items())):
            print(f"  {line}")
