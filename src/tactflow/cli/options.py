"""What the commands that read a pipeline file share."""

from __future__ import annotations

import argparse
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tactflow.cli.notes import say
from tactflow.cli.statistics import read_statistics
from tactflow.config.load import load_pipeline
from tactflow.config.shipped import find_pipeline
from tactflow.engine.graph import Pipeline
from tactflow.engine.plan import Plan, make_plan

UNITS = {"": 1.0, "s": 1.0, "min": 60.0, "h": 3600.0}
"""Unit -> seconds."""


def add_pipeline(parser: argparse.ArgumentParser) -> None:
    """Declare PIPELINE and `--set`."""
    parser.add_argument(
        "pipeline",
        nargs="?",
        metavar="PIPELINE",
        help="default: ./pipeline.yaml, else the packaged one; Python code that it names is run",
    )
    add_overrides(parser)


def add_overrides(parser: argparse.ArgumentParser) -> None:
    """Declare `--set`."""
    parser.add_argument(
        "--set",
        dest="overrides",
        action="append",
        default=[],
        metavar="a.b.c=VALUE",
        help="override one value of the pipeline file; repeatable; null removes a whole stage or sink",
    )


def load_plan(args: argparse.Namespace, sensor: str | None = None) -> tuple[Pipeline, Plan]:
    """Read the pipeline that the arguments name and plan it; warnings go to standard error.

    sensor : which one of several; None is the first.
    """
    pipeline = load_pipeline(find_pipeline(args.pipeline), overrides=args.overrides, sensor=sensor)
    live = bool(getattr(pipeline.source.params, "realtime", False))
    plan = make_plan(pipeline, live=live)
    for warning in (*pipeline.warnings, *plan.warnings):
        say(f"tactflow: warning: {warning}")
    return pipeline, plan


def add_pipeline_and_stats(parser: argparse.ArgumentParser) -> None:
    """Declare PIPELINE, `--set` and `--stats`."""
    add_pipeline(parser)
    parser.add_argument(
        "--stats",
        metavar="run.json",
        help="statistics of a run (tactflow run --stats), to show how often each stage ran and what it cost",
    )


def load_with_stats(args: argparse.Namespace) -> tuple[Pipeline, Plan, Mapping[str, Any] | None]:
    """As `load_plan`, and the content of the statistics file, or None."""
    statistics = None if args.stats is None else read_statistics(Path(args.stats))
    return (*load_plan(args), statistics)


def positive(text: str) -> int:
    """A type of argparse: a whole number from 1."""
    value = int(text) if text.isdecimal() else 0
    if value < 1:
        raise argparse.ArgumentTypeError(f"required a whole number from 1, got {text!r}")
    return value


def seconds(text: str) -> float:
    """A type of argparse: a length of time above 0, s.

    Raises
    ------
    argparse.ArgumentTypeError
        If the text is none.

    >>> seconds("90s"), seconds("1.5min")
    (90.0, 90.0)
    """
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([a-z]*)", text.strip())
    if match is None or match[2] not in UNITS or float(match[1]) <= 0:
        raise argparse.ArgumentTypeError(f"required a time such as 90s, 2min or 1h, got {text!r}")
    return float(match[1]) * UNITS[match[2]]
