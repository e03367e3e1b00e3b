"""The program `tactflow`: finds the subcommand, runs it, and turns errors into messages and exit codes."""

from __future__ import annotations

import argparse
import gc
import importlib
import io
import os
import re
import signal
import sys
import threading
from collections.abc import Collection, Sequence
from typing import NoReturn

from tactflow import __version__
from tactflow.__main__ import wanted
from tactflow.cli.printable import printable
from tactflow.engine.errors import StageError, TactflowError
from tactflow.system.files import Unheard, lead_nowhere
from tactflow.system.signals import ENDING, INTERRUPTED, interrupt_from_now_on
from tactflow.system.spelling import closest, did_you_mean

COMMANDS = {
    "run": "run a pipeline",
    "check": "validate a pipeline file without running it; prints every mistake at once",
    "explain": "why each stage runs, is skipped or is left out, and what it cost",
    "graph": "print a pipeline as a Mermaid flowchart",
    "pipelines": "list the pipelines that come with tactflow, one for each kind of sensor",
    "stages": "list the stages and sinks that can be used, their ports and parameters",
    "listen": "print what a running tactflow publishes",
    "control": "tell a running tactflow to pause, to take a reference, to record",
    "keys": "make keys, so that only who has one can read results over a network",
    "bench": "measure run time against error, per method and for whole pipelines",
    "warmup": "compile what `run` would compile on its first use",
    "batch": "run a pipeline over many recordings; a second call does what is missing",
    "record": "run a pipeline and record its frames and results",
    "export": "make a LeRobot dataset of recordings",
    "repair": "give a recording that was cut off its index",
    "calibrate": "make the calibration file of a sensor, or see whether it still fits",
    "detect": "find the marks of a gel and show what was found and why, in one picture",
    "doctor": "what is wrong with a sensor's pictures, what it does to the errors, and what to change",
    "tune": "find the cheapest pipeline within an error budget, for one sensor, from a recording of it",
    "cameras": "list the cameras that are plugged in, with names that stay the same",
    "sim": "write a simulated recording and its ground truth",
    "schema": "print the JSON Schema of the result message or of a pipeline file",
    "completion": "print a script that completes commands, options and files in a shell",
}
"""Subcommand -> what it does.

The module of that name in `tactflow.cli` has `add_arguments(parser)` and `run(args) -> int`; it is imported
only when the command is used.
"""


def entry() -> None:
    """Run the program with the arguments of this process, and end the process with its exit code."""
    # A service may be started without them.
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115 (until the end)
    sys.stderr = Unheard(sys.stderr)
    # Names of files may have letters that the terminal, or UTF-8, has not.
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        code = main(sys.argv[1:])
        sys.stdout.flush()
    except OSError as error:
        # Whoever read our output has left, or the disk is full.
        lead_nowhere(sys.stdout)
        code = 0
        if not isinstance(error, BrokenPipeError):
            # Only the question where we are fails so, without a name.
            unnamed = "the current folder" if isinstance(error, FileNotFoundError) else "standard output"
            print(f"tactflow: {error.filename or unnamed}: {error.strerror or error}", file=sys.stderr)
            code = StageError.exit_code
    except KeyboardInterrupt:
        # Whoever shall read our output does not.
        lead_nowhere(sys.stdout)
        code = INTERRUPTED
    # The code is known; what comes now shall not change it.
    for number in ENDING:
        signal.signal(number, signal.SIG_IGN)
    if code != 0 and threading.active_count() > 1:
        # A thread of a run that was not allowed to finish: one that comes out of OpenCV while Python ends
        # would abort the process. After a run that ended well, what sinks of one's own leave to the end of
        # Python, such as a pool in which one writes, is done.
        sys.stderr.flush()
        os._exit(code)
    sys.exit(code)


def main(argv: Sequence[str]) -> int:
    """Run the program with these arguments; returns its exit code."""
    try:
        args = _parse(argv)
        _collect_garbage()
        interrupt_from_now_on()
        return int(args.run(args))
    except TactflowError as error:
        # Imported here: it reads YAML, which not every command does.
        from tactflow.system.redaction import public_address

        print(printable(public_address(f"tactflow: {error}")), file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        return INTERRUPTED
    except SystemExit as error:
        return error.code if isinstance(error.code, int) else 0


def make_parser(complete: Collection[str]) -> argparse.ArgumentParser:
    """The parser of the command line.

    complete : the commands whose arguments it knows; their modules are imported.
    """
    parser = argparse.ArgumentParser(
        prog="tactflow",
        description="From camera frames of a tactile sensor to contact geometry and marker flow.",
        epilog="'tactflow COMMAND --help' explains one command.",
        allow_abbrev=False,
    )
    parser.add_argument("--version", action="version", version=f"tactflow {__version__}")
    subparsers = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for name, summary in COMMANDS.items():
        command = subparsers.add_parser(name, help=summary, description=summary, allow_abbrev=False)
        if name in complete:
            module = importlib.import_module(f"tactflow.cli.{name}")
            module.add_arguments(command)
            command.set_defaults(run=module.run, parser=command)
    return parser


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    command = wanted(argv)
    parser = make_parser([command] if command in COMMANDS else [])
    if command is not None and command not in COMMANDS:
        parser.error(f"there is no command {command}{did_you_mean(command, COMMANDS, 'there are ')}")
    args, unknown = parser.parse_known_args(argv)
    if unknown:
        _refuse(args, unknown)
    return args


def _collect_garbage() -> None:
    """Have Python look for garbage, if `entry` has put that off, but not in what is imported by now."""
    if not gc.isenabled():
        gc.freeze()
        gc.enable()


def _refuse(args: argparse.Namespace, unknown: Sequence[str]) -> NoReturn:
    """End with the usage of a command that was given words it does not know, besides those in `args`."""
    command: argparse.ArgumentParser = args.parser
    options = re.findall(r"--[a-z][a-z-]*", command.format_usage())
    option = next((word.partition("=")[0] for word in unknown if word.startswith("--")), None)
    guess = closest(option, options) if option else None
    hint = f"; did you mean {guess}?" if guess else ""
    if getattr(args, "source", None) is not None and os.path.isfile(unknown[0]):
        hint = "; to give many files as one source, quote the pattern: --source 'FOLDER/*.png'"
    command.error(f"unrecognized arguments: {' '.join(unknown)}{hint}")
