"""The command line of `tactflow`: finds the command, runs it, turns errors into messages and exit codes."""

from __future__ import annotations

import argparse
import os
import re
from collections.abc import Callable, Sequence
from typing import Final, NoReturn

from tactflow import __version__
from tactflow.cli.command import Command
from tactflow.engine.errors import ConfigError, TactflowError
from tactflow.system.plugins import plugins
from tactflow.system.redaction import public_address
from tactflow.system.signals import INTERRUPTED_EXIT_CODE
from tactflow.system.spelling import closest, did_you_mean
from tactflow.system.terminal import printable, say

COMMANDS: Final[dict[str, Command]] = {
    "run": Command("run a pipeline", "tactflow.cli.run"),
    "check": Command(
        "validate a pipeline file without running it; prints every mistake at once",
        "tactflow.cli.pipelines",
        "check",
    ),
    "explain": Command(
        "why each stage runs, is skipped or is left out; with --stats, what it cost", "tactflow.cli.explain"
    ),
    "graph": Command("print a pipeline as a Mermaid flowchart", "tactflow.cli.explain", "graph"),
    "pipelines": Command(
        "list the pipelines that come with tactflow, one for each kind of sensor", "tactflow.cli.pipelines"
    ),
    "stages": Command(
        "list the stages and sinks that can be used, their ports and parameters", "tactflow.cli.stages"
    ),
    "listen": Command("print what a running tactflow publishes", "tactflow.cli.listen"),
    "control": Command(
        "tell a running tactflow to pause, to take a reference, to record", "tactflow.cli.control"
    ),
    "keys": Command("make keys that encrypt results sent over a network", "tactflow.cli.control", "keys"),
    "warmup": Command(
        "load a pipeline, and say whether its loops are compiled", "tactflow.cli.pipelines", "warmup"
    ),
    "record": Command("run a pipeline and record its frames and results", "tactflow.cli.run", "record"),
    "export": Command(
        "make a dataset from recordings: HDF5, Zarr, LeRobot and others", "tactflow.cli.recordings", "export"
    ),
    "repair": Command(
        "copy what is intact in a damaged or unfinished recording, with an index",
        "tactflow.cli.recordings",
        "repair",
    ),
    "calibrate": Command(
        "make a sensor's calibration file, or check whether it still fits", "tactflow.cli.calibrate"
    ),
    "detect": Command(
        "find the dots of a gel, and show what was found and why in one picture", "tactflow.cli.detect"
    ),
    "cameras": Command(
        "list the cameras that are plugged in, with names that stay the same", "tactflow.cli.cameras"
    ),
    "sim": Command("write a simulated recording and its ground truth", "tactflow.cli.sim"),
    "schema": Command(
        "print the JSON Schema of the result message or of a pipeline file",
        "tactflow.cli.pipelines",
        "schema",
    ),
}
"""The commands of the core; others are entry points of the group `tactflow.commands`."""


def all_commands() -> dict[str, Command]:
    """Name -> command, of the core and of everything that is installed."""
    return COMMANDS | {point.name: point.load() for point in plugins("tactflow.commands")}


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
        return INTERRUPTED_EXIT_CODE
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
    for name, known in (COMMANDS if command in COMMANDS else all_commands()).items():
        subparser = subparsers.add_parser(
            name, help=known.summary, description=known.summary, allow_abbrev=False
        )
        if name == command:
            module = known.load()
            getattr(module, f"add_arguments{known.suffix}")(subparser)
            subparser.set_defaults(run=getattr(module, f"run{known.suffix}"), parser=subparser)
    return parser


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    command = next((word for word in argv if not word.startswith("-")), None)
    parser = make_parser(command)
    if command is not None and command not in COMMANDS and command not in (known := all_commands()):
        parser.error(f"there is no command {command}{did_you_mean(command, known, 'there are ')}")
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
