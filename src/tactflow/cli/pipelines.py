"""Commands about pipeline files: `tactflow pipelines`, `check`, `schema` and `warmup`."""

from __future__ import annotations

import argparse
import json
from importlib.resources import files

from tactflow.cli.options import add_pipeline, add_quiet, load_plan
from tactflow.cli.sensors import fleet
from tactflow.config.load import load_pipeline, sensor_names
from tactflow.config.shipped import described_pipelines, find_pipeline
from tactflow.engine.errors import ConfigError
from tactflow.engine.graph import Pipeline
from tactflow.engine.plan import Plan
from tactflow.system.terminal import say, show, show_json, table


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `pipelines`."""
    parser.add_argument(
        "name", nargs="?", metavar="NAME", help="print this one, to change a copy: NAME > pipeline.yaml"
    )
    parser.epilog = "for your sensor: tactflow run mini --source 0"


def run(args: argparse.Namespace) -> int:
    """Print the name of each shipped pipeline and what it is for, or one of the files."""
    if args.name is not None:
        print(find_pipeline(args.name).read_text(encoding="utf-8"), end="")
    else:
        show(table(list(described_pipelines().items())))
    return 0


def add_arguments_check(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `check`."""
    add_pipeline(parser)


def run_check(args: argparse.Namespace) -> int:
    """Print one line for each sensor; raises ConfigError with every mistake."""
    names: list[str] = sensor_names(find_pipeline(args.pipeline), args.overrides)
    valid: dict[str | None, tuple[Pipeline, Plan]] = {}
    mistakes: list[str] = []
    for name in names or (None,):
        try:
            valid[name] = load_plan(args, name)
        except ConfigError as error:
            mistakes += error.mistakes
    if len(names) > 1:
        mistakes += fleet().problems({name: pipeline for name, (pipeline, _) in valid.items() if name})
    if mistakes:
        # A mistake that several sensors share is reported once.
        raise ConfigError(*dict.fromkeys(mistakes))
    for name, (pipeline, plan) in valid.items():
        sinks = len(pipeline.sinks)
        counts = {"stage": len(pipeline.nodes) - sinks, "sink": sinks, "segment": len(plan.segments)}
        if warnings := len(pipeline.warnings) + len(plan.warnings):
            counts["warning"] = warnings
        words = ", ".join(f"{count} {noun}{'' if count == 1 else 's'}" for noun, count in counts.items())
        show([f"{pipeline.file}: {f'sensor {name} ' if name else ''}OK ({words})"])
    return 0


def add_arguments_schema(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `schema`."""
    parser.add_argument(
        "what",
        nargs="?",
        choices=("message", "pipeline", "foxglove-layout"),
        default="message",
        help="message: the result message (default); pipeline: a pipeline file; foxglove-layout: not a "
        "schema, but a layout of Foxglove that shows recordings, for Layouts > Import from file",
    )
    parser.add_argument("--sensor", default="main", metavar="NAME", help="of the layout (default: main)")


def run_schema(args: argparse.Namespace) -> int:
    """Print the schema, or the layout."""
    if args.what == "message":
        from tactflow.message.schema import message_schema

        schema = message_schema()
    elif args.what == "foxglove-layout":
        layout = files("tactflow.recording").joinpath("foxglove-layout.json").read_text(encoding="utf-8")
        schema = json.loads(layout.replace("SENSOR", args.sensor))
    else:
        from tactflow.config.registry import catalogue
        from tactflow.config.schema import pipeline_schema

        schema = pipeline_schema(catalogue()[0])
    show_json(schema)
    return 0


def add_arguments_warmup(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `warmup`."""
    add_pipeline(parser)
    add_quiet(parser)


def run_warmup(args: argparse.Namespace) -> int:
    """Load a pipeline as `run` does, and say whether its loops are compiled; returns the exit code.

    Nothing is left to compile: loops are compiled when tactflow is built. Raises ConfigError if the pipeline
    is wrong.
    """
    from tactflow.vision import compiled

    file = find_pipeline(args.pipeline)
    # Loading a pipeline imports its stages, and with them their kernels.
    sensors: list[str | None] = [*sensor_names(file, args.overrides)]
    for sensor in sensors or [None]:
        load_pipeline(file, args.overrides, sensor=sensor)
    compiled.warn_if_plain()
    if not args.quiet and compiled.are_compiled():
        say(f"{len(compiled.kernels())} loops are ready: they were compiled when tactflow was built")
    return 0
