"""`tactflow completion`: a script that completes commands, options and files in a shell."""

from __future__ import annotations

import argparse
from collections.abc import Iterator

import shtab

_PIPELINES = {
    "bash": "_tactflow_files",
    "zsh": "_files -g '*.yaml'",
    "tcsh": "f:*.yaml",
    "fish": "(__fish_complete_suffix .yaml)",
}
_PREAMBLE = {
    "bash": """
_tactflow_files() {
  compgen -d -- "$1"
  compgen -f -X '!*.yaml' -- "$1"
}
"""
}
_COMPLETED = {
    "PIPELINE": _PIPELINES,
    "SRC": shtab.FILE,
    "PATH": shtab.FILE,
    "FILE": shtab.FILE,
    "FILE.mcap": shtab.FILE,
    "run.json": shtab.FILE,
    "DIR": shtab.DIRECTORY,
}
"""What an argument is called in the help -> shell -> how it is completed."""


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
    print(shtab.complete(parser, args.shell, preamble=_PREAMBLE.get(args.shell, "")))
    return 0


def _actions(parser: argparse.ArgumentParser) -> Iterator[argparse.Action]:
    """Every argument of a parser and of its commands."""
    for action in parser._actions:
        yield action
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                yield from _actions(command)
