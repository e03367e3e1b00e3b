"""What `tactflow run` tells people: the progress of a run, lines of statistics, the summary at the end."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from tactflow.cli.node_summary import share
from tactflow.engine.run import Progress as RunProgress
from tactflow.engine.run import Runner, RunResult
from tactflow.vision import compiled

_COSTLIEST = 4
"""Stages named in a line of statistics. Chosen by hand: with them it fits on a wide terminal."""


@contextmanager
def progress_display(
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
            total = runner.max_frames or (runner.source.total if runner.source else None)
            rate = now.frames / now.elapsed_s if now.elapsed_s > 0 else 0.0
            display.update(task, completed=now.frames, total=total, rate=rate, dropped=now.dropped)

        def compiling(ready: int, total: int) -> None:
            done = ready == total
            text = runner.pipeline.sensor if done else f"compiling loops, {ready} of {total}"
            display.update(task, description=text)

        with compiled.reporting(compiling):
            yield update


def with_statistics(
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


def summary(result: RunResult, runner: Runner) -> str:
    """How a run ended: frames, drops, contacts, latency, and where each sink wrote."""
    stats = result.stats
    frames = "1 frame" if stats["frames"] == 1 else f"{stats['frames']} frames"
    # What went wrong was said already.
    end = "error" if result.error is not None else stats["end"]
    lines = [f"{frames} in {stats['wall_s']:.1f} s, {stats['dropped']} dropped ({end})"]
    touching = next((s for name, s in stats["signals"].items() if name.endswith(".touching")), None)
    if touching is not None:
        number = touching["true"]
        held = "1 frame" if number == 1 else f"{number} frames"
        lines.append(f"contacts: {touching['rises']} ({held} with contact)")
    latency = stats["latency_ms"]
    if latency["p50"] is not None:
        lines.append(f"latency: p50 {latency['p50']:.2f} ms, p99 {latency['p99']:.2f} ms")
    for name, node in runner.nodes.items():
        if node.sink is not None and node.sink.description:
            lines.append(f"{name}: {node.sink.description}")
    return "\n".join(lines)
