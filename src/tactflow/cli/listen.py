"""`tactflow listen`: print what a running tactflow publishes."""

from __future__ import annotations

import argparse
import math
import sys

import numpy as np

from tactflow.cli.options import add_endpoint
from tactflow.engine.errors import ConfigError, SourceError
from tactflow.message.result import Result
from tactflow.network.subscriber import DEFAULT_ENDPOINT, Subscriber
from tactflow.system.arguments import positive, seconds
from tactflow.system.signals import ending_handled, interrupt
from tactflow.system.terminal import printable, say
from tactflow.vision.types import MarkerStatus


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `listen`."""
    add_endpoint(parser, DEFAULT_ENDPOINT)
    parser.add_argument("--sensor", metavar="NAME", help="only this sensor; default: all")
    parser.add_argument(
        "--json", action="store_true", help="print the messages unchanged, one JSON object per line"
    )
    parser.add_argument(
        "--latest", action="store_true", help="print only the newest results, skipping older ones"
    )
    parser.add_argument("--count", type=positive, metavar="N", help="end after N messages")
    parser.add_argument(
        "--timeout",
        type=seconds,
        metavar="S",
        help="end when no message has arrived for S seconds; an error (exit code 4) if none arrived at all",
    )


def run(args: argparse.Namespace) -> int:
    """Print until `--count`, `--timeout` or Ctrl-C; returns the exit code."""
    try:
        subscriber = Subscriber(
            args.endpoint, args.sensor, latest=args.latest, timeout=args.timeout, keys=args.keys
        )
    except ValueError as error:
        raise ConfigError(f"listen: {error}") from None
    if sys.stderr.isatty():
        say(f"listening to {args.endpoint}; Ctrl-C ends")
    show = _print_json if args.json else _print_lines
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


def _print_json(subscriber: Subscriber, count: float) -> None:
    out = sys.stdout.buffer
    while subscriber.received < count:
        body = subscriber.receive_json()
        out.write((printable(body.decode(errors="replace")).encode() if out.isatty() else body) + b"\n")
        out.flush()


def _print_lines(subscriber: Subscriber, count: float) -> None:
    lost = 0
    while subscriber.received < count:
        line = describe(subscriber.receive())
        if subscriber.lost > lost:
            line += f"  ({subscriber.lost - lost} messages lost)"
            lost = subscriber.lost
        print(line, flush=True)


def describe(result: Result) -> str:
    """A result in one line for people."""
    contact, flow, markers = result.contact, result.flow, result.markers
    parts = [f"{result.sensor} {result.seq}", f"t {result.t:.3f} s"]
    if contact is not None:
        parts.append(f"contact {contact.area:.0f} px^2 at {_pair(contact.center, '.1f')}")
        parts.append("no direction" if contact.angle is None else f"angle {contact.angle:.1f} deg")
    else:
        reason = result.skipped.get("contact", "no_contact")
        parts.append("no contact" if reason == "no_contact" else f"no contact ({reason})")
    if flow is not None:
        mean = "unknown" if flow.mean is None else f"{_pair(flow.mean, '+.2f')} px"
        parts.append(f"flow {mean} ({flow.count} dots)")
    if markers is not None:
        tracked = np.count_nonzero(markers.status == MarkerStatus.TRACKED)
        parts.append(f"dots {tracked}/{len(markers.status)}")
    return printable("  ".join(parts))


def _pair(pair: tuple[float, float], form: str) -> str:
    return f"({pair[0]:{form}}, {pair[1]:{form}})"
