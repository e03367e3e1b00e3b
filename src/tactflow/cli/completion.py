"""`tactflow completion`: a script that completes commands, options and files in a shell."""

from __future__ import annotations

import argparse
from collections.abc import Iterator

import shtab

_COMPLETED = {
    **dict.fromkeys(("PIPELINE", "SRC", "PATH", "FILE", "FILE.mcap", "run.json"), shtab.FILE),
    "DIR": shtab.DIRECTORY,
}
"""Name of an argument in the help -> how it is completed."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the argument of `completion`."""
    parser.add_argument("shell", choices=shtab.SUPPORTED_SHELLS, metavar="SHELL", help="%(choices)s")
    parser.epilog = 'for bash: eval "$(tactflow completion bash)" in ~/.bashrc'


def run(args: argparse.Namespace) -> int:
    """Print the script."""
    from tactflow.cli.main import COMMANDS, make_parser

    parser = make_parser(COMMANDS)
    for action in _actions(parser):
        if action.metavar in _COMPLETED and action.choices is None:
            action.complete = _COMPLETED[action.metavar]  # type: ignore[attr-defined]
    print(shtab.complete(parser, args.shell))
    return 0


def _actions(parser: argparse.ArgumentParser) -> Iterator[argparse.Action]:
    """Every argument of a parser and of its commands."""
    for action in parser._actions:
        yield action
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                yield from _actions(command)
