"""`tactflow doctor`: what is wrong with a sensor's pictures, what it does, and what to change."""

from __future__ import annotations

import argparse
import sys
import textwrap
from collections.abc import Iterator
from dataclasses import asdict
from typing import TYPE_CHECKING

import orjson

from tactflow.cli.options import seconds
from tactflow.cli.printable import printable
from tactflow.engine.errors import StageError
from tactflow.sources import KINDS
from tactflow.system.signals import ending_handled, interrupt

if TYPE_CHECKING:
    from tactflow.doctor import Finding

LIVE_SECONDS = 10.0
"""How long a source is looked at unless told otherwise, s. Chosen by hand."""
WIDTH = 100
"""Characters of a line. Chosen by hand."""
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
    parser.add_argument("--json", action="store_true", help="one JSON object instead of the table")


def run(args: argparse.Namespace) -> int:
    """Print the findings; returns 0, or 3 if there is a fault (a warning is none).

    Raises
    ------
    SourceError
        If the source delivers nothing.
    """
    from tactflow.doctor import examine, observe
    from tactflow.doctor.checks import worst

    # The first ends only the look at the source.
    with ending_handled(interrupt):
        seen = observe(args.source, args.seconds, _progress)
    _progress(0)
    findings = examine(seen)
    verdict = worst(findings)
    if args.json:
        told = {"source": seen.source, "frames": seen.frames, "verdict": verdict}
        print(orjson.dumps({**told, "checks": [asdict(finding) for finding in findings]}).decode())
    else:
        print(printable(f"{seen.description}: {seen.frames} frames looked at"))
        for finding in findings:
            print(printable("\n".join(_lines(finding))))
        print(SUMMARY[verdict].format(*(sum(f.verdict == v for f in findings) for v in ("fault", "warning"))))
    return StageError.exit_code if verdict == "fault" else 0


SUMMARY = {
    "good": "nothing is wrong with these pictures",
    "warning": "{1} to look at",
    "fault": "{0} to change, {1} to look at",
}
"""Verdict -> the last line."""


def _lines(finding: Finding) -> Iterator[str]:
    """A finding: one line, and below it what a fault does and what to change."""
    yield f"  {SIGNS[finding.verdict]:<6} {finding.name:<12} {finding.says}"
    for title, text in (("effect", finding.effect), ("change", finding.advice)):
        if text:
            lines = textwrap.wrap(text, WIDTH - INDENT)
            yield f"{title + ': ':>{INDENT}}{lines[0]}"
            yield from (" " * INDENT + line for line in lines[1:])


def _progress(frames: int) -> None:
    """Tell on a terminal how many frames came; 0 clears the line."""
    if sys.stderr.isatty() and frames % 10 == 0:
        print(f"\r{frames} frames ..." if frames else "\r\x1b[K", end="", file=sys.stderr, flush=True)
