"""Options that several commands share, the types of their values, and how they are read."""

from __future__ import annotations

import argparse
import os
import re
from pathlib import Path

from tactflow.cli.terminal import say
from tactflow.config.load import load_pipeline
from tactflow.config.shipped import find_pipeline
from tactflow.engine.errors import ConfigError
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


def add_quiet(parser: argparse.ArgumentParser) -> None:
    """Declare `--quiet`."""
    parser.add_argument("--quiet", action="store_true", help="no progress display and no summary")


def add_json(parser: argparse.ArgumentParser, what: str = "one JSON object instead of text") -> None:
    """Declare `--json`."""
    parser.add_argument("--json", action="store_true", help=what)


def add_overwrite(parser: argparse._ActionsContainer, what: str = "FILE") -> None:
    """Declare `--overwrite`."""
    parser.add_argument("--overwrite", action="store_true", help=f"replace {what} if it is there")


def add_endpoint(parser: argparse.ArgumentParser, default: str) -> None:
    """Declare ENDPOINT and `--keys`."""
    parser.add_argument(
        "endpoint", nargs="?", default=default, metavar="ENDPOINT", help="address; default: %(default)s"
    )
    parser.add_argument(
        "--keys",
        metavar="FOLDER",
        help="the subscriber's folder made by tactflow keys new, where the run requires keys",
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
        If the text is not a length of time.

    >>> seconds("90s"), seconds("1.5min")
    (90.0, 90.0)
    """
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([a-z]*)", text.strip())
    if match is None or match[2] not in UNITS or float(match[1]) <= 0:
        raise argparse.ArgumentTypeError(f"required a time such as 90s, 2min or 1h, got {text!r}")
    return float(match[1]) * UNITS[match[2]]


def refuse_output(option: str, path: Path, *, overwrite: bool) -> None:
    """Find out before the work, not after it, that a file cannot be written.

    option : the option that names the file.

    Raises
    ------
    ConfigError : its folder does not exist or is read-only; it is a folder; it exists and `overwrite` is
        false.
    """
    folder = path.absolute().parent
    if not folder.is_dir():
        raise ConfigError(f"{option}: there is no folder {folder}")
    if not os.access(folder, os.W_OK):
        raise ConfigError(f"{option}: {folder} cannot be written into")
    if path.is_dir():
        raise ConfigError(f"{option}: {path} is a folder; required a file")
    if path.exists() and not overwrite:
        raise ConfigError(f"{option}: {path} is already there; give --overwrite to replace it")
