"""The result as tables in a terminal."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from statistics import median
from typing import Final, TextIO

from rich.cells import cell_len
from rich.console import Console, JustifyMethod
from rich.table import Table
from rich.text import Text

from tactflow.bench.pareto import limit_of, pareto, points
from tactflow.bench.quantities import QUANTITIES, format_number
from tactflow.bench.report import PRIMARY, TITLES
from tactflow.bench.results import RECORDING, Measurement, Result

UNLIMITED: Final = 1000
"""Columns of what is no terminal: more than any table has."""
BORDER: Final = 3
"""Columns that a column takes beside its text: a line and a space on both sides."""


def terminal(file: TextIO) -> Console:
    """Where tables go: as wide as the terminal, or without a limit where `file` is none, such as a pipe."""
    return Console(file=file, highlight=False, width=None if file.isatty() else UNLIMITED)


def print_result(result: Result, console: Console) -> None:
    """Print everything that fits a terminal: the answer per stage, whole pipelines, the promises."""
    console.print(
        f"one copy of a raw 800 x 600 x 3 frame: {result.copy_ms:.3f} ms, between memory that is there; "
        f"a page of fresh memory: {result.fault_us:.2f} us; to touch every byte once: "
        f"{result.touch_ms / result.copy_ms:.2f} copies; times are CPU times in one thread"
    )
    for group in result.groups():
        console.print(*_methods(result, group, console.width), sep="\n")
        console.print("median over scenes (worst); * on the Pareto front of time and error", style="dim")
    console.print(*_scenes(result, console.width), sep="\n")
    console.print(_targets(result))
    for measurement in result.measurements:
        if measurement.failure:
            console.print(f"{measurement.key}: {measurement.failure}", style="red", markup=False)


def _methods(result: Result, group: str, width: int) -> Iterator[Table]:
    """One line per method: median over the scenes, in brackets the worst one."""
    quantities = [QUANTITIES[name] for name in PRIMARY.get(group, ())]
    fronts = {q.key: {p.method for p in pareto(points(result, group, q))} for q in quantities}
    heads = ["method", "contact, copies", "idle, copies", "x classic"]
    for quantity in quantities:
        heading = quantity.title + (f", {quantity.unit}" if quantity.unit else "")
        limit = limit_of(result, group, quantity)
        heads.append(heading + (f" (limit {format_number(limit)})" if limit else ""))
    lines = []
    for method in result.methods(group):
        rows = [m for m in result.of(group, method) if not m.scene.startswith(RECORDING)]
        if not rows:
            continue
        cells = [method, _median(rows, "contact"), _median(rows, "idle"), _ratio(rows)]
        for quantity in quantities:
            values = [m.errors[quantity.key] for m in rows if quantity.key in m.errors]
            if not values:
                cells.append("-")
                continue
            worst = max(values, key=quantity.distance)
            text = f"{format_number(median(values))} ({format_number(worst)})"
            on_front = method in fronts[quantity.key] and len(result.methods(group)) > 1
            cells.append(f"[green]{text} *[/green]" if on_front else text)
        lines.append(cells)
    return tables_of(TITLES.get(group, group), heads, [lines], width)


def tables_of(
    title: str, heads: Sequence[str], sections: Sequence[Sequence[Sequence[str]]], width: int, keys: int = 1
) -> Iterator[Table]:
    """Tables of as many columns as fit into `width`, each with the first `keys` of them: no cell is cut.

    heads : a heading for each column, broken between words. sections : of rows of cells, with markup.
    width : columns of the terminal.
    """
    rows = [row for section in sections for row in section]
    widths = [
        max(map(cell_len, [*head.split(), *(Text.from_markup(row[k]).plain for row in rows)]))
        for k, head in enumerate(heads)
    ]
    left = list(range(keys, len(heads)))
    while left:
        taken = [*range(keys), left.pop(0)]
        while left and sum(widths[k] + BORDER for k in [*taken, left[0]]) < width:
            taken.append(left.pop(0))
        table = Table(title=title, title_justify="left", title_style="bold")
        for k in taken:
            justify: JustifyMethod = "left" if k < keys else "right"
            table.add_column(heads[k], justify=justify, width=widths[k], overflow="fold")
        for section in sections:
            for row in section:
                table.add_row(*(row[k] for k in taken))
            table.add_section()
        yield table


def _median(rows: list[Measurement], kind: str) -> str:
    values = [m.copies[kind] for m in rows if kind in m.copies]
    return format_number(median(values)) if values else "-"


def _ratio(rows: list[Measurement]) -> str:
    values = [m.faster.get("contact", m.faster.get("idle")) for m in rows]
    known = [value for value in values if value is not None]
    return format_number(median(known)) if known else "-"


def _scenes(result: Result, width: int) -> Iterator[Table]:
    """Whole pipelines, scene by scene."""
    names = (
        "displacement_rms",
        "wrong_percent",
        "lost_percent",
        "contact_iou",
        "hull_iou",
        "center_error",
        "angle_mean",
        "flow_error",
        "false_contacts",
        "missed_contacts",
    )
    short = (
        "marker RMS px",
        "wrong %",
        "lost %",
        "mask IoU",
        "hull IoU",
        "centre px",
        "angle deg",
        "flow px",
        "false %",
        "missed %",
    )
    rows = [m for m in result.of("pipeline") if not m.scene.startswith(RECORDING)]
    sections = []
    for scene in dict.fromkeys(m.scene for m in rows):
        lines = []
        for m in (m for m in rows if m.scene == scene):
            copies = m.copies.get("contact", m.copies.get("idle"))
            faster = m.faster.get("contact", m.faster.get("idle"))
            cells = [_cell(copies), _cell(faster), *(_cell(m.errors.get(name)) for name in names)]
            lines.append([scene, m.method, *cells])
        sections.append(lines)
    heads = ["scene", "pipeline", "copies", "x classic", *short]
    return tables_of("Whole pipelines, scene by scene", heads, sections, width, keys=2)


def _cell(value: float | None) -> str:
    return "" if value is None else format_number(value)


def _targets(result: Result) -> Table:
    """Promise beside result."""
    table = Table(title="Promises and results", title_justify="left", title_style="bold")
    for heading in ("quantity", "target", "result", "", "measured on"):
        table.add_column(heading, overflow="fold")
    marks = {True: "[green]met[/green]", False: "[red]missed[/red]", None: "-"}
    for target in result.targets:
        table.add_row(target.quantity, target.target, target.result, marks[target.met], target.on)
    return table
