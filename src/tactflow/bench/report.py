"""The report: one HTML file that needs nothing else, with plots drawn here as SVG.

It is written to answer one question, "which method should I use, and what does it cost me?": first the
answer per stage, then what was promised and what came of it, then run time against error for each quantity,
then everything that was measured.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from html import escape
from statistics import median

from tactflow.bench.quantities import QUANTITIES, Quantity
from tactflow.bench.results import RECORDING, Measurement, Result

TITLES = {
    "pipeline": "Whole pipelines",
    "preprocess": "Preprocessing",
    "marker_mask": "Marker mask",
    "inpaint": "Marker removal",
    "difference": "Contact or not, and where",
    "hull": "Contact geometry",
    "tracker": "Marker tracking",
    "flow_in_mask": "Flow inside the contact",
}
"""Group -> heading."""

PRIMARY = {
    "pipeline": ("displacement_rms", "center_error", "angle_mean", "hull_iou", "flow_error"),
    "marker_mask": ("marker_recall", "localisation_rms"),
    "inpaint": ("inpaint_mae",),
    "difference": ("contact_iou", "center_error", "false_contacts", "missed_contacts"),
    "hull": ("angle_mean", "center_error"),
    "tracker": ("displacement_rms", "displacement_p99", "wrong_percent"),
    "flow_in_mask": ("flow_error",),
}
"""Group -> quantities that are plotted; the first one decides the answer."""


@dataclass(frozen=True, slots=True)
class Point:
    """One method in a plot.

    cost : copies of a raw frame. error : median over scenes, as distance from the perfect value.
    low, high : the best and the worst scene. scenes : how many, worst : the name of the worst one.
    missing : scenes in which others have this quantity and this method has nothing to show.
    """

    method: str
    cost: float
    error: float
    low: float
    high: float
    scenes: int
    worst: str
    missing: int = 0


def cost_of(measurements: Iterable[Measurement]) -> float | None:
    """Median over scenes of the time of a frame with contact, copies; of any frame where none had contact."""
    costs = [m.copies.get("contact", m.copies.get("all", m.copies.get("idle"))) for m in measurements]
    known = [cost for cost in costs if cost]
    return median(known) if known else None


def points(result: Result, group: str, quantity: Quantity) -> list[Point]:
    """One point per method of a group that has both a time and this error."""
    known = {
        method: [m for m in result.of(group, method) if quantity.key in m.errors]
        for method in result.methods(group)
    }
    everywhere = {m.scene for rows in known.values() for m in rows}
    found = []
    for method, rows in known.items():
        cost = cost_of(rows)
        if not rows or cost is None:
            continue
        errors = [quantity.distance(m.errors[quantity.key]) for m in rows]
        worst = max(zip(errors, (m.scene for m in rows), strict=True))
        missing = len(everywhere) - len(rows)
        found.append(
            Point(method, cost, median(errors), min(errors), max(errors), len(rows), worst[1], missing)
        )
    return found


def pareto(candidates: Sequence[Point]) -> list[Point]:
    """The points that no other beats in both time and error, by rising cost.

    A method that has nothing to show in some scenes is left out: its median is that of the easy ones.
    """
    front: list[Point] = []
    whole = [p for p in candidates if not p.missing]
    for point in sorted(whole, key=lambda p: (p.cost, p.error)):
        if not front or point.error < front[-1].error:
            front.append(point)
    return front


def format_number(value: float) -> str:
    """Three significant digits without an exponent where it stays readable."""
    if value == 0:
        return "0"
    if not 1e-4 <= abs(value) < 1e5:
        return f"{value:.1e}"
    digits = max(0, 2 - math.floor(math.log10(abs(value))))
    text = f"{value:.{digits}f}"
    return text.rstrip("0").rstrip(".") if "." in text else text


@dataclass(frozen=True, slots=True)
class _Box:
    x0: float
    y0: float
    x1: float
    y1: float

    def overlap(self, other: _Box) -> float:
        width = min(self.x1, other.x1) - max(self.x0, other.x0)
        height = min(self.y1, other.y1) - max(self.y0, other.y0)
        return width * height if width > 0 and height > 0 else 0.0


WIDTH, HEIGHT = 620, 400
_LEFT, _RIGHT, _TOP, _BOTTOM = 78, 16, 14, 52
_ZERO_BAND = 26


@dataclass(frozen=True, slots=True)
class _Axis:
    """A logarithmic axis from 10^low to 10^high between two pixel positions."""

    low: float
    high: float
    start: float
    end: float

    def at(self, value: float) -> float:
        return self.start + (math.log10(value) - self.low) / (self.high - self.low) * (self.end - self.start)

    def ticks(self) -> list[float]:
        steps = (1, 2, 5) if self.high - self.low < 2.2 else (1,)
        decades = range(math.floor(self.low), math.ceil(self.high) + 1)
        values = [step * 10.0**decade for decade in decades for step in steps]
        return [v for v in values if self.low - 1e-9 <= math.log10(v) <= self.high + 1e-9]


def _span(values: Sequence[float], least: float) -> tuple[float, float]:
    low, high = math.log10(min(values)), math.log10(max(values))
    middle, half = (low + high) / 2, max((high - low) / 2 * 1.12 + 0.06, least / 2)
    return middle - half, middle + half


def scatter(candidates: Sequence[Point], quantity: Quantity, limit: float | None, floor: float | None) -> str:
    """Run time against error as SVG, both axes logarithmic.

    Parameters
    ----------
    candidates : at least one point.
    quantity : what the y axis shows.
    limit : smallest error that physics allows, or None.
    floor : cost of touching every byte of a raw frame once, copies, or None.
    """
    front = pareto(candidates)
    has_zero = any(p.low == 0 for p in candidates)
    positive = [v for p in candidates for v in (p.low, p.error, p.high) if v > 0]
    if limit:
        positive.append(limit)
    bottom = HEIGHT - _BOTTOM - (_ZERO_BAND if has_zero else 0)
    costs = [p.cost for p in candidates] + ([floor] if floor else [])
    low, high = _span(costs, 1.2)
    # Room for the name of the slowest one.
    x_axis = _Axis(low, high + 0.28 * (high - low), _LEFT, WIDTH - _RIGHT)
    y_axis = _Axis(*_span(positive or [1.0], 1.2), bottom, _TOP)
    zero_y = HEIGHT - _BOTTOM - _ZERO_BAND / 2

    def y_of(value: float) -> float:
        return y_axis.at(value) if value > 0 else zero_y

    out: list[str] = []
    add = out.append
    unit = f", {quantity.unit}" if quantity.unit else ""
    measured = f"error{unit}" if quantity.best == 0 else f"distance from {format_number(quantity.best)}{unit}"
    shown = quantity.title if quantity.best == 0 else f"{format_number(quantity.best)} - {quantity.title}"
    add(
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" '
        f'aria-label="{escape(shown)} against run time"><title>{escape(shown)} against run time</title>'
    )
    for value in x_axis.ticks():
        x = x_axis.at(value)
        add(f'<line class="grid" x1="{x:.1f}" y1="{_TOP}" x2="{x:.1f}" y2="{HEIGHT - _BOTTOM}"/>')
        add(
            f'<text class="tick" x="{x:.1f}" y="{HEIGHT - _BOTTOM + 16}" text-anchor="middle">'
            f"{format_number(value)}</text>"
        )
    if positive:
        for value in y_axis.ticks():
            y = y_axis.at(value)
            add(f'<line class="grid" x1="{_LEFT}" y1="{y:.1f}" x2="{WIDTH - _RIGHT}" y2="{y:.1f}"/>')
            add(
                f'<text class="tick" x="{_LEFT - 7}" y="{y + 4:.1f}" text-anchor="end">'
                f"{format_number(value)}</text>"
            )
    if has_zero:
        add(
            f'<rect class="zero" x="{_LEFT}" y="{bottom}" width="{WIDTH - _LEFT - _RIGHT}" '
            f'height="{_ZERO_BAND}"/><text class="tick" x="{_LEFT - 7}" y="{zero_y + 4}" '
            f'text-anchor="end">none</text>'
        )
    add(
        f'<text class="axis" x="{(_LEFT + WIDTH - _RIGHT) / 2}" y="{HEIGHT - 12}" text-anchor="middle">'
        "CPU time of a frame, copies of a raw frame (log)</text>"
        f'<text class="axis" transform="translate(16 {(HEIGHT - _BOTTOM + _TOP) / 2}) rotate(-90)" '
        f'text-anchor="middle">{escape(measured)} (log)</text>'
    )

    taken: list[_Box] = []
    if limit:
        y = y_axis.at(limit)
        add(f'<line class="limit" x1="{_LEFT}" y1="{y:.1f}" x2="{WIDTH - _RIGHT}" y2="{y:.1f}"/>')
        add(
            f'<text class="limit-label" x="{WIDTH - _RIGHT - 4}" y="{y - 5:.1f}" text-anchor="end">'
            f"Cramér-Rao limit {format_number(limit)}</text>"
        )
        taken.append(_Box(WIDTH - _RIGHT - 160, y - 18, WIDTH - _RIGHT, y + 2))
    if floor:
        x = x_axis.at(floor)
        add(f'<line class="limit" x1="{x:.1f}" y1="{_TOP}" x2="{x:.1f}" y2="{HEIGHT - _BOTTOM}"/>')
        add(
            f'<text class="limit-label" transform="translate({x - 5:.1f} {_TOP + 6}) rotate(-90)" '
            'text-anchor="end">every byte touched once</text>'
        )
        taken.append(_Box(x - 17, _TOP, x + 2, _TOP + 150))

    if front:
        steps = [f"M {x_axis.at(front[0].cost):.1f} {_TOP}"]
        steps += [f"H {x_axis.at(point.cost):.1f} V {y_of(point.error):.1f}" for point in front]
        add(f'<path class="front" d="{" ".join(steps)} H {WIDTH - _RIGHT}"/>')

    places = {p.method: (x_axis.at(p.cost), y_of(p.error)) for p in candidates}
    taken += [_Box(x - 6, y - 6, x + 6, y + 6) for x, y in places.values()]
    on_front = {p.method for p in front}
    for point in sorted(candidates, key=lambda p: p.method in on_front):
        x, y = places[point.method]
        kind = "on" if point.method in on_front else "off"
        tip = (
            f"{point.method}: {format_number(point.cost)} copies, error {format_number(point.error)} "
            f"{quantity.unit} (median of {point.scenes} scenes; best {format_number(point.low)}, "
            f"worst {format_number(point.high)} on {point.worst})"
            + (f"; nothing to show in {point.missing} scenes" if point.missing else "")
        )
        add(f"<g><title>{escape(tip)}</title>")
        if point.scenes > 1:
            y0, y1 = y_of(point.high), y_of(point.low)
            add(f'<line class="whisker {kind}" x1="{x:.1f}" y1="{y0:.1f}" x2="{x:.1f}" y2="{y1:.1f}"/>')
        kind += " partial" if point.missing else ""
        add(f'<circle class="dot {kind}" cx="{x:.1f}" cy="{y:.1f}" r="5"/></g>')
    for point in sorted(candidates, key=lambda p: p.method not in on_front):
        x, y = places[point.method]
        kind = "on" if point.method in on_front else "off"
        box, anchor, leader = _place_label(point.method, x, y, taken)
        taken.append(box)
        if leader:
            end = box.x0 if box.x0 > x else box.x1 if box.x1 < x else (box.x0 + box.x1) / 2
            add(
                f'<line class="leader" x1="{x:.1f}" y1="{y:.1f}" x2="{end:.1f}" '
                f'y2="{(box.y0 + box.y1) / 2:.1f}"/>'
            )
        text_x = {"start": box.x0, "end": box.x1, "middle": (box.x0 + box.x1) / 2}[anchor]
        add(
            f'<text class="name {kind}" x="{text_x:.1f}" y="{box.y1 - 4:.1f}" '
            f'text-anchor="{anchor}">{escape(point.method)}</text>'
        )
    add("</svg>")
    return "".join(out)


def _place_label(text: str, x: float, y: float, taken: Sequence[_Box]) -> tuple[_Box, str, bool]:
    """The free place for a label that is nearest to its point, or the least crowded one."""
    width, height = 7.0 * len(text) + 4, 16.0
    best: tuple[float, _Box, str, bool] | None = None
    for distance in (9.0, 20.0, 34.0, 50.0, 68.0):
        for dx, dy, anchor in (
            (1, 0, "start"),
            (-1, 0, "end"),
            (0, -1, "middle"),
            (0, 1, "middle"),
            (1, -1, "start"),
            (1, 1, "start"),
            (-1, -1, "end"),
            (-1, 1, "end"),
        ):
            cx, cy = x + dx * distance, y + dy * (distance + 2)
            left = {"start": cx, "end": cx - width, "middle": cx - width / 2}[anchor]
            box = _Box(left, cy - height / 2, left + width, cy + height / 2)
            outside = (
                max(0.0, _LEFT - box.x0)
                + max(0.0, box.x1 - (WIDTH - 2))
                + max(0.0, 2 - box.y0)
                + max(0.0, box.y1 - (HEIGHT - _BOTTOM))
            )
            crowd = sum(box.overlap(other) for other in taken) + 100 * outside
            score = crowd + 0.3 * distance
            if best is None or score < best[0]:
                best = (score, box, anchor, distance > 20)
        if best is not None and best[0] < 0.3 * distance + 1:
            break
    assert best is not None
    return best[1], best[2], best[3]


def limit_of(result: Result, group: str, quantity: Quantity) -> float | None:
    """Median over the scenes of the smallest error that physics allows, or None where it is not known."""
    limits = [m.limits[quantity.key] for m in result.of(group) if quantity.key in m.limits]
    return median(limits) if limits else None


def _verdict(point: Point, everyone: Sequence[Point], front: Sequence[Point], quantity: Quantity) -> str:
    if len(everyone) == 1:
        return "the only method"
    if point.missing:
        return f"fails: nothing to show in {point.missing} of {point.missing + point.scenes} scenes"
    if quantity.best == 1 and point.error > 0.95:
        return "fails in most scenes"
    whole = [p for p in everyone if not p.missing]
    most_accurate = min(whole, key=lambda p: (p.error, p.cost))
    fastest = min(whole, key=lambda p: (p.cost, p.error))
    if point is most_accurate and point is fastest:
        return "use this: the fastest and the most accurate"
    if point is most_accurate:
        return f"the most accurate; {_times(point.cost / fastest.cost)} the time of the fastest"
    if point is fastest:
        return f"the fastest; {_factor(point.error, most_accurate.error)} the error of the best"
    if point in front:
        return "a compromise on the Pareto front"
    beaten = [p for p in front if p.cost <= point.cost and p.error <= point.error]
    return f"no reason to use it here: {beaten[0].method} is faster and at least as accurate"


def _times(ratio: float) -> str:
    return f"{format_number(ratio)} times"


def _factor(error: float, best: float) -> str:
    return f"{format_number(error / best)} times" if best > 0 else f"{format_number(error)} more than"


def _table(header: Sequence[str], rows: Iterable[Sequence[str]], numeric_from: int = 1) -> str:
    """An HTML table; cells are HTML already."""
    head = "".join(f"<th{_align(i, numeric_from)}>{cell}</th>" for i, cell in enumerate(header))
    body = "".join(
        "<tr>" + "".join(f"<td{_align(i, numeric_from)}>{cell}</td>" for i, cell in enumerate(row)) + "</tr>"
        for row in rows
    )
    return f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def _align(column: int, numeric_from: int) -> str:
    return ' class="n"' if column >= numeric_from else ""


def _answers(result: Result) -> str:
    parts = []
    for group in result.groups():
        for name in PRIMARY.get(group, ()):
            quantity = QUANTITIES[name]
            candidates = points(result, group, quantity)
            if not candidates:
                continue
            front = pareto(candidates)
            others = [QUANTITIES[q] for q in PRIMARY[group] if q != name]
            rows = []
            for point in sorted(candidates, key=lambda p: p.cost):
                mark = "●" if point in front else "○"
                row = [
                    f'<span class="{"on" if point in front else "off"}">{mark}</span> '
                    f"<b>{escape(point.method)}</b>",
                    escape(_verdict(point, candidates, front, quantity)),
                    format_number(point.cost),
                    f"{point.cost * result.copy_ms:.2f}",
                    _value_with_worst(result, group, point.method, quantity),
                ]
                row += [_value_with_worst(result, group, point.method, other) for other in others]
                rows.append(row)
            header = ["method", "", "copies", "ms"]
            header += [_heading(q, limit_of(result, group, q)) for q in (quantity, *others)]
            heading = escape(TITLES.get(group, group))
            parts.append(f"<h3>{heading}</h3>" + _table(header, rows, numeric_from=2))
            break
    return "".join(parts)


def _heading(quantity: Quantity, limit: float | None = None) -> str:
    unit = f" ({quantity.unit})" if quantity.unit else ""
    bound = f' <span class="limit">limit {format_number(limit)}</span>' if limit else ""
    return escape(quantity.title + unit) + bound


def _value_with_worst(result: Result, group: str, method: str, quantity: Quantity) -> str:
    rows = [m for m in result.of(group, method) if quantity.key in m.errors]
    if not rows:
        return "-"
    values = [m.errors[quantity.key] for m in rows]
    worst = max(rows, key=lambda m: quantity.distance(m.errors[quantity.key]))
    text = format_number(median(values))
    if len(rows) > 1:
        value = format_number(worst.errors[quantity.key])
        text += f' <small title="worst scene">({value} {escape(worst.scene)})</small>'
    return text


def _targets(result: Result) -> str:
    words = {True: ("met", "met"), False: ("missed", "missed"), None: ("unknown", "not measured")}
    rows = [
        [
            escape(t.quantity),
            escape(t.target),
            f"<b>{escape(t.result)}</b>",
            f'<span class="{words[t.met][0]}">{words[t.met][1]}</span>',
            f"<small>{escape(t.on)}</small>",
        ]
        for t in result.targets
    ]
    return _table(["quantity", "target", "result", "", "measured on"], rows, numeric_from=99)


def _plots(result: Result) -> str:
    parts = []
    for group in result.groups():
        figures = []
        for name in dict.fromkeys((*PRIMARY.get(group, ()), *QUANTITIES)):
            quantity = QUANTITIES[name]
            candidates = points(result, group, quantity)
            if len(candidates) < 2 or (
                name not in PRIMARY.get(group, ()) and not any(p.high for p in candidates)
            ):
                continue
            limit = limit_of(result, group, quantity)
            floor = result.touch_ms / result.copy_ms if group == "pipeline" else None
            figures.append(
                f"<figure><figcaption>{escape(quantity.title)}</figcaption>"
                f"{scatter(candidates, quantity, limit, floor)}</figure>"
            )
        if figures:
            parts.append(f"<h3>{escape(TITLES.get(group, group))}</h3>")
            parts.append(f'<div class="figures">{"".join(figures)}</div>')
    return "".join(parts)


def _everything(result: Result) -> str:
    parts = []
    for group in result.groups():
        rows_of = result.of(group)
        names = [q for q in QUANTITIES if any(q in m.errors for m in rows_of)]
        kinds = [k for k in ("contact", "idle", "all") if any(k in m.copies for m in rows_of)]
        header = ["method", "scene", "frames"]
        for kind in kinds:
            header += [f"{kind}: copies", "ms p50", "ms p99", "× classic"]
        peak = any(m.peak_mb for m in rows_of)
        header += ["peak MB"] * peak + [_heading(QUANTITIES[q]) for q in names]
        rows = []
        for m in rows_of:
            row = [f"<b>{escape(m.method)}</b>", escape(m.scene), str(m.frames)]
            for kind in kinds:
                time = m.time.get(kind, {})
                row += [
                    _maybe(m.copies.get(kind)),
                    _maybe(time.get("cpu_ms_p50")),
                    _maybe(time.get("cpu_ms_p99")),
                    _maybe(m.faster.get(kind)),
                ]
            row += [_maybe(m.peak_mb)] * peak + [_maybe(m.errors.get(q)) for q in names]
            if m.failure:
                row[1] += f'<br><small class="missed">{escape(m.failure)}</small>'
            rows.append(row)
        parts.append(
            f"<details><summary>{escape(TITLES.get(group, group))}: {len(rows)} measurements</summary>"
            + _table(header, rows, numeric_from=2)
            + "</details>"
        )
    return "".join(parts)


def _where_time_goes(result: Result) -> str:
    """Per pipeline, how much of a frame's time each stage takes."""
    parts = []
    for method in result.methods("pipeline"):
        rows = [m for m in result.of("pipeline", method) if m.stages_ms and "contact" in m.time]
        rows = [m for m in rows if not m.scene.startswith(RECORDING)]
        if not rows:
            continue
        names = list(dict.fromkeys(name for m in rows for name in m.stages_ms))
        times = {n: median(m.stages_ms[n] for m in rows if n in m.stages_ms) for n in names}
        longest = max(times.values())
        body = [
            [
                escape(name),
                f'<span class="bar" style="width:{max(1.0, 220 * value / longest):.0f}px"></span>',
                f"{value:.3f}",
                format_number(value / result.copy_ms),
            ]
            for name, value in times.items()
        ]
        peak = next((m.peak_mb for m in rows if m.peak_mb), None)
        memory = f", peak memory {peak:.0f} MB" if peak else ""
        parts.append(
            f"<div><h3>{escape(method)}<small>{memory}</small></h3>"
            + _table(["stage", "", "ms", "copies"], body, numeric_from=2)
            + "</div>"
        )
    return f'<div class="figures">{"".join(parts)}</div>' if parts else ""


