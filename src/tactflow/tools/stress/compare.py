"""How far two results of the same scene differ."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from tactflow.message.result import Result
from tactflow.tools.bench import metrics
from tactflow.tools.stress.parts import PROMISES, Worst
from tactflow.vision.geometry.mapping import project
from tactflow.vision.types import MarkerStatus

FLOW_TOLERANCE_PX: Final = 0.05
"""Differences of flows that do not matter, px: the tolerance of results."""
NUMBER_UNITS: Final[Mapping[str, str]] = {
    "dots": "px",
    "center": "px",
    "angle": "deg",
    "flow": "px",
    "area": "%",
    "decision": "frames",
}
"""Number of a result that is compared -> unit of its difference."""


def numbers(result: Result) -> dict[str, Any]:
    """The numbers of a result that are compared, as plain values; those that it does not have are missing."""
    found: dict[str, Any] = {"decision": result.contact is not None}
    if result.contact is not None:
        found["center"] = list(result.contact.center)
        found["area"] = result.contact.area
        if result.contact.angle is not None:
            found["angle"] = result.contact.angle
    if result.flow is not None and result.flow.mean is not None:
        found["flow"] = list(result.flow.mean)
        stated = math.hypot(*result.flow.stderr) if result.flow.stderr is not None else 0.0
        found["flow_stderr"] = stated if math.isfinite(stated) else 0.0
    if result.markers is not None:
        seen = result.markers.status == MarkerStatus.TRACKED
        found["origin"] = result.markers.origin[seen].tolist()
        found["dots"] = result.markers.position[seen].tolist()
    return found


def difference(
    one: Mapping[str, Any], other: Mapping[str, Any], matrix: NDArray[np.float64] | None = None
) -> dict[str, float]:
    """How far the numbers of two results differ, for those that both have.

    matrix : (3, 3), affine, from the pixels of `one` to those of `other`; None for the same pixels. Dots that
    both have seen belong together where they were nearest at rest.
    """
    move = np.eye(3) if matrix is None else matrix
    found = {"decision": float(one["decision"] != other["decision"])}
    for key in ("center", "flow"):
        if key in one and key in other:
            # A displacement is not shifted.
            by = move if key == "center" else move * [[1, 1, 0], [1, 1, 0], [0, 0, 1]]
            moved = project(by, np.array([one[key]], np.float64))[0]
            found[key] = float(metrics.distance(moved, other[key]))
    if "flow" in found:
        found["flow_stated"] = found["flow"] / max(FLOW_TOLERANCE_PX, one["flow_stderr"])
    if "angle" in one and "angle" in other:
        angle = np.radians(one["angle"])
        # Angles are counter-clockwise on the screen, whose y axis points down.
        x, y = move[:2, :2] @ [np.cos(angle), -np.sin(angle)]
        found["angle"] = metrics.angle_error(float(np.degrees(np.arctan2(-y, x))), other["angle"])
    if "area" in one and "area" in other and other["area"]:
        scale = abs(np.linalg.det(move[:2, :2]))
        found["area"] = 100 * abs(one["area"] * scale - other["area"]) / other["area"]
    if one.get("dots") and other.get("dots"):
        origin = project(move, np.array(one["origin"], np.float64))
        apart = cdist(origin, np.array(other["origin"], np.float64))
        nearest = apart.argmin(axis=1)
        together = apart[np.arange(len(origin)), nearest] < max(1.0, metrics.dot_pitch(origin) / 4)
        moved = project(move, np.array(one["dots"], np.float64))[together]
        errors = metrics.distance(moved, np.array(other["dots"], np.float64)[nearest[together]])
        found["dots"] = float(errors.max(initial=0))
    return found


def add_differences(
    worst: Worst,
    prefix: str,
    pairs: Sequence[tuple[Mapping[str, Any], Mapping[str, Any]]],
    where: str,
    matrix: NDArray[np.float64] | None = None,
) -> dict[str, float]:
    """Check promises PREFIX_dots, PREFIX_center, ... on pairs of the numbers of a frame.

    Returns the largest difference of each number; of decisions, how many differ.
    """
    largest: dict[str, float] = {}
    for number, (one, other) in enumerate(pairs):
        for key, value in difference(one, other, matrix).items():
            counted = key == "decision"
            largest[key] = largest.get(key, 0.0) + value if counted else max(largest.get(key, 0.0), value)
            if f"{prefix}_{key}" in PROMISES:
                worst.add(f"{prefix}_{key}", value, f"{where}, frame {number}", count=counted)
    return largest


def cells(largest: Mapping[str, float]) -> list[str]:
    """The differences as cells of a table with the columns `NUMBER_UNITS`."""
    return [f"{largest[key]:.2g}" if key in largest else "-" for key in NUMBER_UNITS]


def heads() -> list[str]:
    """Columns for `cells`."""
    return [f"{key}, {unit}" for key, unit in NUMBER_UNITS.items()]
