"""`tactflow record`: run a pipeline and record its frames and results."""

from __future__ import annotations

import argparse
from pathlib import Path

from tactflow.cli import run as run_command
from tactflow.engine.errors import ConfigError
from tactflow.fleet.names import with_name
from tactflow.recording import missing_packages
from tactflow.system.files import next_name


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `record`: those of `run`, and the file."""
    run_command.add_arguments(parser)
    parser.add_argument(
        "--out",
        required=True,
        type=Path,
        metavar="FILE.mcap",
        help="frames without loss, results, pipeline; tactflow run --source FILE.mcap plays it",
    )
    there = parser.add_mutually_exclusive_group()
    there.add_argument("--overwrite", action="store_true", help="replace FILE.mcap if it is there")
    there.add_argument("--number", action="store_true", help="if it is there, record to FILE-001.mcap, ...")
    parser.add_argument(
        "--rotate-size", type=int, metavar="MB", help="go on in FILE-001.mcap, ... when a file has so many MB"
    )
    parser.add_argument("--rotate-after", type=float, metavar="SECONDS", help="... or when it is so long")


def run(args: argparse.Namespace) -> int:
    """Run the pipeline with a sink that records; returns the exit code.

    Raises
    ------
    ConfigError
        If the file cannot be recorded to, or as `tactflow run` does. Nothing was started.
    """
    problem = missing_packages()
    if problem is not None:
        raise ConfigError(problem)
    if args.out.suffix != ".mcap":
        raise ConfigError(f"--out: required a file whose name ends in .mcap, got {args.out}")
    return run_command.run(args, lambda sensor: _recording(args, sensor))


def _recording(args: argparse.Namespace, sensor: str | None) -> run_command.Sinks:
    """The sink that records one of several sensors, or, for None, the only one."""
    out = args.out if sensor is None else Path(with_name(str(args.out), sensor))
    if out.exists() and args.number:
        out = next_name(out)
    if out.exists() and not args.overwrite:
        raise ConfigError(
            f"--out: {out} is already there; give --overwrite to replace it or --number to record beside it"
        )
    settings = {"use": "record", "path": str(out), "overwrite": args.overwrite}
    rotation = {"rotate_size": args.rotate_size, "rotate_after": args.rotate_after}
    return {"--record": settings | {key: value for key, value in rotation.items() if value is not None}}