def _maybe(value: float | None, show: Callable[[float], str] = format_number) -> str:
    return "" if value is None else show(value)


_STYLE = """
:root { color-scheme: light dark; --ink:#1b1f24; --soft:#5b6670; --line:#d7dce1; --paper:#fff;
  --panel:#f6f8fa; --on:#0a6bd6; --off:#8a949e; --limit:#b4540a; --good:#1a7f37; --bad:#c62a2a; }
@media (prefers-color-scheme: dark) { :root { --ink:#e6eaee; --soft:#9aa5b0; --line:#343b43; --paper:#14181c;
  --panel:#1c2127; --on:#5aa9ff; --off:#7d8791; --limit:#f0a050; --good:#4cc26b; --bad:#ff7b72; } }
* { box-sizing: border-box }
body { margin:0 auto; max-width:1320px; padding:28px 24px 60px; background:var(--paper); color:var(--ink);
  font:15px/1.5 system-ui, "Segoe UI", "DejaVu Sans", sans-serif }
h1 { font-size:26px; margin:0 0 4px } h2 { font-size:20px; margin:40px 0 8px; padding-top:14px;
  border-top:1px solid var(--line) } h3 { font-size:16px; margin:24px 0 8px }
p { max-width:860px; margin:6px 0 } small, .soft { color:var(--soft) }
.scroll { overflow-x:auto } table { border-collapse:collapse; font-size:13.5px }
th, td { padding:4px 12px 4px 0; text-align:left; vertical-align:baseline;
  border-bottom:1px solid var(--line) }
th { color:var(--soft); font-weight:600; max-width:170px; vertical-align:bottom }
td { font-variant-numeric:tabular-nums } td:first-child { white-space:nowrap }
.n { text-align:right; padding-left:12px }
.on { color:var(--on) } .off { color:var(--off) } .met { color:var(--good); font-weight:600 }
.missed { color:var(--bad); font-weight:600 } .unknown { color:var(--soft) }
.figures { display:grid; grid-template-columns:repeat(auto-fill, minmax(min(560px,100%),1fr)); gap:18px }
figure { margin:0; background:var(--panel); border:1px solid var(--line); border-radius:8px;
  padding:10px 12px }
figcaption { font-weight:600; margin-bottom:4px } svg { width:100%; height:auto; display:block }
svg text { font:12px system-ui, "Segoe UI", "DejaVu Sans", sans-serif; fill:var(--ink) }
svg .tick, svg .axis { fill:var(--soft) } svg .grid { stroke:var(--line); stroke-width:1 }
svg .zero { fill:var(--good); opacity:.09 }
svg .front { fill:none; stroke:var(--on); stroke-width:1.6; opacity:.75 }
svg .dot.on { fill:var(--on) } svg .dot.off { fill:var(--off) }
svg .dot { stroke:var(--panel); stroke-width:1.5 }
svg .dot.partial { fill:var(--panel); stroke:var(--bad) }
svg .whisker { stroke-width:1.5; opacity:.45 } svg .whisker.on { stroke:var(--on) }
svg .whisker.off { stroke:var(--off) } svg .leader { stroke:var(--soft); stroke-width:.8 }
th .limit { display:block; color:var(--limit); font-weight:400 }
.bar { display:inline-block; height:10px; border-radius:2px; background:var(--on) }
svg .limit { stroke:var(--limit); stroke-width:1.4; stroke-dasharray:6 4 }
svg .limit-label { fill:var(--limit) } svg .name { paint-order:stroke; stroke:var(--panel); stroke-width:3px }
svg .name.on { font-weight:600 } svg .name.off { fill:var(--soft) }
details { margin:10px 0 } summary { cursor:pointer; font-weight:600 }
"""


