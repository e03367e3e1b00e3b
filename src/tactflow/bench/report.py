"""The report of a run: one HTML page with tables, and plots of run time against error."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from statistics import median

from tactflow.bench.pipelines import PIPELINE
from tactflow.bench.quantities import QUANTITIES, Quantity
from tactflow.bench.results import BenchResult
from tactflow.bench.tables import PRIMARY, TITLES, sections
from tactflow.report import COLORS, Html, figure, picture, write_report

Point = tuple[float, float]
"""Time of a frame, copies, and distance of a quantity from its best value: medians over the scenes."""


def points(result: BenchResult, group: str, quantity: Quantity) -> dict[str, Point]:
    """The methods of a group that have a time, and an error in every scene in which one has it."""
    known = [m for m in result.measurements(group) if quantity.key in m.values and m.time_ms is not None]
    scenes = {m.scene for m in known}
    found = {}
    for method in dict.fromkeys(m.method for m in known):
        own = [m for m in known if m.method == method]
        if len(own) == len(scenes):
            cost = median(m.time_ms or 0.0 for m in own) / result.copy_ms
            found[method] = cost, median(quantity.distance(m.values[quantity.key]) for m in own)
    return found


def pareto(candidates: Mapping[str, Point]) -> list[str]:
    """The methods that no other beats in both time and error, by rising cost."""
    front: list[str] = []
    least = math.inf
    for method, (_, error) in sorted(candidates.items(), key=lambda item: item[1]):
        if error < least:
            front.append(method)
            least = error
    return front


def write_bench_report(result: BenchResult, path: Path) -> None:
    """Write the page.

    Raises
    ------
    StageError : the file cannot be written. ConfigError : matplotlib is missing.
    """
    groups = {TITLES.get(group, group): group for group in dict.fromkeys(m.group for m in result.measured)}
    pages = [
        replace(section, pictures=list(_plots(result, groups.get(section.title, ""))))
        for section in sections(result)
    ]
    text = (
        "Every method was given the same frames, taking turns, in one thread, and its answers were compared "
        "with the known truth. In the plots, down and left is better: a dot is a method at its median over "
        "the scenes, and the dashed line connects the methods that no other beats in both time and "
        "error. A method without an answer in some scene is not shown."
    )
    write_report(path, "Run time against error", pages, text)


def _plots(result: BenchResult, group: str) -> Iterator[Html]:
    for key in PRIMARY.get(group, ()):
        candidates = points(result, group, QUANTITIES[key])
        if len(candidates) >= 2:
            yield _plot(candidates, QUANTITIES[key], PIPELINE if group == PIPELINE else "method")


def _plot(candidates: Mapping[str, Point], quantity: Quantity, what: str) -> Html:
    drawing, axes = figure()
    front = pareto(candidates)
    axes.plot(*zip(*(candidates[name] for name in front), strict=True), "--", color=COLORS[0], linewidth=1)
    for name, point in candidates.items():
        axes.plot(*point, "o", color=COLORS[0] if name in front else COLORS[-1])
        axes.annotate(name, point, (5, 4), textcoords="offset points", fontsize=8)
    errors = [error for _, error in candidates.values() if error > 0]
    axes.set_xscale("log")
    # Errors of zero stand on the axis.
    axes.set_yscale("symlog", linthresh=min(errors, default=1.0))
    axes.set_ylim(0, 2 * max(errors, default=1.0))
    axes.set_xlabel(f"time of a frame of this {what}, copies of a raw frame")
    away = "" if quantity.best == 0 else f", away from {quantity.best:g}"
    axes.set_ylabel(quantity.unit)
    return picture(drawing, quantity.title + away)
