"""The result as sections of text and tables: for the terminal, for a page in Markdown, and for the report."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from statistics import median

from rich.console import Console
from rich.table import Table as RichTable

from tactflow.bench.gels import GELS
from tactflow.bench.pipelines import CLASSIC, PIPELINE
from tactflow.bench.quantities import QUANTITIES, format_number
from tactflow.bench.results import RECORDING, TIMES, BenchResult, Measurement
from tactflow.report import Section, Table

BEGIN = "<!-- tables of tactflow bench: written by --markdown -->"
END = "<!-- end of tables -->"

TITLES = {
    PIPELINE: "Whole pipelines",
    "marker_mask": "Marker mask",
    "inpaint": "Marker removal",
    "difference": "Contact or not, and where",
    "hull": "Contact geometry",
    "tracker": "Marker tracking",
    "flow_in_mask": "Flow inside the contact",
    "depth": "Heights in mm, by light",
}
"""Group -> heading."""

PRIMARY = {
    PIPELINE: ("displacement_rms", "center_error", "angle_mean", "hull_iou", "flow_error"),
    "marker_mask": ("marker_recall", "localisation_rms"),
    "inpaint": ("inpaint_mae",),
    "difference": ("contact_iou", "center_error", "false_contacts", "missed_contacts"),
    "hull": ("angle_mean", "center_error"),
    "tracker": ("displacement_rms", "displacement_p99", "wrong_percent"),
    "flow_in_mask": ("flow_error",),
    "depth": ("depth_rms", "volume_error", "depth_within_one", "depth_within_two"),
}
"""Group -> quantities that are shown of it."""

SCENE_COLUMNS = {
    "dots not found, false": ("markers_missed", "markers_false"),
    "marker RMS, px": ("displacement_rms",),
    "wrong, lost dots, %": ("wrong_percent", "lost_percent"),
    "contacts: false, missed, missed at half depth, %": (
        "false_contacts",
        "missed_contacts",
        "missed_half_depth",
    ),
    "hull IoU": ("hull_iou",),
    "centre, px": ("center_error",),
    "direction, deg": ("angle_mean",),
    "mean flow, px": ("flow_error",),
}
"""Heading -> quantities, for the table of scenes; a dash where one was not measured."""

GEL_COLUMNS = {
    "dots found, beyond, %": ("dots_found", "dots_beyond"),
    "contact at rest, %": ("false_contacts",),
    "missed, %": ("missed_contacts",),
    "outline IoU, median, worst": ("outline_iou_p50", "outline_iou_min"),
    "centre, px": ("label_distance_p50",),
    "direction, median, worst, deg": ("line_angle_p50", "line_angle_max"),
}
"""The same for recordings of gels."""


def sections(result: BenchResult) -> list[Section]:
    """Everything that was measured, from the summary to single scenes and recordings."""
    machine = ", ".join(f"{key} {value}" for key, value in result.machine.items())
    kind = "quick" if result.quick else "full"
    summary = (
        f"A {kind} run of {result.wall_s:.0f} s on {machine}. Times are CPU times of a frame in one thread, "
        f"medians; one copy of a raw frame of 800 x 600 px took {result.copy_ms:.3f} ms."
    )
    groups = dict.fromkeys(m.group for m in result.measured)
    found = [Section("Machine", summary), *(methods(result, group) for group in groups)]
    found += [_scenes(result), *_recordings(result), *_gels(result)]
    if result.failures:
        rows = [[key, why.partition("\n")[0]] for key, why in result.failures.items()]
        found.append(Section("Failures", tables=[Table(["group/method/scene", "why"], rows)]))
    return found


def methods(result: BenchResult, group: str) -> Section:
    """One row per method of a group: median over the simulated scenes, in brackets the worst one."""
    simulated = [m for m in result.measurements(group) if not m.scene.startswith(RECORDING)]
    quantities = [QUANTITIES[key] for key in PRIMARY.get(group, ())]
    heads = ["method", "contact, ms", "copies", "idle, ms", "copies", *(q.heading for q in quantities)]
    rows = []
    for method in dict.fromkeys(m.method for m in simulated):
        own = [m for m in simulated if m.method == method]
        row = [method]
        for key in TIMES.values():
            times = [m.values[key] for m in own if key in m.values]
            row += [format_number(median(times) / unit) if times else "-" for unit in (1.0, result.copy_ms)]
        for quantity in quantities:
            values = [m.values[quantity.key] for m in own if quantity.key in m.values]
            worst = max(values, key=quantity.distance, default=0.0)
            row.append(f"{format_number(median(values))} ({format_number(worst)})" if values else "-")
        rows.append(row)
    text = "Median over the simulated scenes, in brackets the worst one."
    return Section(TITLES.get(group, group), text, tables=[Table(heads, rows)])


def _scenes(result: BenchResult) -> Section:
    rows = [
        [m.scene, m.method, _time(m), *_cells(m, SCENE_COLUMNS.values())]
        for m in result.measurements(PIPELINE)
        if not m.scene.startswith(RECORDING)
    ]
    table = Table(["scene", "pipeline", "ms", *SCENE_COLUMNS], rows)
    text = f"Time of a frame with contact, and mean errors. `{CLASSIC}` is the original script."
    return Section("Whole pipelines, scene by scene", text, tables=[table])


def _recordings(result: BenchResult) -> Iterator[Section]:
    """One row for each recording of the Wedge and each pipeline."""
    gels = {RECORDING + gel.folder for gel in GELS}
    rows = []
    for m in result.measured:
        if m.scene.startswith(RECORDING) and m.scene not in gels:
            errors = (f"{QUANTITIES[key].heading}: {format_number(v)}" for key, v in m.errors.items())
            rows.append([m.scene.removeprefix(RECORDING), m.method, _time(m), "; ".join(errors)])
    if rows:
        yield Section("Real recordings", tables=[Table(["recording", "pipeline", "ms", "errors"], rows)])


def _gels(result: BenchResult) -> Iterator[Section]:
    """One row for each recording of a gel, with the half of the sensors that it belongs to."""
    by_scene: dict[str, list[Measurement]] = {}
    for m in result.measurements(PIPELINE):
        by_scene.setdefault(m.scene.removeprefix(RECORDING), []).append(m)
    rows = []
    for gel in GELS:
        if gel.folder not in by_scene:
            continue
        m, *refused = by_scene[gel.folder]
        dots = "?" if gel.dots is None else str(gel.dots)
        if refused:
            false_markers = refused[0].values["markers_false"]
            dots += ", refused" if not false_markers else f", took {false_markers:g} for dots"
        half = "chosen on" if gel.chosen else "test"
        frames = f"{m.values['frames']:g}"
        rows.append([gel.folder, gel.sensor, half, frames, dots, *_cells(m, GEL_COLUMNS.values())])
    if rows:
        text = (
            "With the settings as they are shipped, but for `rotate: 0` and a `downsample` of 1 or 2. "
            "Constants were chosen on one half of the sensors; the other half is the test. Refused: the "
            "pipeline for gels with dots reports that there are none."
        )
        heads = ["recording", "sensor", "half", "frames", "dots by eye", *GEL_COLUMNS]
        yield Section("Real gels of many labs", text, tables=[Table(heads, rows)])


def _time(measurement: Measurement) -> str:
    return "-" if measurement.time_ms is None else format_number(measurement.time_ms)


def _cells(measurement: Measurement, columns: Iterable[Sequence[str]]) -> list[str]:
    values = measurement.values
    return [", ".join(format_number(values[k]) if k in values else "-" for k in keys) for keys in columns]


def print_sections(found: Sequence[Section], console: Console) -> None:
    """Print text and tables; long cells are folded, nothing is cut."""
    for section in found:
        console.print(f"\n[bold]{section.title}[/bold]", highlight=False)
        if section.text:
            console.print(section.text, markup=False, highlight=False)
        for table in section.tables:
            drawn = RichTable()
            for column in table.columns:
                drawn.add_column(column, overflow="fold")
            for row in table.rows:
                drawn.add_row(*map(str, row))
            console.print(drawn, markup=False)


def markdown(found: Sequence[Section]) -> str:
    """Text and tables in Markdown."""
    parts = []
    for section in found:
        parts += [f"### {section.title}", *([section.text] if section.text else [])]
        for table in section.tables:
            lines = [table.columns, ["---"] * len(table.columns), *table.rows]
            cells = ([str(cell).replace("|", "\\|").replace("\n", " ") for cell in line] for line in lines)
            parts.append("\n".join(f"| {' | '.join(line)} |" for line in cells))
    return "\n\n".join(parts) + "\n"


def write_markdown(found: Sequence[Section], path: Path) -> None:
    """Write the tables to a file; where it has the lines `BEGIN` and `END`, only between these."""
    text = path.read_text(encoding="utf-8") if path.exists() else ""
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not (begin and end):
        before, after = "", "\n"
    path.write_text(f"{before}{BEGIN}\n\n{markdown(found)}\n{END}{after}", encoding="utf-8")
