"""The result message `tactflow.frame/1`, which sinks publish; described by `message_schema.py`.

Numbers are written with full precision (the shortest decimal that reads back as the same double); nothing
is rounded.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import orjson
from numpy.typing import NDArray

from tactflow.engine.frame import Tick
from tactflow.ports import Image
from tactflow.vision.flow.displacement_field import DisplacementField
from tactflow.vision.types import (
    Contact,
    Depth,
    Flow,
    Force,
    Markers,
    MarkerStatus,
    Scale,
    Slip,
)

SCHEMA = "tactflow.frame/1"
STATUS_NAMES = tuple(status.name.lower() for status in sorted(MarkerStatus))
"""The word for each value of `MarkerStatus`."""

_EXPLAINED = frozenset({"contact", "flow", "markers", "reference"})
"""What `skipped` may name: the ports that are published, and the frame itself where a stage had it made a new
reference."""

_OPTIONS = orjson.OPT_SERIALIZE_NUMPY


class Results(NamedTuple):
    """What the pipeline found in one frame, for sinks: `def write(self, tick: Tick, results: Results)`.

    image : the processed frame. scale, depth, force : only with a calibration. field, slip : only where a
    stage of that name stands in the pipeline. Each is None where it was not computed or nothing was found.

    >>> Results().contact is None
    True
    """

    image: Image | None = None
    contact: Contact | None = None
    flow: Flow | None = None
    markers: Markers | None = None
    scale: Scale | None = None
    depth: Depth | None = None
    field: DisplacementField | None = None
    slip: Slip | None = None
    force: Force | None = None


class _Kept:
    """What the encoder is given for an array; when the array comes again, its finished text.

    Origins stay the same for a whole epoch, statuses for many frames, and an unchanged scene repeats its
    positions. Their texts are most of a message, and to compare bytes takes a twentieth of the time.

    encodable : from an array to what the encoder takes.
    """

    def __init__(self, encodable: Callable[[NDArray[Any]], Any]) -> None:
        self._encodable = encodable
        self._last: tuple[bytes, Any, orjson.Fragment | None] = (b"", None, None)

    def __call__(self, array: NDArray[Any]) -> Any:
        data, dtype = array.tobytes(), array.dtype
        known, known_dtype, text = self._last
        # Each time one assignment, so that sinks in several threads may use it.
        if known != data or known_dtype != dtype:
            self._last = (data, dtype, None)
            return self._encodable(array)
        if text is None:
            text = orjson.Fragment(orjson.dumps(self._encodable(array), option=_OPTIONS))
            self._last = (data, dtype, text)
        return text


def encode_message(tick: Tick, results: Results, *, detail: bool = False, field: bool = False) -> bytes:
    """The result message of one frame, as JSON in UTF-8 on a single line without a line end.

    Parameters
    ----------
    tick : the frame, and why values are missing.
    results : in pixels of the processed frame; None becomes null. Of the image only the size is told; without
        it, that of the raw frame.
    detail : also tell `contact.confidence`, `flow.stderr`, `flow.rotation`, `flow.divergence`,
        `flow.residual`, `flow.shear`, `markers.stderr`, and the standard errors of all these and of all that
        is in mm.
    field : also tell `field`.

    Raises
    ------
    ValueError
        If a number is NaN or infinite (except in `markers.stderr`, where NaN stands for unknown).
    """
    frame = tick.frame
    image, contact, flow, markers, scale, depth, _, slip, force = results
    pixels = frame.image if image is None else image
    whole, contacts = _contacts(contact, scale, depth, detail)
    message: dict[str, Any] = {
        "schema": SCHEMA,
        "sensor": frame.sensor,
        "seq": frame.seq,
        "t": _number(frame.t, "t"),
        "size": [pixels.shape[1], pixels.shape[0]],
        "contact": whole,
        "contacts": contacts,
        "flow": None if flow is None else _flow(flow, scale, detail),
        "markers": None if markers is None else _markers(markers, detail),
        "skipped": {port: reason for port, reason in tick.skipped.items() if port in _EXPLAINED},
    }
    if scale is not None:
        message["scale"] = _scale(scale)
    if slip is not None:
        ratio = _number(slip.stick_ratio, "slip.stick_ratio")
        message["slip"] = {"slipping": bool(slip.slipping), "stick_ratio": ratio}
    if force is not None:
        message["force"] = _force(force)
    if field:
        message["field"] = None if results.field is None else _field(results.field)
    return orjson.dumps(message, option=_OPTIONS)


def _scale(scale: Scale) -> dict[str, Any]:
    return {
        "mm_per_px": _pair((scale.x, scale.y), "scale.mm_per_px"),
        "origin": _pair(scale.origin, "scale.origin"),
    }


def _contacts(
    contact: Contact | None, scale: Scale | None, depth: Depth | None, detail: bool
) -> tuple[Any, list[Any]]:
    """What touches as a whole, and each separate contact, for the encoder."""
    if contact is None:
        return None, []
    whole = _contact(contact, scale, detail)
    if contact.separate:
        parts = [_contact(part, scale, detail) for part in contact.separate]
        return _with_depth(whole, depth, detail), parts
    # Told twice, encoded once.
    text = orjson.Fragment(orjson.dumps(whole, option=_OPTIONS))
    return (text if depth is None else _with_depth(whole, depth, detail)), [text]


def _contact(contact: Contact, scale: Scale | None, detail: bool) -> dict[str, Any]:
    ellipse = contact.ellipse
    result: dict[str, Any] = {
        "area": _number(contact.area, "contact.area"),
        "center": _pair(contact.center, "contact.center"),
        "angle": _optional(contact.angle, "contact.angle"),
        "slope": _optional(contact.slope, "contact.slope"),
        "hull": _points(contact.hull, "contact.hull"),
        "ellipse": None
        if ellipse is None
        else {
            "center": _pair(ellipse.center, "contact.ellipse.center"),
            "axes": _pair(ellipse.axes, "contact.ellipse.axes"),
            "angle": _optional(ellipse.angle, "contact.ellipse.angle"),
        },
        "evidence": contact.evidence,
    }
    if scale is not None:
        result["center_mm"] = _pair(scale.point(contact.center), "contact.center_mm")
        result["area_mm2"] = _number(scale.area(contact.area), "contact.area_mm2")
    if detail:
        result["confidence"] = _number(contact.confidence, "contact.confidence")
        if scale is not None:
            result["center_mm_stderr"] = list(scale.point_stderr(contact.center))
            result["area_mm2_stderr"] = scale.area_stderr(contact.area)
    return result


def _with_depth(contact: dict[str, Any], depth: Depth | None, detail: bool) -> dict[str, Any]:
    if depth is None:
        return contact
    result = contact | {
        "depth_mm": _number(depth.greatest, "contact.depth_mm"),
        "volume_mm3": _number(depth.volume, "contact.volume_mm3"),
    }
    if detail:
        result["depth_mm_stderr"] = _optional(depth.greatest_stderr, "contact.depth_mm_stderr")
        result["volume_mm3_stderr"] = _optional(depth.volume_stderr, "contact.volume_mm3_stderr")
    return result


def _flow(flow: Flow, scale: Scale | None, detail: bool) -> dict[str, Any]:
    result: dict[str, Any] = {
        "mean": None if flow.mean is None else _pair(flow.mean, "flow.mean"),
        "count": int(flow.count),
    }
    if scale is not None:
        result["mean_mm"] = None if flow.mean is None else _pair(scale.vector(flow.mean), "flow.mean_mm")
        if detail and flow.mean is not None and flow.stderr is not None:
            result["mean_mm_stderr"] = list(scale.vector_stderr(flow.mean, flow.stderr))
    if detail:
        result["stderr"] = None if flow.stderr is None else _pair(flow.stderr, "flow.stderr")
        result["rotation"] = _optional(flow.rotation, "flow.rotation")
        result["divergence"] = _optional(flow.divergence, "flow.divergence")
        for key in ("residual", "rotation_stderr", "divergence_stderr", "shear_stderr"):
            result[key] = _optional(getattr(flow, key), f"flow.{key}")
        result["shear"] = None if flow.shear is None else _pair(flow.shear, "flow.shear")
    return result


def _force(force: Force) -> dict[str, Any]:
    return {
        "value": [_optional(part, "force.value") for part in force.value],
        "stderr": [_optional(part, "force.stderr") for part in force.stderr],
        "in_range": bool(force.in_range),
    }


def _field(field: DisplacementField) -> dict[str, Any]:
    return {
        "first": list(field.grid.first),
        "spacing": field.grid.spacing,
        "displacement": _points(field.displacement, "field.displacement"),
        "stderr": _points(field.stderr, "field.stderr"),
    }


def _markers(markers: Markers, detail: bool) -> dict[str, Any]:
    result: dict[str, Any] = {
        "origin": _origin(markers.origin),
        "position": _position(markers.position),
        "status": _status(markers.status),
    }
    if detail:
        stderr = np.ascontiguousarray(markers.stderr, np.float64)
        if np.isinf(stderr).any():
            raise ValueError("markers.stderr: required finite numbers or NaN (unknown), got an infinite one")
        # The encoder writes NaN as null.
        result["stderr"] = stderr
    return result


def _number(value: float, name: str) -> float:
    number = float(value)
    if not math.isfinite(number):
        raise ValueError(f"{name}: required a finite number, got {number}")
    return number


def _optional(value: float | None, name: str) -> float | None:
    return None if value is None else _number(value, name)


def _pair(pair: tuple[float, float], name: str) -> list[float]:
    return [_number(pair[0], name), _number(pair[1], name)]


def _points(points: NDArray[Any], name: str) -> NDArray[np.float64]:
    # The encoder takes contiguous arrays only.
    points = np.ascontiguousarray(points, np.float64)
    # A sum of squares is finite only if every number is: one pass, no temporary. (It overflows for numbers
    # beyond 1e154, which are no pixels either.)
    if not math.isfinite(np.vdot(points, points)):
        raise ValueError(f"{name}: required finite numbers, got NaN or infinity")
    return points


_origin = _Kept(lambda points: _points(points, "markers.origin"))
_position = _Kept(lambda points: _points(points, "markers.position"))
_status = _Kept(lambda status: [STATUS_NAMES[value] for value in status.tolist()])
