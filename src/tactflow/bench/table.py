"""The result as tables in a terminal."""

from __future__ import annotations

from statistics import median

from rich.console import Console
from rich.table import Table

from tactflow.bench.pareto import limit_of, pareto, points
from tactflow.bench.quantities import QUANTITIES, format_number
from tactflow.bench.report import PRIMARY, TITLES
from tactflow.bench.results import RECORDING, Measurement, Result


def print_result(result: Result, console: Console) -> None:
    """Print everything that fits a terminal: the answer per stage, whole pipelines, the promises."""
    console.print(
        f"one copy of a raw 800 x 600 x 3 frame: {result.copy_ms:.3f} ms, between memory that is there; "
        f"a page of fresh memory: {result.fault_us:.2f} us; to touch every byte once: "
        f"{result.touch_ms / result.copy_ms:.2f} copies; times are CPU times in one thread"
    )
    for group in result.groups():
        console.print(_methods(result, group))
    console.print(_scenes(result))
    console.print(_targets(result))
    for measurement in result.measurements:
        if measurement.failure:
            console.print(f"{measurement.key}: {measurement.failure}", style="red", markup=False)


def _methods(result: Result, group: str) -> Table:
    """One line per method: median over the scenes, in brackets the worst one."""
    quantities = [QUANTITIES[name] for name in PRIMARY.get(group, ())]
    fronts = {q.key: {p.method for p in pareto(points(result, group, q))} for q in quantities}
    table = Table(title=TITLES.get(group, group), title_justify="left", title_style="bold")
    table.add_column("method")
    for heading in ("contact, copies", "idle, copies", "x classic"):
        table.add_column(heading, justify="right")
    for quantity in quantities:
        heading = quantity.title + (f", {quantity.unit}" if quantity.unit else "")
        limit = limit_of(result, group, quantity)
        table.add_column(heading + (f" (limit {format_number(limit)})" if limit else ""), justify="right")
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
        table.add_row(*cells)
    table.caption = "median over scenes (worst scene); * on the Pareto front of time and error"
    table.caption_justify = "left"
    return table


def _median(rows: list[Measurement], kind: str) -> str:
    values = [m.copies[kind] for m in rows if kind in m.copies]
    return format_number(median(values)) if values else "-"


def _ratio(rows: list[Measurement]) -> str:
    values = [m.faster.get("contact", m.faster.get("idle")) for m in rows]
    known = [value for value in values if value is not None]
    return format_number(median(known)) if known else "-"


def _scenes(result: Result) -> Table:
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
    table = Table(title="Whole pipelines, scene by scene", title_justify="left", title_style="bold")
    table.add_column("scene")
    table.add_column("pipeline")
    table.add_column("copies", justify="right")
    table.add_column("x classic", justify="right")
    for heading in short:
        table.add_column(heading, justify="right")
    rows = [m for m in result.of("pipeline") if not m.scene.startswith(RECORDING)]
    for scene in dict.fromkeys(m.scene for m in rows):
        for m in (m for m in rows if m.scene == scene):
            copies = m.copies.get("contact", m.copies.get("idle"))
            faster = m.faster.get("contact", m.faster.get("idle"))
            cells = [_cell(copies), _cell(faster), *(_cell(m.errors.get(name)) for name in names)]
            table.add_row(scene, m.method, *cells)
        table.add_section()
    return table


def _cell(value: float | None) -> str:
    return "" if value is None else format_number(value)


def _targets(result: Result) -> Table:
    """Promise beside result."""
    table = Table(title="Promises and results", title_justify="left", title_style="bold")
    for heading in ("quantity", "target", "result", "", "measured on"):
        table.add_column(heading)
    marks = {True: "[green]met[/green]", False: "[red]missed[/red]", None: "-"}
    for target in result.targets:
        table.add_row(target.quantity, target.target, target.result, marks[target.met], target.on)
    return table
