"""The report: one HTML file that needs nothing else, with plots drawn here as SVG.

It is written to answer one question, "which method should I use, and what does it cost me?": first the
answer per stage, then what was promised and what came of it, then run time against error for each quantity,
then everything that was measured.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from statistics import median

from tactflow.bench.pareto import Point, limit_of, points
from tactflow.bench.quantities import QUANTITIES, Quantity, format_number
from tactflow.bench.results import RECORDING, Result
from tactflow.bench.scatter import scatter

TITLES = {
    "pipeline": "Whole pipelines",
    "preprocess": "Preprocessing",
    "marker_mask": "Marker mask",
    "inpaint": "Marker removal",
    "difference": "Contact or not, and where",
    "hull": "Contact geometry",
    "tracker": "Marker tracking",
    "flow_in_mask": "Flow inside the contact",
    "depth": "Heights in mm, by light",
    "motion": "Motion of the gel between the dots, and slip",
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
    "depth": ("depth_rms", "volume_error"),
    "motion": ("field_rms",),
}
"""Group -> quantities that are plotted; methods without the first one are left out of the answer."""


def _errors(result: Result, group: str) -> dict[str, dict[str, float]]:
    """Title of each quantity of a group -> method -> its error, infinite where scenes are missing."""
    found = {}
    for quantity in (QUANTITIES[name] for name in PRIMARY.get(group, ())):
        known = {p.method: math.inf if p.missing else p.error for p in points(result, group, quantity)}
        if known:
            found[quantity.title] = {name: known.get(name, math.inf) for name in result.methods(group)}
    return found


def _beats(one: Point, other: Point, errors: Mapping[str, Mapping[str, float]]) -> bool:
    """Whether a method is at least as fast and in every quantity at least as accurate, and not the same."""
    pairs = [(by[one.method], by[other.method]) for by in errors.values()]
    pairs.append((one.cost, other.cost))
    return all(a <= b for a, b in pairs) and any(a < b for a, b in pairs)


def _front(everyone: Sequence[Point], errors: Mapping[str, Mapping[str, float]]) -> list[Point]:
    """The methods that no other beats; see `_beats`."""
    whole = [p for p in everyone if not p.missing]
    return [p for p in whole if not any(_beats(other, p, errors) for other in whole)]


def _verdict(
    point: Point, front: Sequence[Point], errors: Mapping[str, Mapping[str, float]], quantity: Quantity
) -> str:
    """One of several methods in a few words; front, errors : as `_front` and `_errors` give them."""
    if point.missing:
        return f"fails: nothing to show in {point.missing} of {point.missing + point.scenes} scenes"
    if quantity.best == 1 and point.error > 0.95:
        return "fails in most scenes"
    if point not in front:
        better = next(p for p in front if _beats(p, point, errors))
        return f"no reason to use it here: {better.method} is faster and at least as accurate"
    least = min(p.cost for p in front)
    fastest = point.cost == least
    title, error, best = _weakness(point, front, errors)
    if error == best:
        if fastest:
            return "use this: the fastest and the most accurate"
        return f"the most accurate; {_times(point.cost / least)} the time of the fastest"
    said = "the fastest" if fastest else "a compromise on the Pareto front"
    if math.isinf(error):
        return f"{said}; nothing to show in some scenes: {title}"
    return f"{said}; {_factor(error, best)} the error of the best: {title}" if fastest else said


def _weakness(
    point: Point, front: Sequence[Point], errors: Mapping[str, Mapping[str, float]]
) -> tuple[str, float, float]:
    """The quantity in which a method is farthest from the best one, relative to that; its error; the best."""
    found = []
    for title, by in errors.items():
        error, best = by[point.method], min(by[p.method] for p in front)
        ratio = 1.0 if error == best else math.inf if best == 0 else error / best
        found.append((ratio, title, error, best))
    # Nothing to show at all is worse than any error where the best has none.
    return max(found, key=lambda one: (one[0], one[2]))[1:]


def _times(ratio: float) -> str:
    text = format_number(ratio)
    return "about" if text == "1" else f"{text} times"


def _factor(error: float, best: float) -> str:
    return _times(error / best) if best > 0 else f"{format_number(error)} more than"


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


def _answer(result: Result, group: str) -> str:
    """The methods of a group, fastest first; empty without any error that says which is better."""
    quantities = [QUANTITIES[name] for name in PRIMARY.get(group, ())]
    quantity = next((q for q in quantities if points(result, group, q)), None)
    if quantity is None:
        return ""
    candidates = points(result, group, quantity)
    errors = _errors(result, group)
    front = _front(candidates, errors)
    columns = [quantity, *(q for q in quantities if q != quantity)]
    rows = []
    for point in sorted(candidates, key=lambda p: p.cost):
        kind, mark = ("on", "●") if point in front else ("off", "○")
        alone = len(candidates) == 1
        row = [
            f'<span class="{kind}">{mark}</span> <b>{escape(point.method)}</b>',
            escape("the only method" if alone else _verdict(point, front, errors, quantity)),
            format_number(point.cost),
            f"{point.cost * result.copy_ms:.2f}",
        ]
        rows.append(row + [_value_with_worst(result, group, point.method, column) for column in columns])
    header = ["method", "", "copies", "ms"] + [_heading(q, limit_of(result, group, q)) for q in columns]
    return f"<h3>{escape(TITLES.get(group, group))}</h3>" + _table(header, rows, numeric_from=2)


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


def _maybe(value: float | None) -> str:
    return "" if value is None else format_number(value)


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
        '<p><span class="on">●</span> is on the Pareto front: nothing else is faster and, in every column, '
        'as accurate. <span class="off">○</span> is beaten. Errors are the median over the scenes; in '
        "brackets the worst scene.</p>",
        *(_answer(result, group) for group in result.groups()),
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
