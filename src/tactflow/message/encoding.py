"""Encoding of results as dicts, lists and arrays, which `orjson` writes as the message `tactflow.frame/1`.

Numbers have full precision: the shortest decimal that reads back as the same double.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.types import Contact, Depth, Flow, Markers, MarkerStatus, Pose, Scale, Slip

if TYPE_CHECKING:
    from tactflow.message.result import Result
    from tactflow.vision.flow.displacement_field import DisplacementField

SCHEMA = "tactflow.frame/1"
STATUS_NAMES = tuple(status.name.lower() for status in sorted(MarkerStatus))
"""The word for each value of `MarkerStatus`."""
FLOW_DETAILS = (
    *("stderr", "rotation", "divergence", "residual"),
    *("rotation_stderr", "divergence_stderr", "shear_stderr", "shear"),
)
"""Attributes of `Flow` in detailed messages only."""
SLIP_DETAILS = ("translation_stderr", "rotation_stderr", "speed_stderr")
"""Attributes of `Slip` in detailed messages only."""
_EXPLAINED = frozenset({"contact", "flow", "markers", "reference"})
"""Keys of `skipped` in a message: the ports of every message, and the reference."""


def encode(result: Result, detail: bool, field: bool) -> dict[str, Any]:
    """The message of a result. Raises ValueError with the name of the field for a number that is not
    finite."""
    contact, flow, markers, scale = result.contact, result.flow, result.markers, result.scale
    message: dict[str, Any] = {
        "schema": SCHEMA,
        "sensor": result.sensor,
        "seq": result.seq,
        "t": result.t,
        "size": result.size,
        "contact": None if contact is None else _contact(contact, scale, result.depth, detail),
        "contacts": tuple(_contact(part, scale, None, detail) for part in result.contacts),
        "flow": None if flow is None else _flow(flow, scale, detail),
        "markers": None if markers is None else _markers(markers, detail),
        "skipped": {port: reason for port, reason in result.skipped.items() if port in _EXPLAINED},
    }
    if contact is not None and result.normals is not None and result.contact_mask is not None:
        message["contact"]["normal"] = _mean_normal(result.normals[result.contact_mask > 0])
    if scale is not None:
        message["scale"] = {"mm_per_px": (scale.x, scale.y), "origin": scale.origin}
    if result.slip is not None:
        message["slip"] = _slip(result.slip, scale, detail)
    if result.force is not None:
        message["force"] = _attributes(result.force, "value", "stderr", "in_range")
    if result.pose is not None:
        message["pose"] = _pose(result.pose, detail)
    if result.features is not None:
        message["features"] = _attributes(result.features, "values", "unit")
    if field:
        message["field"] = None if result.field is None else _field(result.field)
    return {name: _finite(part, name) for name, part in message.items()}


def _attributes(part: object, *names: str) -> dict[str, Any]:
    return {name: getattr(part, name) for name in names}


def _contact(contact: Contact, scale: Scale | None, depth: Depth | None, detail: bool) -> dict[str, Any]:
    message = _attributes(contact, "area", "center", "angle", "slope", "hull", "ellipse", "evidence")
    if contact.probability is not None:
        message["probability"] = contact.probability
    if contact.ellipse is not None:
        message["ellipse"] = _attributes(contact.ellipse, "center", "axes", "angle")
    if scale is not None:
        message |= {"center_mm": scale.point(contact.center), "area_mm2": scale.area(contact.area)}
    if detail:
        message["confidence"] = contact.confidence
        if scale is not None:
            message["center_mm_stderr"] = scale.point_stderr(contact.center)
            message["area_mm2_stderr"] = scale.area_stderr(contact.area)
    if depth is not None:
        message |= {"depth_mm": depth.greatest, "volume_mm3": depth.volume}
        if detail:
            message |= {"depth_mm_stderr": depth.greatest_stderr, "volume_mm3_stderr": depth.volume_stderr}
    return message


def _mean_normal(normals: NDArray[np.float32]) -> list[float] | None:
    """Unit vector along the sum of normals (n, 3); None without normals."""
    total = normals.sum(axis=0, dtype=np.float64)
    length = float(np.linalg.norm(total))
    return (total / length).tolist() if length else None


def _flow(flow: Flow, scale: Scale | None, detail: bool) -> dict[str, Any]:
    message = _attributes(flow, "mean", "count")
    if scale is not None:
        message["mean_mm"] = None if flow.mean is None else scale.vector(flow.mean)
        if detail and flow.mean is not None and flow.stderr is not None:
            message["mean_mm_stderr"] = scale.vector_stderr(flow.mean, flow.stderr)
    if detail:
        message |= _attributes(flow, *FLOW_DETAILS)
    return message


def _slip(slip: Slip, scale: Scale | None, detail: bool) -> dict[str, Any]:
    message = _attributes(
        slip, "slipping", "stick_ratio", "probability", "translation", "rotation", "speed", "since"
    )
    if scale is not None:
        message["translation_mm"] = None if slip.translation is None else scale.vector(slip.translation)
        message["speed_mm"] = None if slip.speed is None else slip.speed * math.sqrt(scale.x * scale.y)
    if detail:
        message |= _attributes(slip, *SLIP_DETAILS)
    return message


def _pose(pose: Pose, detail: bool) -> dict[str, Any]:
    message = _attributes(pose, "status", "since", "center", "translation", "rotation", "stderr")
    return message | {"covariance": pose.covariance.ravel()} if detail else message


def _markers(markers: Markers, detail: bool) -> dict[str, Any]:
    message = _attributes(markers, "origin", "position")
    message["status"] = [STATUS_NAMES[value] for value in markers.status.tolist()]
    if not detail:
        return message
    if markers.probability is not None:
        message["probability"] = markers.probability
    return message | {"stderr": markers.stderr}


def _field(field: DisplacementField) -> dict[str, Any]:
    return _attributes(field.grid, "first", "spacing") | _attributes(field, "displacement", "stderr")


def _finite(value: Any, name: str) -> Any:
    """Check and convert for the encoder. NaN is allowed in standard errors and probabilities (null)."""
    if isinstance(value, dict):
        return {key: _finite(part, f"{name}.{key}") for key, part in value.items()}
    if isinstance(value, tuple):
        return [_finite(part, name) for part in value]
    if isinstance(value, np.ndarray):
        value = np.ascontiguousarray(value, np.float64)
        # The sum of squares is finite only if all numbers are; this needs no temporary array.
        total = float(np.vdot(value, value))
    elif isinstance(value, float | np.floating):
        value = total = float(value)
    else:
        return value
    if math.isfinite(total) or (name.endswith(("stderr", "probability")) and not np.isinf(value).any()):
        return value
    raise ValueError(f"{name}: required finite numbers, got NaN or infinity")
