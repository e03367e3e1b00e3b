"""The report: what is collected from the results of a run, and the page."""

from __future__ import annotations

import base64
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from tactflow.drawing.curves import Curves
from tactflow.message.result import Result
from tactflow.tools.batch.summary import Summary
from tactflow.tools.page import Html, Section, colour, details, multiples, page, plot, series, table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WORK_KINDS = ("in full", "glanced at", "repeated")
"""What was done with a frame."""
_NOT_RUN = "Statistics of the run show where time went: tactflow run --stats run.json, then --stats run.json."
_NOTHING_SKIPPED = "Every value was computed in every frame."


class Report:
    """Collects one sensor's results, in bounded memory but for a few numbers of each frame."""

    def __init__(self) -> None:
        self.curves = Curves()
        self.summary = Summary()
        self.work: Counter[str] = Counter()
        self.skipped: Counter[tuple[str, str]] = Counter()
        self.dropped = 0
        self._seq: int | None = None

    def add(self, result: Result) -> None:
        """Add one frame."""
        self.curves.add(result.to_dict())
        self.summary.add(result)
        self.work[_work(result.skipped)] += 1
        self.skipped.update(result.skipped.items())
        if self._seq is not None:
            self.dropped += max(0, result.seq - self._seq - 1)
        self._seq = result.seq

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.curves.t)


def _work(skipped: Mapping[str, str]) -> str:
    reasons = skipped.values()
    return (
        WORK_KINDS[1] if "at_rest" in reasons else WORK_KINDS[2] if "unchanged" in reasons else WORK_KINDS[0]
    )


def collect(results: Iterable[Result]) -> dict[str, Report]:
    """Sensor -> what its results say."""
    reports: dict[str, Report] = {}
    for result in results:
        reports.setdefault(result.sensor, Report()).add(result)
    return reports


def report_page(title: str, reports: Mapping[str, Report], statistics: Mapping[str, Any] | None) -> str:
    """The page, HTML. statistics : of the run, as `--stats` writes them; or None."""
    sections: list[Section] = []
    for sensor, report in reports.items():
        name = f", {sensor}" if len(reports) > 1 else ""
        sections += [
            Section(f"Over time{name}", "Contacts are shaded.", [multiples(_curves(report))]),
            Section(f"Largest contacts{name}", body=[multiples(_pictures(report))]),
            Section(f"Contacts{name}", body=[_contacts(report)]),
            _skipping(name, report),
        ]
    sections.append(_times(statistics))
    lead = "\n\n".join(_summary(sensor, report) for sensor, report in reports.items())
    return page(title, sections, lead)


def _summary(sensor: str, report: Report) -> str:
    duration = float(report.curves.t[-1])
    touching = 100 * report.summary.touching / report.frames
    gaps = f", {report.dropped} dropped between them" if report.dropped else ""
    contacts = len(report.curves.contacts())
    return (
        f"{sensor}: {report.frames} frames in {duration:.1f} s{gaps}; {contacts} contacts, "
        f"{touching:.0f} % of the frames; the largest has {report.summary.largest:.0f} px²."
    )


def _curves(report: Report) -> Iterator[Html]:
    for quantity in report.curves.present():

        def draw(figure: Figure, quantity: Any = quantity) -> None:
            report.curves.draw(figure.subplots(), quantity)

        yield plot(draw)


def _pictures(report: Report) -> Iterator[Html]:
    pictures = report.summary.pictures()
    if not pictures:
        yield Html("<p>No contact.</p>")
    for picture in pictures:
        caption = f"{picture.t:.2f} s, {picture.area:.0f} px²"
        data = base64.b64encode(picture.jpeg).decode()
        yield Html(
            f'<figure><img src="data:image/jpeg;base64,{data}" alt="{escape(caption)}">'
            f"<figcaption>{escape(caption)}</figcaption></figure>"
        )


def _contacts(report: Report) -> Html:
    """A row per contact: when, how long, and the largest value of each quantity during it."""
    present = [quantity for quantity in report.curves.present() if quantity.grows]
    heads = [f"{q.title.lower()}, at most{q.unit and ', ' + q.unit}" for q in present]
    rows = []
    for began, ended in report.curves.contacts():
        during = (report.curves.t >= began) & (report.curves.t <= ended)
        row = [f"{began:.2f}", f"{ended - began:.2f}"]
        for quantity in present:
            parts = [report.curves.values(quantity, label)[during] for label in quantity.curves]
            length = np.sqrt(np.sum(np.square(parts), axis=0)) if len(parts) > 1 else np.abs(parts[0])
            known = length[np.isfinite(length)]
            row.append(_number(float(known.max())) if known.size else "")
        rows.append(row)
    return table(["begins, s", "lasts, s", *heads], rows, sortable=True)


def _number(value: float) -> str:
    return f"{value:.0f}" if value >= 1000 else f"{value:.3g}"


def _skipping(name: str, report: Report) -> Section:
    """What was done with the frames, and what was not computed, and why."""

    def draw(figure: Figure) -> None:
        axes, left = figure.subplots(), 0.0
        for index, kind in enumerate(WORK_KINDS):
            share = 100 * report.work[kind] / report.frames
            axes.barh([0], [share], left=left, color=series(index), label=f"{kind}: {share:.0f} %")
            left += share
        axes.set(yticks=[], xlabel="frames, %", xlim=(0, 100))
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, 1.35), ncols=len(WORK_KINDS))

    rows = [
        [port, reason, count, f"{100 * count / report.frames:.1f} %"]
        for (port, reason), count in sorted(report.skipped.items(), key=lambda item: (-item[1], item[0]))
    ]
    body = [plot(draw, width=720, height=110)]
    body.append(details("what was not computed, and why", table(["value", "reason", "frames", ""], rows)))
    if not rows:
        return Section(f"Skipped{name}", _NOTHING_SKIPPED)
    return Section(f"Skipped{name}", body=body)


def _times(statistics: Mapping[str, Any] | None) -> Section:
    """Time by stage, from the statistics of the run."""
    if statistics is None:
        return Section("Where time went", _NOT_RUN)
    stages = {
        id_: entry
        for id_, entry in statistics["stages"].items()
        if entry["runs"] and entry["p50_ms"] is not None
    }
    # The first one is the source, which mostly waits.
    totals = {id_: stages[id_]["runs"] * stages[id_]["p50_ms"] / 1e3 for id_ in list(stages)[1:]}

    def draw(figure: Figure) -> None:
        axes, names = figure.subplots(), list(totals)[::-1]
        axes.barh(names, [totals[name] for name in names], color=colour("series-1"))
        axes.set(xlabel="runs times median, s")

    rows = [
        [id_, entry["runs"], sum(entry["skips"].values()), f"{entry['p50_ms']:.3f}", f"{entry['p99_ms']:.3f}"]
        for id_, entry in stages.items()
    ]
    latency = statistics["latency_ms"]
    text = f"{statistics['frames']} frames in {statistics['wall_s']:.1f} s, {statistics['dropped']} dropped."
    if latency["p50"] is not None:
        text += (
            f" From capture to result: median {latency['p50']:.2f} ms, 99 % within {latency['p99']:.2f} ms."
        )
    shown = table(["stage", "runs", "skipped", "median, ms", "99 % within, ms"], rows, sortable=True)
    return Section("Where time went", text, [plot(draw, width=720, height=40 + 22 * len(totals)), shown])
