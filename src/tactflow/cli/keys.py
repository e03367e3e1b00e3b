"""`tactflow keys`: keys for results that leave this machine."""

from __future__ import annotations

import argparse
from pathlib import Path

from tactflow.cli.printable import typed
from tactflow.engine.errors import ConfigError, StageError
from tactflow.network.keys import WrongKeysError, make_keys
from tactflow.system.signals import ending_held_back


def add_arguments(parser: argparse.ArgumentParser) -> None:
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
        help="where they go; default: keys. The publisher's, once there, stay",
    )


def run(args: argparse.Namespace) -> int:
    """Make them, and print what goes where."""
    try:
        # With only some of the files there, no key works, and none can be made anew.
        with ending_held_back():
            publisher, subscriber = make_keys(args.folder, args.name)
    except WrongKeysError as error:
        raise ConfigError(f"keys: {error}") from None
    except OSError as error:
        raise StageError(f"{args.folder}: keys cannot be written: {error.strerror or error}") from None
    print(f"{publisher} stays here, for the run: {typed('--set', f'sinks.zmq.keys={publisher}')}")
    print(
        f"{subscriber} goes to the subscriber, over a safe way (scp), and to nobody else: "
        f"tactflow listen tcp://HOST:5556 --keys {subscriber.name}"
    )
    return 0
