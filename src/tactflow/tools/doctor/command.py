"""`tactflow doctor`: what is wrong with a sensor's pictures, its effect, and the remedy."""

from __future__ import annotations

import argparse
import textwrap
from collections.abc import Iterator
from typing import TYPE_CHECKING

from tactflow.engine.errors import StageError
from tactflow.sources import KINDS
from tactflow.system.arguments import seconds
from tactflow.system.redaction import public_address
from tactflow.system.signals import ending_handled, interrupt
from tactflow.system.terminal import progress_bar, show, show_json

if TYPE_CHECKING:
    from tactflow.tools.doctor import Finding

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
    parser.add_argument("--source", required=True, metavar="SRC", help=f"the sensor's pictures: {KINDS}")
    parser.add_argument(
        "--seconds",
        type=seconds,
        default=LIVE_SECONDS,
        metavar="S",
        help=f"how long to observe it; default {LIVE_SECONDS:g}. Leave the gel untouched at the beginning "
        "and end, and press it in between",
    )
    parser.add_argument(
        "--json", action="store_true", help="print all measurements and versions, as a bug report needs them"
    )


def run(args: argparse.Namespace) -> int:
    """Print the findings; returns 0, or 3 if there is a fault, but not for a warning.

    Raises
    ------
    SourceError
        If the source delivers nothing.
    """
    from tactflow.tools.doctor import examine, observe, worst

    # The first signal ends only the observation.
    with ending_handled(interrupt), progress_bar("0 frames") as update:
        observation = observe(args.source, args.seconds, lambda count: update(description=f"{count} frames"))
    findings = examine(observation)
    verdict = worst(findings)
    if args.json:
        from tactflow.recording.provenance import facts

        about = {
            "source": public_address(observation.source),
            "frames": observation.frames,
            "size": observation.pairs[0].image.shape[1::-1],
        }
        show_json({**about, "verdict": verdict, "checks": findings, "versions": facts("", None)})
    else:
        counts = {v: sum(finding.verdict == v for finding in findings) for v in ("fault", "warning")}
        summary = f"{counts['fault']} faults, {counts['warning']} warnings"
        if verdict == "good":
            summary = "no fault was found in these pictures"
        title = f"{observation.description}: {observation.frames} frames observed"
        show([title, *(line for finding in findings for line in _lines(finding)), summary])
    return StageError.exit_code if verdict == "fault" else 0


def _lines(finding: Finding) -> Iterator[str]:
    """A finding: one line, and below it the effect and the remedy of a fault."""
    yield f"  {SIGNS[finding.verdict]:<6} {finding.name:<12} {finding.says}"
    for title, text in (("effect", finding.effect), ("change", finding.advice)):
        if text:
            lines = textwrap.wrap(text, WIDTH - INDENT)
            yield f"{title + ': ':>{INDENT}}{lines[0]}"
            yield from (" " * INDENT + line for line in lines[1:])
