"""`tactflow control`: tell a running tactflow what to do."""

from __future__ import annotations

import argparse
import json

from tactflow.cli.options import seconds
from tactflow.cli.printable import printable
from tactflow.engine.errors import ConfigError, SourceError, StageError
from tactflow.network.remote_control import DEFAULT_ENDPOINT, RemoteControl

COMMANDS = {
    "take-reference": "take the next frame as the reference",
    "pause": "hold capturing",
    "resume": "go on",
    "record-start": "begin a recording (the pipeline needs a record sink)",
    "record-stop": "finish it",
    "ping": "see whether it is there",
    "stats": "print its statistics so far, as JSON",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `control`."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = "commands:\n" + "\n".join(f"  {name:16}{what}" for name, what in COMMANDS.items())
    parser.description = (
        f"{parser.description}.\nThe run must take commands: tactflow run --set "
        f"sinks.zmq.control={DEFAULT_ENDPOINT}"
    )
    parser.add_argument("do", choices=tuple(COMMANDS), metavar="CMD", help="what to do, see below")
    parser.add_argument(
        "endpoint",
        nargs="?",
        default=DEFAULT_ENDPOINT,
        metavar="ENDPOINT",
        help=f"where it takes commands; default: {DEFAULT_ENDPOINT}",
    )
    parser.add_argument(
        "--keys",
        metavar="FOLDER",
        help="the subscriber's folder that tactflow keys new makes, where the run asks for keys",
    )
    parser.add_argument(
        "--timeout", type=seconds, default=5.0, metavar="S", help="wait S seconds for an answer; default: 5"
    )
    parser.add_argument("--json", action="store_true", help="print the whole answer, a JSON object")


def run(args: argparse.Namespace) -> int:
    """Send the command, and print what happened."""
    try:
        remote = RemoteControl(args.endpoint, args.timeout, args.keys)
    except ValueError as error:
        raise ConfigError(f"control: {error}") from None
    with remote:
        try:
            answer = remote.ask(args.do.replace("-", "_"))
        except (TimeoutError, PermissionError) as error:
            raise SourceError(f"control: {error}") from None
        except RuntimeError as error:
            raise StageError(f"control: {error}") from None
    if args.json:
        print(json.dumps(answer))
    elif "stats" in answer:
        print(json.dumps(answer["stats"], indent=2))
    else:
        print(printable(f"{answer['state']['sensor']}: {answer['message']}"))
    return 0
