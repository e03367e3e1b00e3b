"""What skipping changed and saved, as tables in a terminal."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from rich.console import Console
from rich.table import Table

from tactflow.bench.skipping import ADVERSARIES, ALLOWED, ENOUGH, LARGEST, NUMBERS, STALE, Comparison
from tactflow.bench.table import tables_of
from tactflow.bench.timing import CopyUnit


def print_comparisons(comparisons: Sequence[Comparison], copies: CopyUnit, console: Console) -> None:
    """Three tables: what skipping changed, how long in the scenes made to catch it out, and what it saved."""
    console.print(*_changed(comparisons, console.width), sep="\n")
    console.print(
        f"beyond noise: RMS of at least {ENOUGH} values above {ALLOWED:g} x noise, a contact decision that "
        f"differs, or a number stale for more than {STALE} frame",
        style="dim",
    )
    console.print(*_caught(comparisons, console.width), sep="\n")
    console.print(
        f"stale: further from a fresh number than {LARGEST:g} x what two fresh ones differ by at most",
        style="dim",
    )
    console.print(*_saved(comparisons, copies, console.width), sep="\n")


def _changed(comparisons: Sequence[Comparison], width: int) -> Iterator[Table]:
    title = (
        "skipping on against off, what was repeated: RMS / largest difference (noise of one result / "
        "largest difference of two)"
    )
    numbers = [f"{name}, {unit}" for name, unit in NUMBERS.items()]
    heads = ["scene", "frames", "repeated", "decisions differ", *numbers, "beyond noise"]
    lines = [
        [
            one.scene,
            str(one.frames),
            f"{100 * one.repeated / max(one.frames, 1):.0f} %",
            str(one.decisions),
            *(_difference(one, name) for name in NUMBERS),
            "; ".join(one.faults) or "nothing",
        ]
        for one in comparisons
    ]
    return tables_of(title, heads, [lines], width)


def _difference(one: Comparison, name: str) -> str:
    """What a repeated number differs by from a fresh one, and in brackets its noise."""
    if name not in one.rms:
        return "-"
    noise = one.noise.get(name)
    own = f"{noise.rms:.2g} / {noise.largest:.2g}" if noise else "-"
    return f"{one.rms[name]:.2g} / {one.worst[name]:.2g} ({own})"


def _caught(comparisons: Sequence[Comparison], width: int) -> Iterator[Table]:
    title = f"scenes made to catch skipping out, frames (promised: missed 0, stale {STALE})"
    heads = ["scene", "contact missed", "number stale", "in all", "longest rest", "what it does"]
    lines = [
        [one.scene, *map(str, (one.missed, one.stale, one.late, one.rest)), ADVERSARIES[one.scene]]
        for one in comparisons
        if one.scene in ADVERSARIES
    ]
    return tables_of(title, heads, [lines], width)


def _saved(comparisons: Sequence[Comparison], copies: CopyUnit, width: int) -> Iterator[Table]:
    lines = []
    for one in comparisons:
        on, off = (one.times[name].summary()["cpu_ms_p50"] for name in ("on", "off"))
        lines.append(
            [one.scene, f"{on / copies.copy_ms:.1f}", f"{off / copies.copy_ms:.1f}", f"{on / off:.2f}"]
        )
    title = "median CPU time of a frame, copies of the raw frame"
    return tables_of(title, ["scene", "on", "off", "on / off"], [lines], width)
