"""`tactflow sim`: write a simulated recording and its ground truth."""

from __future__ import annotations

import argparse
from pathlib import Path

from tactflow.cli.options import add_overwrite, add_quiet, refuse_output, writing
from tactflow.engine.errors import ConfigError
from tactflow.system.terminal import progress_bar, say, table


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `sim`."""
    parser.add_argument(
        "name",
        nargs="?",
        metavar="NAME",
        help="a scene, optionally with settings, as in 'press?frames=300&seed=7' (see --list)",
    )
    parser.add_argument("--out", type=Path, metavar="FILE", help="an .npy file for the frames")
    parser.add_argument(
        "--truth",
        type=Path,
        metavar="FILE",
        help=".jsonl (one line a frame), in raw pixels; .csv for force",
    )
    add_overwrite(parser, "either file")
    parser.add_argument("--list", action="store_true", help="print the scenes and their settings")
    add_quiet(parser)


def run(args: argparse.Namespace) -> int:
    """Write the recording; returns the exit code.

    Raises ConfigError where the scene or a path is wrong (nothing was written), StageError where writing
    failed.
    """
    from tactflow.sim import open_scene
    from tactflow.sim.export import TRUTH_SUFFIXES, write_frames, write_truth

    if args.list:
        _list()
        return 0
    if args.name is None:
        raise ConfigError("required the NAME of a scene; tactflow sim --list shows them")
    if args.out is None and args.truth is None:
        raise ConfigError("required --out FILE, --truth FILE, or both: there is nothing to write")
    try:
        scene = open_scene(args.name.removeprefix("sim:"))
    except ValueError as error:
        raise ConfigError(str(error)) from None
    if args.out is not None:
        refuse_output("--out", args.out, overwrite=args.overwrite, suffixes=(".npy",))
    if args.truth is not None:
        refuse_output("--truth", args.truth, overwrite=args.overwrite, suffixes=TRUTH_SUFFIXES)
    for option, path, write in (("--out", args.out, write_frames), ("--truth", args.truth, write_truth)):
        if path is None:
            continue
        with writing(f"{option} {path}"), progress_bar(path.name, len(scene), shown=not args.quiet) as update:
            write(scene, path, lambda done: update(completed=done))
        if not args.quiet:
            say(f"{path}: {len(scene)} frames of {scene.name}")
    return 0


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
