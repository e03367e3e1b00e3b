"""`tactflow doctor`: what is wrong with a sensor's pictures or recordings, its effect, and the remedy."""

from __future__ import annotations

import argparse
import textwrap
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from tactflow.engine.errors import ConfigError, StageError
from tactflow.sources import KINDS
from tactflow.system.arguments import seconds
from tactflow.system.redaction import public_address
from tactflow.system.signals import ending_handled, interrupt
from tactflow.system.terminal import progress_bar, show, show_json

if TYPE_CHECKING:
    from tactflow.recording.verdict import Finding
    from tactflow.tools.doctor.session import Examined, Session

LINE_CHARACTERS = 100
"""Characters of a line."""
INDENT_CHARACTERS = 28
"""Characters before the effect and the remedy of a fault."""
VERDICT_WORDS = {"good": "ok", "warning": "WARN", "fault": "FAULT", "unknown": "?"}
"""Verdict -> how the table shows it."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `doctor`."""
    parser.add_argument(
        "recordings",
        nargs="*",
        metavar="RECORDING",
        help="is it complete, evenly timed, not frozen, damaged or clipped? Several files, or several topics "
        "of one, are a session: are its sensors in step?",
    )
    parser.add_argument("--source", metavar="SRC", help=f"the sensor's pictures: {KINDS}")
    parser.add_argument(
        "--seconds",
        type=seconds,
        metavar="S",
        help="how long to observe it; default: 10 of a camera, all of a recording. Leave the gel of a camera "
        "untouched at the beginning and end, and press it in between",
    )
    parser.add_argument(
        "--json", action="store_true", help="print all measurements and versions, as a bug report needs them"
    )


def run(args: argparse.Namespace) -> int:
    """Print the findings and the verdict; returns 3 for a bad recording or a fault of the sensor, else 0.

    Raises
    ------
    ConfigError
        If nothing is named. SourceError if a source delivers nothing.
    """
    from tactflow.tools.doctor.session import examine_sources

    sources = [*args.recordings, *([] if args.source is None else [args.source])]
    if not sources:
        raise ConfigError("doctor: required a RECORDING, or --source SRC")
    # The first signal ends only the observation.
    with ending_handled(interrupt), progress_bar("0 frames") as update:
        session = examine_sources(sources, args.seconds, lambda count: update(description=f"{count} frames"))
    if args.json:
        show_json(_report(session))
    else:
        show(_table(session))
    return StageError.exit_code if session.has_fault else 0


def _report(session: Session) -> dict[str, Any]:
    """What `--json` prints: of one source its parts, of several a list of those."""
    from tactflow.recording.provenance import facts

    parts = [_part(part) for part in session.parts]
    body = parts[0] if len(parts) == 1 else {"recordings": parts, "together": session.together}
    verdict = {} if session.verdict is None else {"recording": session.verdict.word, "says": session.says}
    return {**body, "verdict": session.worst, **verdict, "versions": facts("", None)}


def _part(part: Examined) -> dict[str, Any]:
    return {
        "source": public_address(part.source),
        "frames": part.frames,
        "size": part.size,
        "checks": part.findings,
    }


def _table(session: Session) -> Iterator[str]:
    """The findings about each source, those about all together, and the verdict as the last line."""
    for part in session.parts:
        yield f"{part.description}: {part.frames} frames observed"
        yield from _rows(part.findings)
    if session.together:
        yield "together"
        yield from _rows(session.together)
    yield session.says


def _rows(findings: Sequence[Finding]) -> Iterator[str]:
    """Findings: one line each, and below it the effect and the remedy of a fault."""
    for finding in findings:
        yield f"  {VERDICT_WORDS[finding.verdict]:<6} {finding.name:<12} {finding.says}"
        for title, text in (("effect", finding.effect), ("change", finding.advice)):
            if text:
                lines = textwrap.wrap(text, LINE_CHARACTERS - INDENT_CHARACTERS)
                yield f"{title + ': ':>{INDENT_CHARACTERS}}{lines[0]}"
                yield from (" " * INDENT_CHARACTERS + line for line in lines[1:])
