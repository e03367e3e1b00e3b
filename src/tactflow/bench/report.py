"""The report of a run: one HTML page with tables, and plots of run time against error."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median

from tactflow.bench.pipelines import PIPELINE
from tactflow.bench.quantities import QUANTITIES, Quantity
from tactflow.bench.results import RECORDING, BenchResult
from tactflow.bench.tables import PRIMARY, TITLES, sections
from tactflow.report import COLORS, Html, figure, picture, write_report


@dataclass(frozen=True, slots=True)
class Point:
    """One method in a plot. cost : time of a frame, copies. error : median over the scenes, least, worst."""

    method: str
    cost: float
    error: float
    least: float
    worst: float


def points(result: BenchResult, group: str, quantity: Quantity) -> list[Point]:
    """The methods of a group that have a time, and an error in every simulated scene in which one has it."""
    known = [
        m
        for m in result.measurements(group)
        if quantity.key in m.values and m.time_ms is not None and not m.scene.startswith(RECORDING)
    ]
    scenes = {m.scene for m in known}
    found = []
    for method in dict.fromkeys(m.method for m in known):
        own = [m for m in known if m.method == method]
        if len(own) == len(scenes):
            cost = median(m.time_ms or 0.0 for m in own) / result.copy_ms
            errors = [quantity.distance(m.values[quantity.key]) for m in own]
            found.append(Point(method, cost, median(errors), min(errors), max(errors)))
    return found


def pareto(candidates: Sequence[Point]) -> list[Point]:
    """The points that no other beats in both time and error, by rising cost."""
    front: list[Point] = []
    for point in sorted(candidates, key=lambda p: (p.cost, p.error)):
        if not front or point.error < front[-1].error:
            front.append(point)
    return front


def write_bench_report(result: BenchResult, path: Path) -> None:
    """Write the page.

    Raises
    ------
    StageError : the file cannot be written. ConfigError : matplotlib is missing.
    """
    by_title = {TITLES.get(group, group): group for group in dict.fromkeys(m.group for m in result.measured)}
    pages = []
    for section in sections(result):
        group = by_title.get(section.title)
        pictures = [] if group is None else list(_plots(result, group))
        pages.append(replace(section, pictures=pictures))
    text = (
        "Every method was given the same frames, taking turns, in one thread, and its answers were compared "
        "with the known truth. In the plots, down and left is better: a dot is a method at its median over "
        "the simulated scenes, its line reaches from the best scene to the worst, and the dashed line "
        "connects the methods that no other beats in both time and error. A method without an answer in some "
        "scene is not shown."
    )
    write_report(path, "Run time against error", pages, text)


def _plots(result: BenchResult, group: str) -> Iterator[Html]:
    for key in PRIMARY.get(group, ()):
        candidates = points(result, group, QUANTITIES[key])
        if len(candidates) >= 2:
            yield _plot(candidates, QUANTITIES[key], PIPELINE if group == PIPELINE else "method")


def _plot(candidates: Sequence[Point], quantity: Quantity, what: str) -> Html:
    drawing, axes = figure()
    front = pareto(candidates)
    axes.plot([p.cost for p in front], [p.error for p in front], "--", color=COLORS[0], linewidth=1)
    for point in candidates:
        color = COLORS[0] if point in front else COLORS[-1]
        axes.plot([point.cost] * 2, [point.least, point.worst], color=color, linewidth=1, alpha=0.5)
        axes.plot(point.cost, point.error, "o", color=color)
        axes.annotate(point.method, (point.cost, point.error), (5, 4), textcoords="offset points", fontsize=8)
    axes.set_xscale("log")
    costs = [math.log10(p.cost) for p in candidates]
    axes.set_xlim(10 ** math.floor(min(costs) - 0.1), 10 ** math.ceil(max(costs) + 0.1))
    # Errors of zero stand on the axis.
    errors = [error for p in candidates for error in (p.least, p.error, p.worst) if error > 0]
    axes.set_yscale("symlog", linthresh=min(errors, default=1.0))
    axes.set_ylim(0, 1.5 * max(errors, default=1.0))
    axes.set_xlabel(f"time of a frame of this {what}, copies of a raw frame")
    away = "" if quantity.best == 0 else f", away from {quantity.best:g}"
    axes.set_ylabel(quantity.unit)
    return picture(drawing, quantity.title + away)
