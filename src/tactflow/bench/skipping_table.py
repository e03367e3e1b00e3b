"""What skipping changed and saved, as tables in a terminal."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console
from rich.table import Table

from tactflow.bench.skipping import ADVERSARIES, ALLOWED, ENOUGH, LARGEST, NUMBERS, STALE, Comparison
from tactflow.bench.timing import CopyUnit


def print_comparisons(comparisons: Sequence[Comparison], copies: CopyUnit, console: Console) -> None:
    """Three tables: what skipping changed, how long in the scenes made to catch it out, and what it saved."""
    console.print(_changed(comparisons))
    console.print(_caught(comparisons))
    console.print(_saved(comparisons, copies))


def _changed(comparisons: Sequence[Comparison]) -> Table:
    table = Table(
        title="skipping on against off, what was repeated: RMS / largest difference (noise of one result / "
        "largest difference of two)",
        title_justify="left",
        title_style="bold",
    )
    table.add_column("scene")
    for heading in ("frames", "repeated", "decisions differ"):
        table.add_column(heading, justify="right")
    for name, unit in NUMBERS.items():
        table.add_column(f"{name}, {unit}", justify="right")
    table.add_column("beyond noise")
    for one in comparisons:
        repeated = f"{100 * one.repeated / max(one.frames, 1):.0f} %"
        numbers = [_difference(one, name) for name in NUMBERS]
        faults = "; ".join(one.faults) or "nothing"
        table.add_row(one.scene, str(one.frames), repeated, str(one.decisions), *numbers, faults)
    table.caption = (
        f"beyond noise: RMS of at least {ENOUGH} values above {ALLOWED:g} x noise, a contact decision that "
        f"differs, or a number stale for more than {STALE} frame"
    )
    table.caption_justify = "left"
    return table


def _difference(one: Comparison, name: str) -> str:
    """What a repeated number differs by from a fresh one, and in brackets its noise."""
    if name not in one.rms:
        return "-"
    noise = one.noise.get(name)
    own = f"{noise.rms:.2g} / {noise.largest:.2g}" if noise else "-"
    return f"{one.rms[name]:.2g} / {one.worst[name]:.2g} ({own})"


def _caught(comparisons: Sequence[Comparison]) -> Table:
    table = Table(
        title=f"scenes made to catch skipping out, frames (promised: missed 0, stale {STALE})",
        title_justify="left",
    )
    for heading in ("scene", "what it does", "contact missed", "number stale", "in all", "longest rest"):
        table.add_column(heading, justify="left" if heading in ("scene", "what it does") else "right")
    for one in comparisons:
        if one.scene in ADVERSARIES:
            counts = (one.missed, one.stale, one.late, one.rest)
            table.add_row(one.scene, ADVERSARIES[one.scene], *map(str, counts))
    table.caption = (
        f"stale: further from a fresh number than {LARGEST:g} x what two fresh ones differ by at most"
    )
    table.caption_justify = "left"
    return table


def _saved(comparisons: Sequence[Comparison], copies: CopyUnit) -> Table:
    table = Table(title="median CPU time of a frame, copies of the raw frame", title_justify="left")
    for heading in ("scene", "on", "off", "on / off"):
        table.add_column(heading, justify="left" if heading == "scene" else "right")
    for one in comparisons:
        on, off = (one.times[name].summary()["cpu_ms_p50"] for name in ("on", "off"))
        table.add_row(
            one.scene, f"{on / copies.copy_ms:.1f}", f"{off / copies.copy_ms:.1f}", f"{on / off:.2f}"
        )
    return table
