"""`tactflow doctor`: what is wrong with a sensor's pictures, its effect, and the remedy."""

from __future__ import annotations

import argparse
import textwrap
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from tactflow.cli.cameras import describe_hub
from tactflow.cli.options import add_json
from tactflow.config.load import load_pipeline, sensor_names
from tactflow.config.shipped import find_pipeline
from tactflow.engine.errors import ConfigError, StageError
from tactflow.sources import KINDS
from tactflow.system.arguments import seconds
from tactflow.system.signals import ending_handled, interrupt
from tactflow.system.terminal import progress_bar, show, show_json, table

if TYPE_CHECKING:
    from tactflow.doctor import Finding

LIVE_SECONDS = 10.0
"""How long a source is observed by default, s: time for some presses."""
WIDTH = 100
"""Characters of a line."""
INDENT = 28
"""Characters before the effect and the remedy of a fault."""
SIGNS = {"good": "ok", "warning": "WARN", "fault": "FAULT", "unknown": "?"}
"""Verdict -> how the table shows it."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `doctor`."""
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--source", metavar="SRC", help=f"check the pictures of one sensor: {KINDS}")
    what.add_argument(
        "pipeline",
        nargs="?",
        metavar="PIPELINE",
        help="read all sensors of a pipeline file together, and compare the frame rates requested, promised "
        "by the drivers and received",
    )
    parser.add_argument(
        "--seconds",
        type=seconds,
        default=LIVE_SECONDS,
        metavar="S",
        help=f"how long to observe it; default {LIVE_SECONDS:g}. Leave the gel untouched at the beginning "
        "and end, and press it in between",
    )
    add_json(parser)
    parser.add_argument(
        "--report",
        type=Path,
        metavar="FILE",
        help="also write what a bug report needs into one JSON file: versions, pipeline, measurements; "
        "without passwords and tokens",
    )
    parser.add_argument(
        "--pipeline", dest="reported", metavar="PIPELINE", help="for --report: the pipeline file to include"
    )
    parser.add_argument("--picture", action="store_true", help="for --report: include the first frame")


def run(args: argparse.Namespace) -> int:
    """Print the findings; returns 0, or 3 if there is a fault, but not for a warning.

    Raises
    ------
    ConfigError
        If there is no such pipeline, or the report cannot be written.
    SourceError
        If the source delivers nothing.
    """
    if args.source is None:
        return _run_together(args)
    from tactflow.doctor import examine, observe, worst
    from tactflow.doctor.bug_report import write_bug_report

    pipeline = find_pipeline(args.reported)
    # The first signal ends only the observation.
    with ending_handled(interrupt), progress_bar("0 frames") as update:
        observation = observe(args.source, args.seconds, lambda count: update(description=f"{count} frames"))
    findings = examine(observation)
    verdict = worst(findings)
    title = f"{observation.description}: {observation.frames} frames observed"
    counts = {v: sum(finding.verdict == v for finding in findings) for v in ("fault", "warning")}
    summary = f"{counts['fault']} faults, {counts['warning']} warnings"
    if verdict == "good":
        summary = "no fault was found in these pictures"
    if args.report is not None:
        try:
            text = pipeline.read_text("utf-8")
            write_bug_report(args.report, observation, findings, text, picture=args.picture)
        except OSError as error:
            raise ConfigError(f"--report: {args.report} cannot be written: {error.strerror}") from None
    if args.json:
        facts = {"source": observation.source, "frames": observation.frames, "verdict": verdict}
        show_json({**facts, "checks": findings})
    else:
        show([title, *(line for finding in findings for line in _lines(finding)), summary])
    return StageError.exit_code if verdict == "fault" else 0


def _run_together(args: argparse.Namespace) -> int:
    """Print the rates of all sensors of a pipeline; returns 0, or 3 if one is far too slow."""
    from tactflow.doctor import Sensor, measure_together

    if args.report is not None:
        raise ConfigError("--report is for the pictures of one sensor: give --source")
    file = find_pipeline(args.pipeline)
    names: list[str | None] = [*sensor_names(file)] or [None]
    loaded = [load_pipeline(file, sensor=name) for name in names]
    unfit = [p.source.component.name for p in loaded if p.source.component.name != "capture"]
    if unfit:
        raise ConfigError(f"{file}: doctor can only read sources of the stage capture, not of {unfit[0]}")
    sensors = [Sensor.of(pipeline.sensor, pipeline.source.params) for pipeline in loaded]
    with progress_bar(f"{len(sensors)} sensors together"):
        together = measure_together(sensors, args.seconds)
    if args.json:
        show_json(asdict(together))
    else:
        rows = [("SENSOR", "ASKED", "PROMISED", "GOT", "SOURCE")]
        rows += [
            (r.sensor, _rate(r.asked), _rate(r.promised), _rate(r.got), r.description or "cannot be opened")
            for r in together.rates
        ]
        show([*table(rows), *(line for hub in together.hubs for line in describe_hub(hub))])
        show([f"  {line}" for line in together.advice] or ["every sensor delivers what was asked of it"])
    return StageError.exit_code if together.fault else 0


def _rate(rate: float | None) -> str:
    return "-" if rate is None else f"{rate:.3g}/s"


def _lines(finding: Finding) -> Iterator[str]:
    """A finding: one line, and below it the effect and the remedy of a fault."""
    yield f"  {SIGNS[finding.verdict]:<6} {finding.name:<12} {finding.says}"
    for title, text in (("effect", finding.effect), ("change", finding.advice)):
        if text:
            lines = textwrap.wrap(text, WIDTH - INDENT)
            yield f"{title + ': ':>{INDENT}}{lines[0]}"
            yield from (" " * INDENT + line for line in lines[1:])
