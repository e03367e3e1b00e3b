"""`tactflow run`: run a pipeline to the end of its source."""

from __future__ import annotations

import argparse
import json
import logging
import signal
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

from rich.console import Console
from rich.logging import RichHandler
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from tactflow.cli.fleet import run_fleet
from tactflow.cli.opencv import warn_of_conflict
from tactflow.cli.options import add_pipeline
from tactflow.cli.pipelines import find_pipeline
from tactflow.cli.story import share
from tactflow.config.load import load_pipeline, sensor_names
from tactflow.engine.errors import ConfigError
from tactflow.engine.graph import Pipeline
from tactflow.engine.run import Progress as RunProgress
from tactflow.engine.run import Runner, RunResult
from tactflow.engine.trace import Trace

_COSTLIEST = 4
"""Stages named in a line of statistics."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `run`."""
    add_pipeline(parser)
    parser.add_argument("--source", metavar="SRC", help="replaces the source of the pipeline's capture stage")
    parser.add_argument(
        "--jsonl", metavar="PATH", help="also write one result message a frame ('-': standard output)"
    )
    parser.add_argument("--max-frames", type=_positive, metavar="N", help="stop after N frames")
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
    parser.add_argument("--quiet", action="store_true", help="no progress display and no summary")
    parser.add_argument(
        "--check", action="store_true", help="check every array against its port type (slower)"
    )


def run(args: argparse.Namespace) -> int:
    """Run the pipeline; returns the exit code. Raises ConfigError when nothing was started."""
    console = Console(stderr=True, highlight=False, soft_wrap=True)
    file = find_pipeline(args.pipeline)
    if args.sensor is None:
        # Else it was said already by the process that starts one for each sensor.
        warn_of_conflict()
    several = sensor_names(file, args.overrides) if args.sensor is None else []
    if len(several) > 1:
        return run_fleet(args, file, {name: _load(args, file, name) for name in several})
    pipeline = _load(args, file, args.sensor)
    trace = None if args.trace is None else Trace(f"tactflow {pipeline.sensor}")
    runner = Runner(pipeline, max_frames=args.max_frames, check=args.check, trace=trace)
    _refuse_unwritable("--stats", args.stats)
    _refuse_unwritable("--trace", args.trace)
    with _logging_to(console), _signals(runner):
        logger = logging.getLogger("tactflow")
        for warning in runner.pipeline.warnings:
            logger.warning("%s", warning)
        if runner.plan.pruned:
            logger.info("not run, as no sink needs it: %s", ", ".join(n.id for n in runner.plan.pruned))
        with _progress_display(console, runner, shown=not args.quiet) as on_progress:
            result = runner.run(_with_statistics(on_progress, runner, args.stats_every, console))
    if trace is not None:
        trace.write(Path(args.trace))
    if args.stats:
        Path(args.stats).write_text(json.dumps(result.stats, indent=1) + "\n", encoding="utf-8")
    if result.error is not None:
        print(f"tactflow: {result.error}", file=sys.stderr)
    if not args.quiet:
        console.print(_summary(result, runner), markup=False)
    return result.exit_code


def _load(args: argparse.Namespace, file: Path, sensor: str | None) -> Pipeline:
    source_values: dict[str, Any] = {}
    if args.source is not None:
        source_values["source"] = args.source
    if args.realtime:
        source_values["realtime"] = True
    extra_sinks: dict[str, dict[str, Any]] = dict(getattr(args, "extra_sinks", {}))
    if args.jsonl is not None:
        extra_sinks["--jsonl"] = {"use": "jsonl", "path": args.jsonl}
    return load_pipeline(
        file,
        overrides=args.overrides,
        extra_sinks=extra_sinks,
        source_values=source_values,
        sensor=sensor,
    )


def _positive(text: str) -> int:
    value = int(text) if text.isdecimal() else 0
    if value < 1:
        raise argparse.ArgumentTypeError(f"required a whole number from 1, got {text!r}")
    return value


