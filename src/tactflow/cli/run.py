"""`tactflow run`: run a pipeline to the end of its source; `tactflow record`: and record its frames."""

from __future__ import annotations

import argparse
import json
import logging
import os
import sys
import threading
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from tactflow.api import ended_by_signals, make_runner
from tactflow.cli.options import add_overwrite, add_pipeline, add_quiet, refuse_output
from tactflow.cli.progress import run_progress, summary
from tactflow.cli.sensors import fleet
from tactflow.config.load import load_pipeline, sensor_names
from tactflow.config.overrides import Override, added
from tactflow.config.sensors import with_name
from tactflow.config.shipped import find_pipeline
from tactflow.engine.contract import Recorder
from tactflow.engine.errors import ConfigError, StageError
from tactflow.engine.graph import Pipeline
from tactflow.engine.run import Runner
from tactflow.system.arguments import positive
from tactflow.system.files import is_device, next_name
from tactflow.system.redaction import public_address
from tactflow.system.signals import INTERRUPTED_EXIT_CODE
from tactflow.system.terminal import notes, say

STATISTICS_BEGIN = '{\n "frames":'
"""How a statistics file begins. A file that begins otherwise is not replaced."""

Sinks = dict[str, dict[str, Any]]
"""Option of the command line -> settings of the sink that it adds."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `run`."""
    parser.set_defaults(out=None)
    add_pipeline(parser)
    parser.add_argument("--source", metavar="SRC", help="replaces the source of the pipeline's capture stage")
    parser.add_argument(
        "--jsonl", metavar="PATH", help="also write a result message for each frame ('-': standard output)"
    )
    parser.add_argument(
        "--csv", metavar="PATH", help="also write a table with a row for each frame ('-': standard output)"
    )
    parser.add_argument(
        "--video",
        metavar="PATH",
        help="also write a video with the results drawn on the pictures (.mp4, .avi, ...)",
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
        help="run only this sensor of a pipeline with several, in this process",
    )
    parser.add_argument("--stats", metavar="PATH", help="write run statistics as JSON at exit")
    parser.add_argument(
        "--end-with-stdin",
        action="store_true",
        help="end the run when standard input ends, and so with the program that started this one",
    )
    add_quiet(parser)
    parser.add_argument(
        "--check", action="store_true", help="check every array against its port type (slower)"
    )


def run(args: argparse.Namespace) -> int:
    """Run the pipeline; returns the exit code. Raises ConfigError when nothing was started."""
    file = find_pipeline(args.pipeline)
    sensors = sensor_names(file, args.overrides) if args.sensor is None else []
    if len(sensors) > 1:
        return _run_all(args, file, sensors)
    return _run_one(args, _load(args, file, args.sensor, _added_sinks(args, None)))


def _run_all(args: argparse.Namespace, file: Path, sensors: Sequence[str]) -> int:
    """Run every sensor in a process of its own."""
    if args.source is not None:
        raise ConfigError(
            f"--source: the pipeline has {len(sensors)} sensors, each with its own source; choose one with "
            f"--sensor {sensors[0]}, or use --set sensors.NAME.stages.capture.source=..."
        )
    sinks = {sensor: _added_sinks(args, sensor) for sensor in sensors}
    pipelines = {sensor: _load(args, file, sensor, sinks[sensor]) for sensor in sensors}
    arguments = {
        sensor: _arguments(args, file, pipeline, sinks[sensor]) for sensor, pipeline in pipelines.items()
    }
    return fleet().run(pipelines, arguments)


def _arguments(args: argparse.Namespace, file: Path, pipeline: Pipeline, sinks: Sinks) -> list[str]:
    """The command line of the process that runs one sensor. sinks : added by options of this one."""
    # Its end with standard input is the one with this process.
    words = ["run", str(file), "--sensor", pipeline.sensor, "--end-with-stdin"]
    for text in (*args.overrides, *(added(node) for node in pipeline.sinks if str(node.mark) in sinks)):
        words += ["--set", text]
    if args.stats is not None:
        words += ["--stats", with_name(args.stats, pipeline.sensor)]
    if args.max_frames is not None:
        words += ["--max-frames", str(args.max_frames)]
    flags = (("--realtime", args.realtime), ("--quiet", args.quiet), ("--check", args.check))
    return words + [flag for flag, is_set in flags if is_set]


