"""`tactflow record`: run a pipeline and record its frames and results."""

from __future__ import annotations

import argparse
from pathlib import Path

from tactflow.cli import run as run_command
from tactflow.engine.errors import ConfigError
from tactflow.recording import missing_packages
from tactflow.recording.names import next_name


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


def run(args: argparse.Namespace) -> int:
    """Run the pipeline with a sink that records; returns the exit code.

    Raises
    ------
    ConfigError
        If the file cannot be recorded to, or as `tactflow run` does. Nothing was started.
    """
    out: Path = args.out
    problem = missing_packages()
    if problem is not None:
        raise ConfigError(problem)
    if out.suffix != ".mcap":
        raise ConfigError(f"--out: required a file whose name ends in .mcap, got {out}")
    if out.exists() and args.number:
        out = next_name(out)
    if out.exists() and not args.overwrite:
        raise ConfigError(
            f"--out: {out} is already there; give --overwrite to replace it or --number to record beside it"
        )
    args.extra_sinks = {"--record": {"use": "record", "path": str(out), "overwrite": args.overwrite}}
    return run_command.run(args)
