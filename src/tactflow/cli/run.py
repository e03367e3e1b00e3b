"""`tactflow run`: run a pipeline to the end of its source."""

from __future__ import annotations

import argparse
import json
import logging
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from rich.console import Console

from tactflow.api import ended_by_signals, make_runner
from tactflow.cli.notes import notes_on
from tactflow.cli.opencv import warn_of_conflict
from tactflow.cli.options import add_pipeline, positive, seconds
from tactflow.cli.printable import printable
from tactflow.cli.progress import progress_display, summary, with_statistics
from tactflow.config.files_used import files_written
from tactflow.config.load import load_pipeline, sensor_names
from tactflow.config.overrides import Override
from tactflow.config.shipped import find_pipeline
from tactflow.engine.errors import ConfigError, StageError
from tactflow.engine.graph import Pipeline
from tactflow.engine.run import Runner, RunResult
from tactflow.engine.trace import TRACE_BEGINS, Trace
from tactflow.fleet.heartbeat import HANG_AFTER, Headway, start_beating
from tactflow.fleet.names import name_problems, with_name
from tactflow.fleet.run import Request, run_fleet
from tactflow.system.files import is_device
from tactflow.system.redaction import public_address
from tactflow.system.signals import INTERRUPTED
from tactflow.vision import compiled

STATISTICS_BEGIN = '{\n "frames":'
"""How a file of statistics begins."""

Sinks = dict[str, dict[str, Any]]
"""Option of the command line -> settings of the sink that it adds."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `run`."""
    add_pipeline(parser)
    parser.add_argument("--source", metavar="SRC", help="replaces the source of the pipeline's capture stage")
    parser.add_argument(
        "--jsonl", metavar="PATH", help="also write one result message a frame ('-': standard output)"
    )
    parser.add_argument("--max-frames", type=positive, metavar="N", help="stop after N frames")
    parser.add_argument(
        "--realtime",
        action="store_true",
        help="play a recording at its own pace, dropping frames like a camera",
    )
    parser.add_argument(
        "--sensor",
        metavar="NAME",
        help="of a pipeline with several sensors, run only this one, in this process",
    )
    parser.add_argument("--stats", metavar="PATH", help="write run statistics as JSON at exit")
    parser.add_argument(
        "--stats-every",
        type=_seconds,
        metavar="SECONDS",
        help="a line on standard error every so often: rate, drops, latency, and what each stage cost since",
    )
    parser.add_argument(
        "--trace",
        metavar="FILE",
        help="write what each thread did when, as Chrome trace events; open it at ui.perfetto.dev",
    )
    parser.add_argument(
        "--end-with-stdin",
        action="store_true",
        help="end well when standard input ends: when the program that started this one is gone",
    )
    parser.add_argument(
        "--sign-of-life",
        type=Path,
        metavar="FILE",
        help="touch this file every second while the run is alive and no stage hangs in a frame",
    )
    parser.add_argument(
        "--hang-after",
        type=_seconds,
        default=HANG_AFTER,
        metavar="SECONDS",
        help="of several sensors, kill and start again one that has given no sign of life for so long "
        "(%(default)g, and to start it has no less); more than the slowest stage may take for a frame",
    )
    parser.add_argument("--quiet", action="store_true", help="no progress display and no summary")
    parser.add_argument(
        "--check", action="store_true", help="check every array against its port type (slower)"
    )


def run(args: argparse.Namespace, extra_sinks: Callable[[str | None], Sinks] = lambda _: {}) -> int:
    """Run the pipeline; returns the exit code. Raises ConfigError when nothing was started.

    extra_sinks : gives the sinks that a command adds for one of several sensors, or for None, the only one.
    """
    file = find_pipeline(args.pipeline)
    if args.sensor is None:
        # Else it was said already by the process that starts one for each sensor.
        warn_of_conflict()
    several = sensor_names(file, args.overrides) if args.sensor is None else []
    if len(several) > 1:
        return _run_all(args, file, several, extra_sinks)
    pipeline = _load(args, file, args.sensor, _added_sinks(args, None) | extra_sinks(None))
    return _run_one(args, pipeline)


def _run_all(
    args: argparse.Namespace, file: Path, sensors: Sequence[str], extra_sinks: Callable[[str | None], Sinks]
) -> int:
    """Run every sensor in a process of its own."""
    problems = _option_problems(args, sensors)
    if problems:
        raise ConfigError("\n".join(problems))
    sinks = {sensor: _added_sinks(args, sensor) | extra_sinks(sensor) for sensor in sensors}
    pipelines = {sensor: _load(args, file, sensor, sinks[sensor]) for sensor in sensors}
    reports = {option: path for option, path in _statistics_files(args).items() if path is not None}
    for sensor, pipeline in pipelines.items():
        _refuse_shared({option: with_name(path, sensor) for option, path in reports.items()}, pipeline)
    request = Request(
        file,
        args.overrides,
        added={option for added in sinks.values() for option in added},
        files=reports,
        hang_after=args.hang_after,
        options=_options(args),
    )
    return run_fleet(request, pipelines)


def _options(args: argparse.Namespace) -> list[str]:
    """The options of this run for the process of every sensor, but for those about sinks and files."""
    words = []
    for option, value in (("--max-frames", args.max_frames), ("--stats-every", args.stats_every)):
        if value is not None:
            words += [option, str(value)]
    flags = (("--realtime", args.realtime), ("--quiet", args.quiet), ("--check", args.check))
    return words + [flag for flag, given in flags if given]


def _statistics_files(args: argparse.Namespace) -> dict[str, str | None]:
    return {"--stats": args.stats, "--trace": args.trace}