def _added_sinks(args: argparse.Namespace, sensor: str | None) -> Sinks:
    """The sinks that options add, for one of several sensors, or, for None, the only one."""
    paths = {"jsonl": args.jsonl, "csv": args.csv, "video": args.video, "record": args.out}
    sinks: Sinks = {}
    for use, path in paths.items():
        if path is not None:
            own = str(path) if sensor is None else with_name(str(path), sensor)
            sinks[f"--{use}"] = {"use": use, "path": own}
    if args.out is not None:
        sinks["--record"] |= _recording_options(args, Path(sinks["--record"]["path"]))
    return sinks


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
    with notes():
        runner = make_runner(pipeline, max_frames=args.max_frames, check=args.check)
    if args.end_with_stdin:
        threading.Thread(target=_stop_at_end_of_input, args=(runner,), daemon=True).start()
    with notes(), ended_by_signals(runner) as caught:
        if args.stats is not None and (problem := _statistics_problem(args.stats)):
            raise ConfigError(f"--stats {args.stats}: {problem}")
        logger = logging.getLogger("tactflow")
        for warning in runner.pipeline.warnings:
            logger.warning("%s", warning)
        if runner.plan.idle:
            logger.info("not run, as no sink needs it: %s", ", ".join(node.id for node in runner.plan.idle))
        with run_progress(runner, shown=not args.quiet) as on_progress:
            result = runner.run(on_progress)
        code = 0 if result.exit_code == INTERRUPTED_EXIT_CODE and len(caught) == 1 else result.exit_code
        if result.error is not None:
            say(f"tactflow: {result.error}")
        written = args.stats is None or _write_statistics(args.stats, result.stats)
        if not args.quiet:
            say(summary(result, runner))
        for verdict in _verdicts(runner):
            if not (args.quiet and verdict.startswith("good")):
                say(verdict)
        return code or (0 if written else StageError.exit_code)


def _verdicts(runner: Runner) -> list[str]:
    """The verdict on each recording that lasted as long as the run."""
    sinks = (node.sink for node in runner.nodes.values())
    return [sink.verdict for sink in sinks if isinstance(sink, Recorder) and sink.verdict]


def _statistics_problem(path: str) -> str | None:
    """Why statistics cannot be written to a file, or None. Makes the file."""
    try:
        with open(path, "ab"):
            pass
        if is_device(path):
            return None
        with open(path, encoding="utf-8", errors="replace") as file:
            beginning = file.read(len(STATISTICS_BEGIN))
    except OSError as error:
        return f"cannot be written: {error.strerror or error}"
    if beginning not in ("", STATISTICS_BEGIN):
        return "is not a statistics file; choose another path, or delete it"
    return None


def _write_statistics(path: str, statistics: Mapping[str, Any]) -> bool:
    """Returns whether they were written."""
    # A sink may have written to it meanwhile.
    problem = _statistics_problem(path)
    if problem is None:
        try:
            Path(path).write_text(json.dumps(statistics, indent=1) + "\n", encoding="utf-8")
        except OSError as error:
            problem = f"cannot be written: {error.strerror or error}"
    if problem is not None:
        say(f"tactflow: --stats {path}: {problem}")
    return problem is None


def _stop_at_end_of_input(runner: Runner) -> None:
    """Body of a thread: stop the run at the end of standard input."""
    with suppress(OSError):
        while os.read(sys.stdin.fileno(), 4096):
            pass
    runner.stop("signal")


def add_arguments_record(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `record`: those of `run`, and the file."""
    add_arguments(parser)
    parser.add_argument(
        "--out",
        required=True,
        type=Path,
        metavar="FILE.mcap",
        help="lossless frames, results, pipeline; tactflow run --source FILE.mcap plays it",
    )
    existing = parser.add_mutually_exclusive_group()
    add_overwrite(existing, "FILE.mcap")
    existing.add_argument("--number", action="store_true", help="if it exists, record to FILE-001.mcap, ...")


def run_record(args: argparse.Namespace) -> int:
    """Run the pipeline with a sink that records; returns the exit code.

    Raises
    ------
    ConfigError
        If the file cannot be recorded to, or as `tactflow run` does. Nothing was started.
    """
    from tactflow.recording import missing_packages

    problem = missing_packages()
    if problem is not None:
        raise ConfigError(problem)
    refuse_output("--out", args.out, overwrite=True, suffixes=(".mcap",))
    return run(args)


def _recording_options(args: argparse.Namespace, out: Path) -> dict[str, Any]:
    """Settings of the sink that records to a file. Raises ConfigError if the file exists."""
    if out.exists() and args.number:
        out = next_name(out)
    if out.exists() and not args.overwrite:
        raise ConfigError(
            f"--out: {out} already exists; give --overwrite to replace it or --number to record beside it"
        )
    return {"path": str(out), "overwrite": args.overwrite}
