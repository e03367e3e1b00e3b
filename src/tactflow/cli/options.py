"""Options that several commands share, and how they are read."""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from tactflow.config.load import load_pipeline
from tactflow.config.shipped import find_pipeline
from tactflow.engine.errors import ConfigError
from tactflow.engine.graph import Pipeline
from tactflow.engine.plan import Plan, make_plan
from tactflow.outputs import cannot_write
from tactflow.system.terminal import say


def add_pipeline(parser: argparse.ArgumentParser) -> None:
    """Declare PIPELINE and `--set`."""
    parser.add_argument(
        "pipeline",
        nargs="?",
        metavar="PIPELINE",
        help="default: ./pipeline.yaml, else the packaged one; Python code that it names is run",
    )
    add_overrides(parser)


def add_source(parser: argparse.ArgumentParser, about: str) -> None:
    """Declare SRC of a command without PIPELINE, which may be given as it is or as `--source SRC`.

    `args.source` is None without it. about : its help.
    """
    parser.add_argument("--source", metavar="SRC", help="the same as SRC, as in 'tactflow run'")
    # Without a default, a missing positional argument does not overwrite the option.
    parser.add_argument("source", nargs="?", default=argparse.SUPPRESS, metavar="SRC", help=about)


def add_sources(parser: argparse.ArgumentParser, name: str, metavar: str, about: str) -> None:
    """Declare SRC ... of a command that takes several; each may be given as it is or as `--source SRC`.

    name : of the positional arguments. `listed_sources` adds those of the option. about : help.
    """
    # Not "*", of which argparse would take none where an option precedes them.
    words = parser.add_argument(name, nargs="+", default=[], metavar=metavar, help=about)
    words.required = False
    parser.add_argument(
        "--source", action="append", default=[], metavar="SRC", help="the same as SRC, as in 'tactflow run'"
    )


def listed_sources(args: argparse.Namespace, name: str) -> list[str]:
    """What the positional arguments and `--source` name. Ends with the usage if there is nothing."""
    words = [*getattr(args, name), *args.source]
    if not words:
        args.parser.error("the following arguments are required: SRC")
    return words


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


def add_sensor(parser: argparse.ArgumentParser) -> None:
    """Declare `--sensor`."""
    parser.add_argument("--sensor", metavar="NAME", help="which one of a pipeline with several sensors")


def add_quiet(parser: argparse.ArgumentParser) -> None:
    """Declare `--quiet`."""
    parser.add_argument("--quiet", action="store_true", help="no progress display and no summary")


def add_overwrite(parser: argparse._ActionsContainer, what: str = "FILE") -> None:
    """Declare `--overwrite`."""
    parser.add_argument("--overwrite", action="store_true", help=f"replace {what} if it exists")


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


def refuse_output(option: str, path: Path, *, overwrite: bool, suffixes: Sequence[str] = ()) -> None:
    """Check before the work that a file can be written; missing folders are made later.

    option : the option that names the file. suffixes : how its name may end; empty for any.

    Raises
    ------
    ConfigError : its name has another suffix; its folder is not a folder, or read-only; it is a folder; it
        exists and `overwrite` is false.
    """
    if suffixes and path.suffix.lower() not in suffixes:
        ends = " or ".join(suffixes)
        raise ConfigError(f"{option}: required a file whose name ends in {ends}, got {path}")
    folder = next(parent for parent in path.absolute().parents if parent.exists())
    if not folder.is_dir():
        raise ConfigError(f"{option}: {path} cannot be made, because {folder} is not a folder")
    if not os.access(folder, os.W_OK):
        raise ConfigError(f"{option}: {folder} cannot be written into")
    if path.is_dir():
        raise ConfigError(f"{option}: {path} is a folder; required a file")
    if path.exists() and not overwrite:
        raise ConfigError(f"{option}: {path} already exists; give --overwrite to replace it")


@contextmanager
def writing(name: Path | str) -> Iterator[None]:
    """Turn an OSError into a StageError. name : of what cannot be written, as the user gave it."""
    try:
        yield
    except OSError as error:
        raise cannot_write(name, error) from error
