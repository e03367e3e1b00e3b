"""`tactflow check`: validate a pipeline file without running it."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from tactflow.cli.fleet import clash_problems
from tactflow.cli.options import add_pipeline, load_plan
from tactflow.cli.pipelines import find_pipeline
from tactflow.engine.config import sensor_names
from tactflow.engine.errors import ConfigError
from tactflow.engine.graph import Pipeline
from tactflow.engine.plan import Plan

TITLE = "mistakes in the pipeline"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `check`."""
    add_pipeline(parser)


def run(args: argparse.Namespace) -> int:
    """Print one line for each sensor if all is right. Raises ConfigError with every mistake if it is not."""
    names: list[str] = sensor_names(find_pipeline(args.pipeline), args.overrides)
    good: dict[str | None, tuple[Pipeline, Plan]] = {}
    errors: list[str] = []
    for name in names or (None,):
        try:
            good[name] = load_plan(args, name)
        except ConfigError as error:
            errors.append(str(error))
    errors += clash_problems({name: pipeline for name, (pipeline, _) in good.items() if name is not None})
    if errors:
        raise ConfigError(_all_of(errors))
    for name, (pipeline, plan) in good.items():
        print(_summary(pipeline, plan, name))
    return 0


def _all_of(errors: Sequence[str]) -> str:
    """One text of several; what several sensors have in common is said once."""
    different = list(dict.fromkeys(errors))
    if len(different) == 1:
        return different[0]
    blocks: list[str] = []
    for line in "\n".join(different).splitlines():
        if line.startswith("    ") and blocks:
            # The line of the file with the mistake, and the caret.
            blocks[-1] += f"\n{line}"
        elif not line.endswith(TITLE):
            blocks.append(line)
    blocks = list(dict.fromkeys(blocks))
    return "\n".join([f"{len(blocks)} {TITLE}", *blocks])


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
