"""The parts of a result message, as `orjson` takes them.

Numbers are written with full precision (the shortest decimal that reads back as the same double); nothing
is rounded.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import orjson
from numpy.typing import NDArray

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

if TYPE_CHECKING:
    from tactflow.vision.flow.displacement_field import DisplacementField

STATUS_NAMES = tuple(status.name.lower() for status in sorted(MarkerStatus))
"""The word for each value of `MarkerStatus`."""

OPTIONS = orjson.OPT_SERIALIZE_NUMPY


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
            text = orjson.Fragment(orjson.dumps(self._encodable(array), option=OPTIONS))
            self._last = (data, dtype, text)
        return text


def encode_scale(scale: Scale) -> dict[str, Any]:
    """The key `scale`."""
    return {
        "mm_per_px": _pair((scale.x, scale.y), "scale.mm_per_px"),
        "origin": _pair(scale.origin, "scale.origin"),
    }


def encode_contacts(
    contact: Contact | None, scale: Scale | None, depth: Depth | None, detail: bool
) -> tuple[Any, list[Any]]:
    """The keys `contact` and `contacts`."""
    if contact is None:
        return None, []
    whole = _contact(contact, scale, detail)
    if contact.separate:
        parts = [_contact(part, scale, detail) for part in contact.separate]
        return _with_depth(whole, depth, detail), parts
    # Told twice, encoded once.
    text = orjson.Fragment(orjson.dumps(whole, option=OPTIONS))
    return (text if depth is None else _with_depth(whole, depth, detail)), [text]


def _contact(contact: Contact, scale: Scale | None, detail: bool) -> dict[str, Any]:
    ellipse = contact.ellipse
    result: dict[str, Any] = {
        "area": finite(contact.area, "contact.area"),
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
        result["area_mm2"] = finite(scale.area(contact.area), "contact.area_mm2")
    if detail:
        result["confidence"] = finite(contact.confidence, "contact.confidence")
        if scale is not None:
            result["center_mm_stderr"] = list(scale.point_stderr(contact.center))
            result["area_mm2_stderr"] = scale.area_stderr(contact.area)
    return result


def _with_depth(contact: dict[str, Any], depth: Depth | None, detail: bool) -> dict[str, Any]:
    if depth is None:
        return contact
    result = contact | {
        "depth_mm": finite(depth.greatest, "contact.depth_mm"),
        "volume_mm3": finite(depth.volume, "contact.volume_mm3"),
    }
    if detail:
        result["depth_mm_stderr"] = _optional(depth.greatest_stderr, "contact.depth_mm_stderr")
        result["volume_mm3_stderr"] = _optional(depth.volume_stderr, "contact.volume_mm3_stderr")
    return result


def encode_flow(flow: Flow, scale: Scale | None, detail: bool) -> dict[str, Any]:
    """The key `flow`."""
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


def encode_slip(slip: Slip) -> dict[str, Any]:
    """The key `slip`."""
    return {
        "slipping": bool(slip.slipping),
        "stick_ratio": finite(slip.stick_ratio, "slip.stick_ratio"),
    }


def encode_force(force: Force) -> dict[str, Any]:
    """The key `force`."""
    return {
        "value": [_optional(part, "force.value") for part in force.value],
        "stderr": [_optional(part, "force.stderr") for part in force.stderr],
        "in_range": bool(force.in_range),
    }


def encode_field(field: DisplacementField) -> dict[str, Any]:
    """The key `field`."""
    return {
        "first": list(field.grid.first),
        "spacing": field.grid.spacing,
        "displacement": _points(field.displacement, "field.displacement"),
        "stderr": _points(field.stderr, "field.stderr"),
    }


def encode_markers(markers: Markers, detail: bool) -> dict[str, Any]:
    """The key `markers`."""
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


def finite(value: float, name: str) -> float:
    """The number; ValueError, with its name, for NaN and infinity."""
    number = float(value)
    if not math.isfinite(number):
        raise ValueError(f"{name}: required a finite number, got {number}")
    return number


def _optional(value: float | None, name: str) -> float | None:
    return None if value is None else finite(value, name)


def _pair(pair: tuple[float, float], name: str) -> list[float]:
    return [finite(pair[0], name), finite(pair[1], name)]


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