def html(result: Result) -> str:
    """The whole report as one HTML page without scripts and without anything from a network."""
    machine = " · ".join(escape(f"{key} {value}") for key, value in result.machine.items())
    kind = "quick run" if result.quick else "full run"
    sections = [
        "<h1>Which method should I use, and what does it cost me?</h1>",
        "<p>Every method was given the same frames, taking turns, in one thread, and its answers were "
        "compared with the known truth. Time is the process's own CPU time for one frame with contact, in "
        f"<b>copies</b>: one copy of a raw 800 × 600 × 3 frame took {result.copy_ms:.3f} ms in this run.</p>",
        f'<p class="soft">{kind} · {result.wall_s:.0f} s · {machine}</p>',
        "<h2>The answer, stage by stage</h2>",
        '<p><span class="on">●</span> is on the Pareto front: nothing else is both faster and more accurate. '
        '<span class="off">○</span> is beaten. Errors are the median over the scenes; in brackets the worst '
        "scene.</p>",
        _answers(result),
    ]
    times = _where_time_goes(result)
    if times:
        sections += [
            "<h2>Where the time of a frame goes</h2>",
            "<p>Median wall time of one call, over the scenes. What is skipped costs nothing.</p>",
            times,
        ]
    if result.targets:
        sections += ["<h2>Promises and results</h2>", _targets(result)]
    sections += [
        "<h2>Run time against error</h2>",
        "<p>Down and left is better. A dot is a method at its median over the scenes, its whisker reaches "
        'from the best scene to the worst; the <span class="on">blue line</span> is the Pareto front, the '
        '<span style="color:var(--limit)">dashed lines</span> are limits: the Cramér-Rao bound on a '
        "position, and the time to read and write every byte of a raw frame once. Point at a dot for its "
        "numbers. A hollow dot has nothing to show in some scenes.</p>",
        _plots(result),
        "<h2>Everything that was measured</h2>",
        _everything(result),
    ]
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>tactflow bench</title><style>{_STYLE}</style></head>"
        f"<body>{''.join(sections)}</body></html>\n"
    )
