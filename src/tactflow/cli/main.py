"""The command line of `tactflow`: finds the command, runs it, turns errors into messages and exit codes."""

from __future__ import annotations

import argparse
import os
import re
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Final, NoReturn

from tactflow import __version__
from tactflow.engine.errors import ConfigError, TactflowError
from tactflow.system.redaction import public_address
from tactflow.system.signals import INTERRUPTED
from tactflow.system.spelling import closest, did_you_mean
from tactflow.system.terminal import printable, say

COMMANDS: Final[dict[str, tuple[str, str]]] = {
    "run": ("run", "run a pipeline"),
    "check": ("pipelines", "validate a pipeline file without running it; prints every mistake at once"),
    "start": ("start", "set up a sensor, step by step: from the camera to a pipeline file and live results"),
    "explain": ("explain", "why each stage runs, is skipped or is left out, and what it cost"),
    "graph": ("explain", "print a pipeline as a Mermaid flowchart"),
    "pipelines": ("pipelines", "list the pipelines that come with tactflow, one for each kind of sensor"),
    "stages": ("stages", "list the stages and sinks that can be used, their ports and parameters"),
    "listen": ("listen", "print what a running tactflow publishes"),
    "control": ("control", "tell a running tactflow to pause, to take a reference, to record"),
    "keys": ("control", "make keys that encrypt results sent over a network"),
    "bench": ("bench", "measure run time against error, per method and for whole pipelines"),
    "warmup": ("pipelines", "compile what `run` would compile on its first use"),
    "batch": ("batch", "run a pipeline over many recordings; a second call does what is missing"),
    "record": ("run", "run a pipeline and record its frames and results"),
    "export": ("recordings", "make a dataset from recordings: HDF5, Zarr, LeRobot and others"),
    "repair": ("recordings", "copy what is intact in a damaged or unfinished recording, with an index"),
    "calibrate": ("calibrate", "make a sensor's calibration file, or check whether it still fits"),
    "detect": ("detect", "find the dots of a gel, and show what was found and why in one picture"),
    "doctor": (
        "doctor",
        "diagnose a sensor's pictures: what is wrong, its effect on the errors, and what to change",
    ),
    "tune": (
        "tune",
        "find the cheapest pipeline within an error budget, for one sensor, from a recording of it",
    ),
    "cameras": ("cameras", "list the cameras that are plugged in, with names that stay the same"),
    "sim": ("sim", "write a simulated recording and its ground truth"),
    "schema": ("pipelines", "print the JSON Schema of the result message or of a pipeline file"),
}
"""Command -> module in `tactflow.cli`, and what the command does.

The module has `add_arguments(parser)` and `run(args) -> exit code` for the command of its own name, and
`add_arguments_NAME`, `run_NAME` for every other. It is imported only when one of its commands is used.
"""


def main(argv: Sequence[str], before_run: Callable[[], object] = lambda: None) -> int:
    """Run the program with these arguments; returns its exit code.

    before_run : called when the command is imported and its arguments are valid.
    """
    try:
        args = _parse(argv)
        before_run()
        return int(args.run(args))
    except TactflowError as error:
        mistakes = error.mistakes if isinstance(error, ConfigError) and len(error.mistakes) > 1 else ()
        say(f"tactflow: {len(mistakes)} mistakes" if mistakes else public_address(f"tactflow: {error}"))
        for mistake in mistakes:
            say(public_address(mistake))
        return error.exit_code
    except KeyboardInterrupt:
        return INTERRUPTED
    except SystemExit as error:
        return error.code if isinstance(error.code, int) else 0


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        super().error(public_address(printable(message)))


def make_parser(command: str | None) -> argparse.ArgumentParser:
    """The parser of the command line.

    command : the one whose arguments it knows; its module is imported.
    """
    parser = _Parser(
        prog="tactflow",
        description="From camera frames of a tactile sensor to contact geometry and marker flow.",
        epilog="'tactflow COMMAND --help' explains one command.",
        allow_abbrev=False,
    )
    parser.add_argument("--version", action="version", version=f"tactflow {__version__}")
    subparsers = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for name, (module_name, summary) in COMMANDS.items():
        subparser = subparsers.add_parser(name, help=summary, description=summary, allow_abbrev=False)
        if name == command:
            module = import_module(f"tactflow.cli.{module_name}")
            suffix = "" if name == module_name else f"_{name}"
            getattr(module, f"add_arguments{suffix}")(subparser)
            subparser.set_defaults(run=getattr(module, f"run{suffix}"), parser=subparser)
    return parser


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    command = next((word for word in argv if not word.startswith("-")), None)
    parser = make_parser(command)
    if command is not None and command not in COMMANDS:
        parser.error(f"there is no command {command}{did_you_mean(command, COMMANDS, 'there are ')}")
    args, unknown = parser.parse_known_args(argv)
    if unknown:
        _refuse(args, unknown)
    return args


def _refuse(args: argparse.Namespace, unknown: Sequence[str]) -> NoReturn:
    """End with the usage of a command that does not know some words, and what they probably mean."""
    command: argparse.ArgumentParser = args.parser
    options = re.findall(r"--[a-z][a-z-]*", command.format_usage())
    option = next((word.partition("=")[0] for word in unknown if word.startswith("--")), None)
    guess = closest(option, options) if option else None
    hint = f"; did you mean {guess}?" if guess else ""
    if getattr(args, "source", None) is not None and os.path.isfile(unknown[0]):
        hint = "; to give many files as one source, quote the pattern: --source 'FOLDER/*.png'"
    command.error(f"unrecognized arguments: {' '.join(unknown)}{hint}")