def _option_problems(args: argparse.Namespace, sensors: Sequence[str]) -> list[str]:
    """What is wrong with the command line of a run of several sensors."""
    problems = []
    if args.source is not None:
        problems.append(
            f"--source: the pipeline has {len(sensors)} sensors, each with its own source; choose one with "
            f"--sensor {sensors[0]}, or use --set sensors.NAME.stages.capture.source=..."
        )
    files = {"--jsonl": args.jsonl, **_statistics_files(args), "--out": getattr(args, "out", None)}
    given = {option: str(path) for option, path in files.items() if path is not None}
    return problems + name_problems(given, sensors)


def _added_sinks(args: argparse.Namespace, sensor: str | None) -> Sinks:
    """The sink of `--jsonl`."""
    if args.jsonl is None:
        return {}
    return {
        "--jsonl": {"use": "jsonl", "path": args.jsonl if sensor is None else with_name(args.jsonl, sensor)}
    }


def _load(args: argparse.Namespace, file: Path, sensor: str | None, sinks: Sinks) -> Pipeline:
    source_values = []
    if args.source is not None:
        address = f" {public_address(args.source)}" if args.source.isprintable() else ""
        source_values.append(Override("source", args.source, f"--source{address}"))
    if args.realtime:
        source_values.append(Override("realtime", value=True, origin="--realtime"))
    return load_pipeline(
        file, overrides=args.overrides, extra_sinks=sinks, source_values=source_values, sensor=sensor
    )


def _run_one(args: argparse.Namespace, pipeline: Pipeline) -> int:
    """Run one sensor's pipeline in this process."""
    _refuse_shared(_statistics_files(args), pipeline)
    console = Console(stderr=True, highlight=False, soft_wrap=True)
    trace = None if args.trace is None else Trace(f"tactflow {pipeline.sensor}")
    runner = make_runner(pipeline, max_frames=args.max_frames, check=args.check, trace=trace)
    if args.end_with_stdin:
        threading.Thread(target=_stop_at_end_of_input, args=(runner,), daemon=True).start()
    if args.sign_of_life is not None:
        start_beating(args.sign_of_life, Headway(runner.calls))
    with notes_on(console), ended_by_signals(runner) as caught:
        _refuse_unwritable("--stats", args.stats, begins=STATISTICS_BEGIN)
        _refuse_unwritable("--trace", args.trace, begins=TRACE_BEGINS)
        logger = logging.getLogger("tactflow")
        for warning in runner.pipeline.warnings:
            logger.warning("%s", warning)
        if runner.plan.idle:
            logger.info("not run, as no sink needs it: %s", ", ".join(node.id for node in runner.plan.idle))
        with progress_display(console, runner, shown=not args.quiet) as on_progress:
            result = runner.run(with_statistics(on_progress, runner, args.stats_every, console))
        code = 0 if result.exit_code == INTERRUPTED and len(caught) == 1 else result.exit_code
        written = _report(args, result, trace)
        if not args.quiet:
            console.print(printable(summary(result, runner)), markup=False)
        return code or (0 if written else StageError.exit_code)


def _report(args: argparse.Namespace, result: RunResult, trace: Trace | None) -> bool:
    """Say why a run failed, and write what was asked for about it; whether that could be written."""
    if result.error is not None:
        print(printable(f"tactflow: {result.error}"), file=sys.stderr)
    written = [
        trace is None or _write_report("--trace", args.trace, trace.lines()),
        args.stats is None or _write_report("--stats", args.stats, [json.dumps(result.stats, indent=1)]),
    ]
    return all(written)


def _write_report(option: str, path: str, lines: Iterable[str]) -> bool:
    """Write a file of statistics or events; whether that went well. Half of one is none: it is emptied."""
    try:
        with open(path, "w", encoding="utf-8") as file:
            file.writelines(f"{line}\n" for line in lines)
    except OSError as error:
        print(f"tactflow: {option} {path}: cannot be written: {error.strerror or error}", file=sys.stderr)
        if not is_device(path):
            with suppress(OSError):
                os.truncate(path, 0)
        return False
    return True


def _stop_at_end_of_input(runner: Runner) -> None:
    """Body of a thread: reads until nobody can write any more."""
    with suppress(OSError):
        while os.read(sys.stdin.fileno(), 4096):
            pass
    runner.stop("signal")
    if compiled.is_loading():
        # This is not waited for after a signal.
        signal.raise_signal(signal.SIGTERM)


def _seconds(text: str) -> float:
    value = seconds(text)
    if not 0.1 <= value <= 86400:
        raise argparse.ArgumentTypeError(f"required seconds from 0.1 to 86400, got {text!r}")
    return value


def _refuse_unwritable(option: str, path: str | None, begins: str) -> None:
    """Find out before the run, not after it, that a file cannot be written, or holds something else.

    begins : the first characters of what an earlier run has written, which may be replaced.
    """
    if path is None:
        return
    try:
        with open(path, "ab"):
            pass
        if is_device(path):
            return
        with open(path, "rb") as file:
            there = file.read(len(begins))
    except OSError as error:
        raise ConfigError(f"{option} {path}: cannot be written: {error.strerror}") from None
    if there not in (b"", begins.encode()):
        raise ConfigError(f"{option} {path}: holds something else; choose another file, or delete it")


def _refuse_shared(reports: Mapping[str, str | None], pipeline: Pipeline) -> None:
    """Refuse a report into a file that a sink, or another report, writes: it would replace what is there.

    reports : option -> its file.
    """
    writers = {
        place: node.id
        for node in pipeline.nodes.values()
        for place in files_written(node.component.cls, node.params)
    }
    for option, path in reports.items():
        if path is None or is_device(path):
            continue
        place = os.path.realpath(path)
        if place in writers:
            raise ConfigError(f"{option} {path}: {writers[place]} writes it already; choose another file")
        writers[place] = option
