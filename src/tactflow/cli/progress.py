"""The progress of `tactflow run`, and the summary at its end."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from tactflow.engine.run import Progress, Runner, RunResult
from tactflow.system.terminal import progress_bar

END_WORDS = {"eos": "end of source", "max_frames": "--max-frames reached", "signal": "stopped"}
"""`end` of the statistics, in words."""


@contextmanager
def run_progress(runner: Runner, *, shown: bool) -> Iterator[Callable[[Progress], None]]:
    """Show the number of frames on a terminal; yields the function that the runner calls."""
    sensor = runner.pipeline.sensor
    with progress_bar(sensor, shown=shown) as bar:

        def update(now: Progress) -> None:
            rate = now.frames / now.elapsed_s if now.elapsed_s > 0 else 0.0
            total = runner.max_frames or (runner.source.total if runner.source else None)
            text = f"{sensor}: {now.frames} frames, {rate:.0f}/s, {now.dropped} dropped"
            bar(completed=now.frames, total=total, description=text)

        yield update


def summary(result: RunResult, runner: Runner) -> str:
    """How a run ended: frames, drops, contacts, latency, and where each sink wrote."""
    stats = result.stats
    # The error itself has been printed already.
    end = "error" if result.error is not None else END_WORDS.get(stats["end"], stats["end"])
    lines = [f"{_frames(stats['frames'])} in {stats['wall_s']:.1f} s, {stats['dropped']} dropped ({end})"]
    # The last one is that of the results.
    contacts = [s for name, s in stats["signals"].items() if name.endswith(".contact")]
    if contacts:
        lines.append(f"contacts: {contacts[-1]['rises']} ({_frames(contacts[-1]['true'])} with contact)")
    latency = stats["latency_ms"]
    if latency["p50"] is not None:
        lines.append(f"latency: p50 {latency['p50']:.2f} ms, p99 {latency['p99']:.2f} ms")
    for name, node in runner.nodes.items():
        if node.sink is not None and node.sink.description:
            lines.append(f"{name}: {node.sink.description}")
    return "\n".join(lines)


def _frames(count: int) -> str:
    return "1 frame" if count == 1 else f"{count} frames"
