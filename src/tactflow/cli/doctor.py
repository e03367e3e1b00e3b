"""`tactflow doctor`: what is wrong with a sensor's pictures, what it does, and what to change."""

from __future__ import annotations

import argparse
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from tactflow.cli.options import add_json, seconds
from tactflow.cli.terminal import progress_bar, show, show_json
from tactflow.engine.errors import StageError
from tactflow.sources import KINDS
from tactflow.system.signals import ending_handled, interrupt

if TYPE_CHECKING:
    from tactflow.doctor import Finding, Observation

LIVE_SECONDS = 10.0
"""How long a source is looked at unless told otherwise, s: time for some presses."""
WIDTH = 100
"""Characters of a line."""
INDENT = 28
"""Characters before what a fault does and what to change."""
SIGNS = {"good": "ok", "warning": "WARN", "fault": "FAULT", "unknown": "?"}
"""Verdict -> how the table shows it."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `doctor`."""
    parser.add_argument("--source", required=True, metavar="SRC", help=f"of the sensor: {KINDS}")
    parser.add_argument(
        "--seconds",
        type=seconds,
        default=LIVE_SECONDS,
        metavar="S",
        help=f"how much of it to look at; default {LIVE_SECONDS:g}. Leave the gel untouched at first and at "
        "last, and press it in between",
    )
    add_json(parser)
    parser.add_argument("--html", type=Path, metavar="FILE", help="also write the table as a page")


def run(args: argparse.Namespace) -> int:
    """Print the findings; returns 0, or 3 if there is a fault (a warning is none).

    Raises
    ------
    SourceError
        If the source delivers nothing.
    """
    from tactflow.doctor import examine, observe, worst

    # The first signal ends only the look at the source.
    with ending_handled(interrupt), progress_bar("0 frames") as update:
        seen = observe(args.source, args.seconds, lambda count: update(description=f"{count} frames"))
    findings = examine(seen)
    verdict = worst(findings)
    title = f"{seen.description}: {seen.frames} frames looked at"
    counts = {v: sum(finding.verdict == v for finding in findings) for v in ("fault", "warning")}
    summary = f"{counts['warning']} to look at"
    if verdict == "fault":
        summary = f"{counts['fault']} to change, {summary}"
    elif verdict == "good":
        summary = "nothing is wrong with these pictures"
    if args.html is not None:
        _write_page(args.html, title, summary, seen, findings)
    if args.json:
        facts = {"source": seen.source, "frames": seen.frames, "verdict": verdict}
        show_json({**facts, "checks": findings})
    else:
        show([title, *(line for finding in findings for line in _lines(finding)), summary])
    return StageError.exit_code if verdict == "fault" else 0


def _lines(finding: Finding) -> Iterator[str]:
    """A finding: one line, and below it what a fault does and what to change."""
    yield f"  {SIGNS[finding.verdict]:<6} {finding.name:<12} {finding.says}"
    for title, text in (("effect", finding.effect), ("change", finding.advice)):
        if text:
            lines = textwrap.wrap(text, WIDTH - INDENT)
            yield f"{title + ': ':>{INDENT}}{lines[0]}"
            yield from (" " * INDENT + line for line in lines[1:])


def _write_page(path: Path, title: str, summary: str, seen: Observation, findings: list[Finding]) -> None:
    from tactflow.report import Section, Table, mark, picture, write_report

    rows = [
        [mark(SIGNS[f.verdict], f.verdict in ("good", "unknown")), f.name, f.says, f.effect, f.advice]
        for f in findings
    ]
    table = Table(["", "check", "measured", "effect", "what to change"], rows)
    write_report(path, title, [Section(summary, pictures=[picture(seen.pairs[0].image)], tables=[table])])
