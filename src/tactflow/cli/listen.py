"""`tactflow listen`: print what a running tactflow publishes."""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections import deque

import numpy as np

from tactflow.cli.options import positive, seconds
from tactflow.cli.terminal import printable
from tactflow.engine.errors import ConfigError, SourceError
from tactflow.message.result import Result
from tactflow.network.subscriber import DEFAULT_ENDPOINT, Subscriber
from tactflow.system.signals import ending_handled, interrupt
from tactflow.vision.types import Markers, MarkerStatus


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `listen`."""
    parser.add_argument(
        "endpoint",
        nargs="?",
        default=DEFAULT_ENDPOINT,
        metavar="ENDPOINT",
        help=f"default: {DEFAULT_ENDPOINT}",
    )
    parser.add_argument("--sensor", metavar="NAME", help="only this sensor; default: all")
    parser.add_argument(
        "--keys",
        metavar="FOLDER",
        help="the subscriber's folder that tactflow keys new makes, where the publisher asks for keys",
    )
    form = parser.add_mutually_exclusive_group()
    form.add_argument("--json", action="store_true", help="the messages as they are, one JSON object a line")
    form.add_argument("--table", action="store_true", help="a live table of the latest values, on a terminal")
    parser.add_argument("--latest", action="store_true", help="skip what is out of date; keep up at any rate")
    parser.add_argument("--count", type=positive, metavar="N", help="end after N messages")
    parser.add_argument(
        "--timeout",
        type=seconds,
        metavar="S",
        help="end when no message has come for S seconds; an error (exit code 4) if none came at all",
    )


def run(args: argparse.Namespace) -> int:
    """Print until `--count`, `--timeout` or Ctrl-C; returns the exit code."""
    if args.table and not sys.stdout.isatty():
        raise ConfigError("--table needs a terminal; for a pipe or a file, leave it out or use --json")
    try:
        subscriber = Subscriber(
            args.endpoint, args.sensor, latest=args.latest, timeout=args.timeout, keys=args.keys
        )
    except ValueError as error:
        raise ConfigError(f"listen: {error}") from None
    if sys.stderr.isatty():
        print(f"listening to {args.endpoint}; Ctrl-C ends", file=sys.stderr)
    show = _table if args.table else _json_lines if args.json else _lines
    try:
        with ending_handled(interrupt), subscriber:
            show(subscriber, math.inf if args.count is None else args.count)
    except TimeoutError as error:
        if subscriber.received == 0:
            raise SourceError(f"listen: {error}") from None
    except PermissionError as error:
        raise SourceError(f"listen: {error}") from None
    except KeyboardInterrupt:
        pass
    return 0


def describe(result: Result) -> str:
    """A result in one line for people."""
    contact, flow, markers = result.contact, result.flow, result.markers
    parts = [f"{result.sensor} {result.seq}", f"t {result.t:.3f} s"]
    if contact is not None:
        parts.append(f"contact {contact.area:.0f} px^2 at {_pair(contact.center, '.1f')}")
        parts.append(f"angle {_angle(contact.angle)}")
    else:
        parts.append(_missing("contact", result, "no contact"))
    if flow is not None:
        mean = "-" if flow.mean is None else f"{_pair(flow.mean, '+.2f')} px"
        parts.append(f"flow {mean} of {flow.count}")
    if markers is not None:
        parts.append(f"markers {_tracked(markers)}")
    return printable("  ".join(parts))


def _missing(port: str, result: Result, usual: str) -> str:
    reason = result.skipped.get(port, "no_contact")
    return usual if reason == "no_contact" else f"no {port} ({reason})"


def _pair(pair: tuple[float, float], form: str) -> str:
    return f"({pair[0]:{form}}, {pair[1]:{form}})"


def _tracked(markers: Markers) -> str:
    return f"{np.count_nonzero(markers.status == MarkerStatus.TRACKED)}/{len(markers.status)}"


def _angle(angle: float | None) -> str:
    return "-" if angle is None else f"{angle:.1f} deg"


def _lines(subscriber: Subscriber, count: float) -> None:
    lost = 0
    while subscriber.received < count:
        line = describe(subscriber.receive())
        if subscriber.lost > lost:
            line += f"  ({subscriber.lost - lost} lost)"
            lost = subscriber.lost
        print(line, flush=True)


def _json_lines(subscriber: Subscriber, count: float) -> None:
    out = sys.stdout.buffer
    while subscriber.received < count:
        body = subscriber.receive_json()
        out.write((printable(body.decode(errors="replace")).encode() if out.isatty() else body) + b"\n")
        out.flush()


def _table(subscriber: Subscriber, count: float) -> None:
    from rich.live import Live
    from rich.table import Table
    from rich.text import Text

    rows: dict[str, tuple[Result, deque[float]]] = {}

    def table() -> Table:
        shown = Table("sensor", "seq", "contact", "area, px^2", "angle, deg", "flow, px", "markers", "Hz")
        for sensor, (result, arrivals) in sorted(rows.items()):
            shown.add_row(Text(printable(sensor)), *_cells(result), _rate(arrivals))
        shown.caption = f"{subscriber.received} received, {subscriber.lost} lost"
        return shown

    with Live(table(), get_renderable=table, refresh_per_second=10):
        while subscriber.received < count:
            result = subscriber.receive()
            arrivals = rows.get(result.sensor, (result, deque[float](maxlen=60)))[1]
            arrivals.append(time.monotonic())
            rows[result.sensor] = (result, arrivals)


def _cells(result: Result) -> list[str]:
    contact, flow, markers = result.contact, result.flow, result.markers
    return [
        str(result.seq),
        "no" if contact is None else _pair(contact.center, ".1f"),
        "" if contact is None else f"{contact.area:.0f}",
        "" if contact is None else _angle(contact.angle).removesuffix(" deg"),
        "" if flow is None or flow.mean is None else _pair(flow.mean, "+.2f"),
        "" if markers is None else _tracked(markers),
    ]


def _rate(arrivals: deque[float]) -> str:
    span = arrivals[-1] - arrivals[0]
    return f"{(len(arrivals) - 1) / span:.0f}" if span > 0 else ""