def _seconds(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.1 <= value <= 86400:
        raise argparse.ArgumentTypeError(f"required seconds from 0.1 to 86400, got {text!r}")
    return value


def _refuse_unwritable(option: str, path: str | None) -> None:
    """Find out before the run, not after it, that a file cannot be written."""
    if path is None:
        return
    try:
        with open(path, "a", encoding="utf-8"):
            pass
    except OSError as error:
        raise ConfigError(f"{option} {path}: cannot be written: {error.strerror}") from None


@contextmanager
def _logging_to(console: Console) -> Iterator[None]:
    """Show the program's notes and warnings on standard error while the run lasts."""
    logger = logging.getLogger("tactflow")
    handler: logging.Handler
    if console.is_terminal:
        handler = RichHandler(console=console, show_time=False, show_path=False, markup=False)
    else:
        handler = logging.StreamHandler(sys.stderr)
        handler.setFormatter(logging.Formatter("tactflow: %(levelname)s: %(message)s"))
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    try:
        yield
    finally:
        logger.removeHandler(handler)


@contextmanager
def _signals(runner: Runner) -> Iterator[None]:
    """One Ctrl-C or SIGTERM drains the pipeline; a second one ends it at once; a third is not caught."""
    caught = 0

    def handle(number: int, _: FrameType | None) -> None:
        nonlocal caught
        caught += 1
        if caught == 1:
            runner.stop("signal")
            return
        signal.signal(number, signal.SIG_DFL)
        raise KeyboardInterrupt

    before = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def _progress_display(
    console: Console, runner: Runner, *, shown: bool
) -> Iterator[Callable[[RunProgress], None] | None]:
    """A line that counts frames, on a terminal only."""
    if not shown or not console.is_terminal:
        yield None
        return
    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.completed} frames, {task.fields[rate]:.0f}/s, {task.fields[dropped]} dropped"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=console, transient=True) as display:
        task = display.add_task(runner.pipeline.sensor, total=None, rate=0.0, dropped=0)

        def update(now: RunProgress) -> None:
            total = runner.max_frames or getattr(runner.source, "total", None)
            rate = now.frames / now.elapsed_s if now.elapsed_s > 0 else 0.0
            display.update(task, completed=now.frames, total=total, rate=rate, dropped=now.dropped)

        yield update


def _with_statistics(
    on_progress: Callable[[RunProgress], None] | None, runner: Runner, every: float | None, console: Console
) -> Callable[[RunProgress], None] | None:
    """Also print a line of statistics every so many seconds."""
    if every is None:
        return on_progress
    last: Mapping[str, Any] | None = None
    due = every

    def update(now: RunProgress) -> None:
        nonlocal last, due
        if on_progress is not None:
            on_progress(now)
        if now.elapsed_s >= due:
            due = now.elapsed_s + every
            stats = runner.snapshot()
            console.print(statistics_line(stats, last), markup=False)
            last = stats

    return update


def statistics_line(stats: Mapping[str, Any], before: Mapping[str, Any] | None = None) -> str:
    """Rate, drops and latency, and for the costliest stages their time a frame and how often they ran.

    stats, before : statistics of a run now and earlier (None: at its start); what is told happened between
    them, except for the latency, which is that of the run so far.
    """
    if before is None:
        before = {"frames": 0, "dropped": 0, "wall_s": 0.0, "stages": {}}
    frames, dropped = stats["frames"] - before["frames"], stats["dropped"] - before["dropped"]
    seconds = stats["wall_s"] - before["wall_s"]
    parts = [f"{stats['wall_s']:.1f} s: {frames / seconds if seconds > 0 else 0:.1f} frames/s"]
    parts.append(f"{dropped} dropped")
    latency = stats["latency_ms"]
    if latency["p50"] is not None:
        parts.append(f"latency p50 {latency['p50']:.2f} p99 {latency['p99']:.2f} ms")
    costs = []
    for name, entry in stats["stages"].items():
        earlier = before["stages"].get(name, {"runs": 0, "total_ms": 0.0})
        runs, spent = entry["runs"] - earlier["runs"], entry["total_ms"] - earlier["total_ms"]
        if runs > 0 and frames > 0:
            costs.append((spent / frames, f"{name} {spent / frames:.2f} ms (ran {share(runs, frames)})"))
    costs.sort(reverse=True)
    if costs:
        parts.append("a frame: " + ", ".join(text for _, text in costs[:_COSTLIEST]))
    return "; ".join(parts)


def _summary(result: RunResult, runner: Runner) -> str:
    stats = result.stats
    lines = [
        f"{stats['frames']} frames in {stats['wall_s']:.1f} s, {stats['dropped']} dropped ({stats['end']})"
    ]
    touching = next((s for name, s in stats["signals"].items() if name.endswith(".touching")), None)
    if touching is not None:
        lines.append(f"contacts: {touching['rises']} ({touching['true']} frames with contact)")
    latency = stats["latency_ms"]
    if latency["p50"] is not None:
        lines.append(f"latency: p50 {latency['p50']:.2f} ms, p99 {latency['p99']:.2f} ms")
    for name, node in runner.nodes.items():
        target = getattr(node.instance, "description", None)
        if node.is_sink and target:
            lines.append(f"{name}: {target}")
    return "\n".join(lines)
