"""The result as Markdown tables, to be kept in a page of the documentation."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from statistics import median

from tactflow.bench.gels import GELS, OUTLINES
from tactflow.bench.methods import CLASSIC
from tactflow.bench.pareto import limit_of
from tactflow.bench.pipelines import ORIGINAL
from tactflow.bench.quantities import QUANTITIES, format_number
from tactflow.bench.report import PRIMARY, TITLES
from tactflow.bench.results import RECORDING, Measurement, Result
from tactflow.bench.scenes import TROUBLES
from tactflow.sim import scene_descriptions

BEGIN = "<!-- tables of tactflow bench: written by --markdown -->"
END = "<!-- end of tables -->"

_PER_SCENE = (
    ("marker RMS, px", ("displacement_rms",)),
    ("wrong or lost, %", ("wrong_percent", "lost_percent")),
    ("contact missed, %", ("missed_contacts",)),
    ("hull IoU", ("hull_iou",)),
    ("centre, px", ("center_error",)),
    ("direction, deg", ("angle_mean",)),
    ("mean flow, px", ("flow_error",)),
)

_TROUBLE = (
    ("markers not found", "markers_missed"),
    ("false markers", "markers_false"),
    ("wrong identity, %", "wrong_percent"),
    ("false contacts, %", "false_contacts"),
    ("contact missed, %", "missed_contacts"),
    ("missed at half depth, %", "missed_half_depth"),
    ("hull IoU", "hull_iou"),
    ("centre, px", "center_error"),
)
"""Title and quantity of the columns for the scenes of `TROUBLES`."""

_GEL: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("dots found (beyond), %", ("dots_found", "dots_beyond")),
    ("contact at rest, %", ("false_contacts",)),
    ("missed, %", ("missed_contacts",)),
    ("early ones in time, %", ("early_found",)),
    ("outline IoU, median (worst)", ("outline_iou_p50", "outline_iou_min")),
    ("centre, px", ("label_distance_p50",)),
    ("direction (worst), deg", ("line_angle_p50", "line_angle_max")),
)
"""The same for the recordings of gels; a second quantity goes into brackets."""


def write_markdown(result: Result, path: Path, default: str) -> None:
    """Write the tables to a file; where the file has a place for them, only that place is replaced."""
    tables = f"{BEGIN}\n\n{markdown(result, default)}\n{END}"
    if path.exists():
        text = path.read_text(encoding="utf-8")
        before, begin, rest = text.partition(BEGIN)
        _, end, after = rest.partition(END)
        if begin and end:
            path.write_text(before + tables + after, encoding="utf-8")
            return
    path.write_text(tables + "\n", encoding="utf-8")


def markdown(result: Result, default: str) -> str:
    """Promises, whole pipelines per scene, and the methods of each stage.

    Parameters
    ----------
    default : name of the pipeline that is put beside the yardstick.
    """
    machine = ", ".join(f"{key} {value}" for key, value in result.machine.items())
    kind = "quick" if result.quick else "full"
    parts = [
        f"Measured by a {kind} run of {result.wall_s:.0f} s on {machine}. One copy of a raw frame took "
        f"{result.copy_ms:.3f} ms, between memory that is there; to read and write every byte of it once, "
        f"{format_number(result.touch_ms / result.copy_ms)} copies. A page of fresh memory costs "
        f"{format_number(result.fault_us)} µs.",
        "### Promises and results",
        _targets(result),
        "### Whole pipelines, scene by scene",
        f"Each cell: `{CLASSIC}`, then `{default}`. Times are CPU times of a frame with contact, ms; the "
        f"script is `{CLASSIC}` plus what the script computes twice. A dash: nothing to measure.",
        _scenes(result, default),
        *_troubles(result),
        "### Methods alone, on the same inputs",
        "Median over the scenes, in brackets the worst scene. Times are copies of a raw frame.",
        *_methods(result),
    ]
    parts += _recordings(result) + _gels(result)
    return "\n\n".join(parts) + "\n"


def _table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)


def _targets(result: Result) -> str:
    words = {True: "met", False: "**missed**", None: "not measured"}
    rows = [
        [t.quantity, _signs(t.target), t.result, words[t.met], t.on.replace("\n", " ")]
        for t in result.targets
    ]
    return _table(["quantity", "target", "result", "", "measured on"], rows)


def _signs(text: str) -> str:
    return text.replace("<=", "≤").replace(">=", "≥")


def _value(measurement: Measurement | None, keys: Sequence[str]) -> str:
    if measurement is None or any(key not in measurement.errors for key in keys):
        return "-"
    return format_number(sum(measurement.errors[key] for key in keys))


def _scenes(result: Result, default: str) -> str:
    by_key = {m.key: m for m in result.of("pipeline")}
    apart = {case.label for case in TROUBLES}
    scenes = dict.fromkeys(
        m.scene for m in result.of("pipeline") if not m.scene.startswith(RECORDING) and m.scene not in apart
    )
    rows = []
    for scene in scenes:
        others = (CLASSIC, ORIGINAL)
        own = [m for m in result.of("pipeline") if m.scene == scene and m.method not in others]
        mine = by_key.get(f"pipeline/{default}/{scene}", own[0] if own else None)
        classic, script = (by_key.get(f"pipeline/{name}/{scene}") for name in others)
        times = []
        for measurement in (script, classic, mine):
            time = measurement.time if measurement else {}
            chosen = time.get("contact", time.get("idle"))
            times.append(format_number(chosen["cpu_ms_p50"]) if chosen else "-")
        cells = [f"{_value(classic, keys)}, {_value(mine, keys)}" for _, keys in _PER_SCENE]
        rows.append([scene, *times, *cells])
    header = [
        "scene",
        "script",
        f"`{CLASSIC}`",
        f"`{default}`",
        *(title for title, _ in _PER_SCENE),
    ]
    return _table(header, rows)


def _troubles(result: Result) -> list[str]:
    """One row for each scene of `TROUBLES`, with the pipeline that its gel is for."""
    others = (CLASSIC, ORIGINAL)
    names = {case.label: scene_descriptions()[case.name] for case in TROUBLES}
    rows = [
        [m.scene, names[m.scene], f"`{m.method}`", *(_value(m, [key]) for _, key in _TROUBLE)]
        for m in result.of("pipeline")
        if m.scene in names and m.method not in others
    ]
    if not rows:
        return []
    header = ["scene", "", "pipeline", *(title for title, _ in _TROUBLE)]
    return [
        "### Troubles of real gels, simulated",
        "What went wrong on recordings of many labs, one trouble in each scene, with its truth. The pipeline "
        "is the one for the gel: with markers or without.",
        _table(header, rows),
    ]


def _gels(result: Result) -> list[str]:
    """One row for each recording of a gel, with the half of the sensors that it belongs to."""
    found = {(m.scene, m.method): m for m in result.of("pipeline")}
    rows = []
    for gel in GELS:
        here = [m for (scene, _), m in found.items() if scene == RECORDING + gel.folder]
        if not here:
            continue
        m, refused = here[0], here[-1].errors.get("markers_false")
        dots = "uncounted" if gel.dots is None else str(gel.dots)
        if refused is not None:
            dots = "0, refused" if refused == 0 else f"0, took {refused:g} for dots"
        failure = f": {m.failure.splitlines()[0]}" if m.failure else ""
        half = "chosen on" if gel.chosen else "test"
        cells = [_bracketed(m, keys) for _, keys in _GEL]
        rows.append([gel.folder, gel.sensor + failure, half, str(m.frames), dots, *cells])
    if not rows:
        return []
    header = ["recording", "sensor", "half", "frames", "dots by eye", *(title for title, _ in _GEL)]
    together = next((m for m in result.of("pipeline") if m.scene == RECORDING + OUTLINES), None)
    said = ""
    if together is not None:
        overlap = _bracketed(together, _OUTLINES)
        said = f" All {together.frames} outlines by eye together: {overlap}, median (worst)."
    return [
        "### Real gels of many labs",
        "With the settings as they are shipped, but for `rotate: 0` and a `downsample` of 1 or 2: which "
        "stands in `tactflow.bench.gels`. Constants were chosen on one half of the sensors; the other half "
        "is the test. Refused: the pipeline for gels with dots says that there are none." + said,
        _table(header, rows),
    ]


_OUTLINES = ("outline_iou_p50", "outline_iou_min")


def _bracketed(measurement: Measurement, keys: Sequence[str]) -> str:
    """The first quantity, and the second one in brackets; a dash where there is none."""
    first, *second = (_value(measurement, [key]) for key in keys)
    return first + "".join(f" ({value})" for value in second if value != "-")


def _methods(result: Result) -> list[str]:
    parts = []
    for group in result.groups():
        quantities = [QUANTITIES[name] for name in PRIMARY.get(group, ())]
        if group == "pipeline" or not quantities:
            continue
        header = ["method", "contact", "idle"]
        for quantity in quantities:
            limit = limit_of(result, group, quantity)
            unit = f", {quantity.unit}" if quantity.unit else ""
            header.append(quantity.title + unit + (f" (limit {format_number(limit)})" if limit else ""))
        rows = []
        for method in result.methods(group):
            measured = result.of(group, method)
            cells = [f"`{method}`"]
            for kind in ("contact", "idle"):
                copies = [m.copies[kind] for m in measured if kind in m.copies]
                cells.append(format_number(median(copies)) if copies else "-")
            for quantity in quantities:
                values = [m.errors[quantity.key] for m in measured if quantity.key in m.errors]
                worst = max(values, key=quantity.distance, default=0.0)
                cells.append(f"{format_number(median(values))} ({format_number(worst)})" if values else "-")
            rows.append(cells)
        parts += [f"**{TITLES.get(group, group)}**", _table(header, rows)]
    return parts


def _recordings(result: Result) -> list[str]:
    """One row for each recording of the Wedge and each pipeline."""
    gels = {RECORDING + gel.folder for gel in GELS}
    rows = []
    for m in result.measurements:
        if not m.scene.startswith(RECORDING) or m.scene in gels or m.scene == RECORDING + OUTLINES:
            continue
        said = "; ".join(f"{QUANTITIES[key].title}: {format_number(v)}" for key, v in m.errors.items())
        time = m.time.get("contact", m.time.get("idle", {}))
        milliseconds = format_number(time["cpu_ms_p50"]) if time else "-"
        failure = (m.failure or "").splitlines()
        rows.append([m.scene.removeprefix(RECORDING), f"`{m.method}`", milliseconds, said or failure[0]])
    table = _table(["recording", "pipeline", "ms", "result"], rows)
    return ["### Real recordings", table] if rows else []
