"""`tactflow control`: tell a running tactflow what to do; `tactflow keys`: keys for those who may."""

from __future__ import annotations

import argparse
from pathlib import Path

from tactflow.cli.options import add_endpoint, writing
from tactflow.engine.errors import ConfigError, SourceError, StageError
from tactflow.network.keys import WrongKeysError, make_keys
from tactflow.network.remote_control import DEFAULT_ENDPOINT, RemoteControl
from tactflow.system.arguments import seconds
from tactflow.system.terminal import show, show_json, typed

COMMANDS = {
    "take-reference": "take the next frame as the reference",
    "pause": "pause capturing",
    "resume": "resume capturing",
    "record-start": "start a recording (the pipeline needs a record sink)",
    "record-stop": "finish it",
    "ping": "check whether it answers",
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
    add_endpoint(parser, DEFAULT_ENDPOINT)
    parser.add_argument(
        "--timeout", type=seconds, default=5.0, metavar="S", help="wait S seconds for an answer; default: 5"
    )


def run(args: argparse.Namespace) -> int:
    """Send the command, and print the answer."""
    try:
        with RemoteControl(args.endpoint, args.timeout, args.keys) as remote:
            answer = remote.ask(args.do.replace("-", "_"))
    except ValueError as error:
        raise ConfigError(f"control: {error}") from None
    except (TimeoutError, PermissionError) as error:
        raise SourceError(f"control: {error}") from None
    except RuntimeError as error:
        raise StageError(f"control: {error}") from None
    if "stats" in answer:
        show_json(answer["stats"])
    else:
        show([f"{answer['state']['sensor']}: {answer['message']}"])
    return 0


def add_arguments_keys(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `keys`."""
    actions = parser.add_subparsers(dest="action", required=True)
    new = actions.add_parser("new", help="make keys for a subscriber")
    new.add_argument(
        "name", nargs="?", default="subscriber", metavar="NAME", help="of the subscriber; default: subscriber"
    )
    new.add_argument(
        "--folder",
        type=Path,
        default=Path("keys"),
        metavar="FOLDER",
        help="where to write them; default: keys. Existing keys of the publisher are kept",
    )


def run_keys(args: argparse.Namespace) -> int:
    """Make keys, and print what goes where."""
    try:
        with writing(args.folder):
            publisher, subscriber = make_keys(args.folder, args.name)
    except WrongKeysError as error:
        raise ConfigError(f"keys: {error}") from None
    print(f"{publisher} stays here, for the run: {typed('--set', f'sinks.zmq.keys={publisher}')}")
    print(
        f"{subscriber} goes to the subscriber, over a secure channel (scp); share it with nobody else: "
        f"tactflow listen tcp://HOST:5556 --keys {subscriber.name}"
    )
    return 0
