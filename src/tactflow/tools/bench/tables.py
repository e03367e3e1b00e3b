"""The result as sections of text and tables, in Markdown."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from statistics import median

import numpy as np

from tactflow.system.terminal import markdown
from tactflow.tools.bench.depth import DEPTH
from tactflow.tools.bench.quantities import QUANTITIES
from tactflow.tools.bench.results import CLASSIC, LEFT_OUT, PIPELINE, TIMES, BenchResult, Measurement

TITLES = {
    PIPELINE: "Whole pipelines",
    DEPTH: "Depth, with a calibration",
    "marker_mask": "Marker mask",
    "inpaint": "Marker removal",
    "difference": "Contact or not, and where",
    "hull": "Contact geometry",
    "tracker": "Marker tracking",
    "flow_in_mask": "Flow inside the contact",
}
"""Group -> heading."""

PRIMARY = {
    PIPELINE: ("displacement_rms", "center_error", "angle_mean", "hull_iou", "flow_error"),
    DEPTH: ("depth_rms", "depth_greatest"),
    "marker_mask": ("marker_recall", "localisation_rms"),
    "inpaint": ("inpaint_mae",),
    "difference": ("contact_iou", "center_error", "false_contacts", "missed_contacts"),
    "hull": ("angle_mean", "center_error"),
    "tracker": ("displacement_rms", "displacement_p99", "wrong_percent"),
    "flow_in_mask": ("flow_error",),
}
"""Group -> quantities in its table."""

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
"""Heading -> quantities, for the table of scenes."""


def lines(result: BenchResult) -> Iterator[str]:
    """Everything that was measured, from the summary to single scenes."""
    machine = ", ".join(f"{key} {value}" for key, value in result.machine.items())
    kind = "quick" if result.quick else "full"
    summary = (
        f"A {kind} run of {result.wall_s:.0f} s on {machine}. Times are CPU times of a frame in one thread, "
        "medians."
    )
    yield from markdown("Machine", summary)
    for group in dict.fromkeys(m.group for m in result.measured):
        yield from _methods(result, group)
    yield from _scenes(result)
    if result.failures:
        rows = [[key, why.partition("\n")[0]] for key, why in result.failures.items()]
        yield from markdown("Failures", "", ["group/method/scene", "why"], rows)


def _methods(result: BenchResult, group: str) -> Iterator[str]:
    """One row per method of a group."""
    measured = result.measurements(group)
    quantities = [QUANTITIES[key] for key in PRIMARY.get(group, ())]
    heads = ["method", "contact, ms", "idle, ms", *(q.heading for q in quantities)]
    rows = []
    for method in dict.fromkeys(m.method for m in measured):
        own = [m.values for m in measured if m.method == method]
        row = [method + _measured_frames(own)]
        for key in TIMES.values():
            times = [values[key] for values in own if key in values]
            row.append(number(median(times)) if times else "-")
        for quantity in quantities:
            errors = [values[quantity.key] for values in own if quantity.key in values]
            worst = max(errors, key=quantity.distance, default=0.0)
            row.append(f"{number(median(errors))} ({number(worst)})" if errors else "-")
        rows.append(row)
    text = "Median over the scenes, in brackets the worst one."
    if any(LEFT_OUT in m.values for m in measured):
        text += " Methods with a number of frames behind their name were too slow for all of them."
    return markdown(TITLES.get(group, group), text, heads, rows)


def _measured_frames(own: Sequence[Mapping[str, float]]) -> str:
    """How many frames a method was measured on, if not all."""
    left_out, frames = (int(sum(values.get(key, 0) for values in own)) for key in (LEFT_OUT, "frames"))
    return f" ({frames} of {frames + left_out} frames)" if left_out else ""


def _scenes(result: BenchResult) -> Iterator[str]:
    """One row for each pipeline on each simulated scene."""
    rows = [[m.scene, m.method, *_cells(m, SCENE_COLUMNS)] for m in result.measurements(PIPELINE)]
    text = f"Time of a frame with contact, and mean errors. `{CLASSIC}` is the original script."
    columns = ["scene", "pipeline", "ms", *SCENE_COLUMNS]
    return markdown("Whole pipelines, scene by scene", text, columns, rows)


def _cells(measurement: Measurement, columns: dict[str, tuple[str, ...]]) -> list[str]:
    """The time, ms, and the quantities of each column; a dash where one was not measured."""
    values = measurement.values
    time = "-" if measurement.time_ms is None else number(measurement.time_ms)
    cells = (", ".join(number(values[k]) if k in values else "-" for k in keys) for keys in columns.values())
    return [time, *cells]


def number(value: float) -> str:
    """Three significant digits, without an exponent."""
    return np.format_float_positional(value, 3, fractional=False, trim="-")
