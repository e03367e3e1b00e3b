"""A whole stress test: its JSON, its tables for the terminal, and its page."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

from tactflow.system.terminal import markdown
from tactflow.tools.bench.quantities import QUANTITIES, Quantity
from tactflow.tools.page import (
    Html,
    Section,
    colour,
    dashes,
    details,
    key,
    marked,
    multiples,
    page,
    plain_numbers,
    plot,
    save_plot,
    series,
    table,
)
from tactflow.tools.stress.clips import SEEN_RMS
from tactflow.tools.stress.parts import PROMISES, Check, Curve, Listing, Part
from tactflow.tools.stress.same import Answers, rounded

SCHEMA: Final = "tactflow.stress/1"
_OWN_TITLES: Final = {
    SEEN_RMS: "seen dots, displacement error, RMS, px",
    "memory_mb": "memory, MB",
    "dots_drift": "mean displacement of dots at rest, px",
}
PANELS: Final = {SEEN_RMS: "seen dots", "center_error": "centre", "flow_error": "mean flow"}
"""Quantity -> name in the picture for the docs."""
DOUBLE: Final = 2.0
ERROR: Final = Quantity("error", "error", "")
"""A quantity that the bench does not know."""


@dataclass(slots=True)
class Report:
    """A run.

    Attributes
    ----------
    quick : whether it was the short one.
    machine : what it ran on.
    wall_s : how long it took, s.
    """

    quick: bool
    machine: dict[str, str]
    wall_s: float = 0.0
    parts: list[Part] = field(default_factory=list[Part])
    answers: Answers = field(default_factory=dict[str, list[dict[str, Any]]])

    @property
    def trials(self) -> int:
        """Frames and calls of stages in all."""
        return sum(part.trials for part in self.parts)

    @property
    def checks(self) -> list[Check]:
        """All checks, the worst first: broken before kept, those without promises last."""
        checks = [check for part in self.parts for check in part.checks]
        return sorted(checks, key=lambda check: (check.reference, check.kept, -check.excess))

    @property
    def broken(self) -> list[Check]:
        """Promises that are not kept."""
        return [check for check in self.checks if not check.kept and not check.reference]

    def save(self, path: Path) -> None:
        """Write everything as JSON."""
        value = asdict(self)
        value["answers"] = rounded(self.answers)
        value["promises"] = {name: asdict(promise) for name, promise in PROMISES.items()}
        value["broken"] = len(self.broken)
        text = json.dumps({"schema": SCHEMA, "trials": self.trials, **value}, allow_nan=False)
        path.write_text(text + "\n", encoding="utf-8")

    @property
    def summary(self) -> str:
        """One sentence about the run."""
        checked = sum(not check.reference for check in self.checks)
        return (
            f"{self.trials:,} trials in {self.wall_s / 60:.1f} minutes; {checked} promises checked, "
            f"{len(self.broken)} broken."
        )


def _number(value: float) -> str:
    return "0" if not value else f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


def _rows(report: Report) -> Iterator[tuple[str, list[str]]]:
    """Whether a check is kept, and the cells of its row."""
    for check in report.checks:
        promise = PROMISES[check.promise]
        word = "kept" if check.kept else "listed" if check.reference else "broken"
        limit = (
            f"{promise.title} {promise.tolerance:g} {promise.unit}".strip()
            if promise.tolerance
            else promise.title
        )
        measured = f"{_number(check.measured)} {promise.unit}".strip()
        yield word, [limit, check.subject, measured, check.where, promise.why]


HEADS: Final = ("", "promise", "subject", "measured", "worst at", "because")


def lines(report: Report) -> Iterator[str]:
    """The tables, as Markdown."""
    yield from markdown("Stability", report.summary)
    rows = [[word, *cells[:4]] for word, cells in _rows(report) if word != "kept"]
    if rows:
        yield from markdown("Promises that are broken", "", HEADS[:5], rows)
    for part in report.parts:
        yield from markdown(part.title, part.text)
        for listing in part.listings:
            if not listing.folded:
                yield from markdown(listing.title, listing.text, listing.columns, listing.rows)


def stress_page(report: Report) -> str:
    """The page, HTML."""
    kinds = {"kept": "good", "broken": "bad", "listed": "quiet"}
    rows = [[marked(word, kinds[word]), *cells] for word, cells in _rows(report)]
    kept = [row for row, check in zip(rows, report.checks, strict=True) if check.kept]
    rest = [row for row, check in zip(rows, report.checks, strict=True) if not check.kept]
    text = (
        "The worst first. The classic script and stages that no shipped pipeline uses are listed, not judged."
    )
    body = [table(HEADS, rest)] if rest else []
    sections = [Section("Promises", text, [*body, details(f"{len(kept)} are kept", table(HEADS, kept))])]
    for part in report.parts:
        fragments: list[Html] = []
        names = list(dict.fromkeys(curve.subject for curve in part.curves))
        if names:
            fragments.append(key(names))
        for quantity in dict.fromkeys(curve.quantity for curve in part.curves):
            curves = [curve for curve in part.curves if curve.quantity == quantity]
            panels = dict.fromkeys(curve.panel for curve in curves)
            plots = [_panel([c for c in curves if c.panel == panel], names) for panel in panels]
            fragments += [Html(f"<h3>{_title(quantity)}</h3>"), multiples(plots)]
        fragments += [_listing(listing) for listing in part.listings]
        text = f"{part.text}\n\n{part.trials:,} trials, {part.seconds:.0f} s."
        sections.append(Section(part.title, text, fragments))
    machine = ", ".join(f"{name} {value}" for name, value in report.machine.items())
    kind = "A quick run. " if report.quick else ""
    return page("Numerical stability", sections, f"{kind}{report.summary}\n\n{machine}")


def _title(quantity: str) -> str:
    return QUANTITIES[quantity].heading if quantity in QUANTITIES else _OWN_TITLES.get(quantity, quantity)


def _listing(listing: Listing) -> Html:
    if listing.folded:
        return details(listing.title, table(listing.columns, listing.rows))
    text = f"<p>{listing.text}</p>" if listing.text else ""
    return Html(f"<h3>{listing.title}</h3>{text}{table(listing.columns, listing.rows)}")


def _panel(curves: Sequence[Curve], names: Sequence[str]) -> Html:
    """A small plot: an error against a perturbation, a line for each subject."""

    def draw(figure: Any) -> None:
        axes = figure.subplots()
        for curve in curves:
            number = names.index(curve.subject)
            style = {"color": series(number), "linestyle": dashes(number)}
            axes.plot(range(len(curve.levels)), _with_gaps(curve.errors), marker="o", **style)
            if curve.bound is not None:
                axes.plot(
                    range(len(curve.levels)), curve.bound, color=series(number), linestyle=":", linewidth=1
                )
        known = [e for curve in curves for e in curve.errors if e is not None]
        if QUANTITIES.get(curves[0].quantity, ERROR).best == 0 and min(known) > 0:
            axes.set_yscale("log")
        if max(known) < DOUBLE * min(known):
            axes.set_ylim(min(known) / DOUBLE, max(known) * DOUBLE)
        _ticks(axes, curves[0])
        plain_numbers(axes)
        axes.set_title(curves[0].panel)

    bound = "dotted: Cramér-Rao bound" if any(curve.bound is not None for curve in curves) else ""
    return plot(draw, caption=bound, label=f"{_title(curves[0].quantity)} against {curves[0].panel}")


def _with_gaps(values: Sequence[float | None]) -> list[float]:
    return [math.nan if value is None else value for value in values]


def _ticks(axes: Any, curve: Curve) -> None:
    """Levels are not evenly spaced: each gets the same room."""
    every = max(1, len(curve.levels) // 6)
    places = list(range(0, len(curve.levels), every))
    axes.set_xticks(places, [f"{curve.levels[place]:g}" for place in places])
    axes.set_xlabel(curve.unit)


def save_picture(report: Report, path: Path, subject: str) -> None:
    """The picture of the docs: errors relative to the unperturbed scene, a panel for each perturbation.

    subject : pipeline, on a scene.
    """
    curves = [
        c for part in report.parts for c in part.curves if c.subject == subject and c.quantity in PANELS
    ]
    growth = dict.fromkeys(dict.fromkeys(curve.panel for curve in curves), 0.0)
    for curve in curves:
        if curve.errors[0]:
            growth[curve.panel] = max(
                [growth[curve.panel], *(e / curve.errors[0] for e in curve.errors if e)]
            )
    panels = sorted(growth, key=lambda panel: -growth[panel])

    def draw(figure: Any) -> None:
        columns = 4
        grid = figure.subplots(math.ceil(len(panels) / columns), columns, sharey=True).ravel()
        for axes, panel in zip(grid, panels, strict=False):
            for number, (quantity, name) in enumerate(PANELS.items()):
                for curve in (
                    c for c in curves if c.panel == panel and c.quantity == quantity and c.errors[0]
                ):
                    first = curve.errors[0] or 1.0
                    relative = [None if e is None else e / first for e in curve.errors]
                    axes.plot(_with_gaps(relative), marker="o", color=series(number), label=name)
                    _ticks(axes, curve)
            axes.axhline(DOUBLE, color=colour("quiet"), linewidth=1, linestyle=":")
            axes.set(yscale="log", title=panel)
        plain_numbers(grid[0])
        for axes in grid[len(panels) :]:
            axes.set_visible(False)
        figure.supylabel("error, relative to the undisturbed scene", fontsize="medium")
        handles, labels = grid[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=len(PANELS))

    save_plot(path, draw, width=1040, height=680)
