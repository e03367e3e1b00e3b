"""`tactflow check`: validate a pipeline file without running it."""

from __future__ import annotations

import argparse

from tactflow.cli.options import add_pipeline, load_plan


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `check`."""
    add_pipeline(parser)


def run(args: argparse.Namespace) -> int:
    """Print one line if the pipeline is right. Raises ConfigError with every mistake if it is not."""
    pipeline, plan = load_plan(args)
    sinks = len(pipeline.sinks)
    counts = (
        _count(len(pipeline.nodes) - sinks, "stage"),
        _count(sinks, "sink"),
        _count(len(plan.segments), "segment"),
    )
    warnings = len(pipeline.warnings) + len(plan.warnings)
    print(
        f"{pipeline.file}: OK ({', '.join(counts)}{', ' + _count(warnings, 'warning') if warnings else ''})"
    )
    return 0


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"
