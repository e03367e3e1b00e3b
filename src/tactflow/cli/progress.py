"""What `tactflow run` tells people: the progress of a run, lines of statistics, the summary at the end."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from tactflow.cli.statistics import share
from tactflow.cli.terminal import progress_bar, say
from tactflow.engine.run import Progress, Runner, RunResult

_MOST_STAGES = 4
"""Stages named in a line of statistics, the most expensive ones: they fit on a wide terminal."""


@contextmanager
def run_progress(
    runner: Runner, every: float | None, *, shown: bool
) -> Iterator[Callable[[Progress], None] | None]:
    """Count frames on a terminal, and print a line of statistics every so many seconds.

    Gives what the runner calls.
    """
    sensor = runner.pipeline.sensor
    with progress_bar(sensor, shown=shown) as bar:
        last: Mapping[str, Any] = {"frames": 0, "dropped": 0, "wall_s": 0.0, "stages": {}}

        def update(now: Progress) -> None:
            nonlocal last
            rate = now.frames / now.elapsed_s if now.elapsed_s > 0 else 0.0
            total = runner.max_frames or (runner.source.total if runner.source else None)
            text = f"{sensor}: {now.frames} frames, {rate:.0f}/s, {now.dropped} dropped"
            bar(completed=now.frames, total=total, description=text)
            if every is not None and now.elapsed_s >= last["wall_s"] + every:
                stats = runner.snapshot()
                say(statistics_line(stats, last))
                last = stats

        yield update


def statistics_line(stats: Mapping[str, Any], before: Mapping[str, Any]) -> str:
    """Frame rate, drops and latency, and how often the most expensive stages ran and what they cost.

    stats, before : statistics of a run now and earlier. The line is about the time between them, except for
    the latency, which is that of the run so far.
    """
    frames, dropped, seconds = (stats[key] - before[key] for key in ("frames", "dropped", "wall_s"))
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
    if costs:
        costs.sort(reverse=True)
        parts.append("a frame: " + ", ".join(text for _, text in costs[:_MOST_STAGES]))
    return "; ".join(parts)


def summary(result: RunResult, runner: Runner) -> str:
    """How a run ended: frames, drops, contacts, latency, and where each sink wrote."""
    stats = result.stats
    # The error itself has been printed already.
    end = "error" if result.error is not None else stats["end"]
    lines = [f"{_frames(stats['frames'])} in {stats['wall_s']:.1f} s, {stats['dropped']} dropped ({end})"]
    # The last stage that decides is the one whose decision the results carry.
    decisions = [s for name, s in stats["signals"].items() if name.endswith(".touching")]
    if decisions:
        touching = decisions[-1]
        lines.append(f"contacts: {touching['rises']} ({_frames(touching['true'])} with contact)")
    latency = stats["latency_ms"]
    if latency["p50"] is not None:
        lines.append(f"latency: p50 {latency['p50']:.2f} ms, p99 {latency['p99']:.2f} ms")
    for name, node in runner.nodes.items():
        if node.sink is not None and node.sink.description:
            lines.append(f"{name}: {node.sink.description}")
    return "\n".join(lines)


def _frames(count: int) -> str:
    return "1 frame" if count == 1 else f"{count} frames"
