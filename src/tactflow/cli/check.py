"""`tactflow check`: validate a pipeline file without running it."""

from __future__ import annotations

import argparse

from tactflow.cli.opencv import warn_of_conflict
from tactflow.cli.options import add_pipeline, load_plan
from tactflow.cli.printable import printable
from tactflow.config.load import sensor_names
from tactflow.config.shipped import find_pipeline
from tactflow.engine.errors import ConfigError
from tactflow.engine.graph import Pipeline
from tactflow.engine.plan import Plan
from tactflow.fleet.sinks import clash_problems


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `check`."""
    add_pipeline(parser)


def run(args: argparse.Namespace) -> int:
    """Print one line for each sensor if all is right. Raises ConfigError with every mistake if it is not."""
    warn_of_conflict()
    names: list[str] = sensor_names(find_pipeline(args.pipeline), args.overrides)
    good: dict[str | None, tuple[Pipeline, Plan]] = {}
    mistakes: list[str] = []
    for name in names or (None,):
        try:
            good[name] = load_plan(args, name)
        except ConfigError as error:
            mistakes += error.mistakes
    mistakes += clash_problems({name: pipeline for name, (pipeline, _) in good.items() if name is not None})
    if mistakes:
        # What several sensors have in common is said once.
        raise ConfigError(*dict.fromkeys(mistakes))
    for name, (pipeline, plan) in good.items():
        print(printable(_summary(pipeline, plan, name)))
    return 0


def _summary(pipeline: Pipeline, plan: Plan, sensor: str | None) -> str:
    sinks = len(pipeline.sinks)
    counts = (
        _count(len(pipeline.nodes) - sinks, "stage"),
        _count(sinks, "sink"),
        _count(len(plan.segments), "segment"),
    )
    warnings = len(pipeline.warnings) + len(plan.warnings)
    told = ", ".join([*counts, _count(warnings, "warning")] if warnings else counts)
    return f"{pipeline.file}: {f'sensor {sensor} ' if sensor else ''}OK ({told})"


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"
