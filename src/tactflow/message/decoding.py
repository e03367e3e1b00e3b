"""The parts of a result message, read back."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from tactflow.engine.frame import Absent
from tactflow.vision.types import Contact, Depth, Ellipse, Flow, Force, Markers, MarkerStatus, Scale, Slip

T = TypeVar("T")

_STATUS = {status.name.lower(): int(status) for status in MarkerStatus}
_UNKNOWN = float("nan")


def decode_values(message: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, str]]:
    """Port -> value or `Absent`, and the reasons of what was skipped.

    Raises KeyError, TypeError or ValueError for what is no result message.
    """
    skipped = {str(port): str(reason) for port, reason in message["skipped"].items()}
    contact = message["contact"]
    parts = () if contact is None else tuple(map(_contact, message.get("contacts", ())))
    values: dict[str, Any] = {
        "contact": None if contact is None else _contact(contact, parts if len(parts) > 1 else ()),
        "flow": _optional(_flow, message["flow"]),
        "markers": _optional(_markers, message["markers"]),
        "scale": _optional(_scale, message.get("scale")),
        "depth": None if contact is None or contact.get("depth_mm") is None else _depth(contact),
        "slip": _optional(_slip, message.get("slip")),
        "force": _optional(_force, message.get("force")),
    }
    absent = {port: Absent(skipped.get(port, "none")) for port, value in values.items() if value is None}
    return values | absent, skipped


def _optional(decode: Callable[[Any], T], value: Any) -> T | None:
    return None if value is None else decode(value)


def _contact(contact: Any, separate: tuple[Contact, ...] = ()) -> Contact:
    return Contact(
        area=float(contact["area"]),
        center=_pair(contact["center"]),
        angle=_optional(float, contact.get("angle")),
        slope=_optional(float, contact.get("slope")),
        hull=_points(contact["hull"]),
        ellipse=_optional(_ellipse, contact.get("ellipse")),
        confidence=float(contact.get("confidence", 0.0)),
        evidence=contact.get("evidence", "light"),
        separate=separate,
    )


def _ellipse(ellipse: Any) -> Ellipse:
    return Ellipse(_pair(ellipse["center"]), _pair(ellipse["axes"]), _optional(float, ellipse["angle"]))


def _depth(contact: Any) -> Depth:
    return Depth(
        heights=np.zeros((0, 0), np.float32),
        greatest=float(contact["depth_mm"]),
        greatest_stderr=_optional(float, contact.get("depth_mm_stderr")),
        volume=float(contact["volume_mm3"]),
        volume_stderr=_optional(float, contact.get("volume_mm3_stderr")),
    )


def _flow(flow: Any) -> Flow:
    numbers = ("rotation", "divergence", "residual", "rotation_stderr", "divergence_stderr", "shear_stderr")
    values: dict[str, Any] = {key: _optional(_pair, flow.get(key)) for key in ("mean", "stderr", "shear")}
    values |= {key: _optional(float, flow.get(key)) for key in numbers}
    return Flow(count=int(flow["count"]), **values)


def _markers(markers: Any) -> Markers:
    status = markers["status"]
    return Markers(
        origin=_points(markers["origin"]),
        position=_points(markers["position"]),
        status=np.array([_STATUS[name] for name in status], np.uint8),
        # None becomes NaN: unknown.
        stderr=np.array(markers.get("stderr", [None] * len(status)), np.float64),
    )


def _scale(scale: Any) -> Scale:
    return Scale(*_pair(scale["mm_per_px"]), (_UNKNOWN, _UNKNOWN), _pair(scale["origin"]))


def _slip(slip: Any) -> Slip:
    return Slip(bool(slip["slipping"]), float(slip["stick_ratio"]))


def _force(force: Any) -> Force:
    (x, y, z), (x_stderr, y_stderr, z_stderr) = force["value"], force["stderr"]
    return Force(
        (_optional(float, x), _optional(float, y), float(z)),
        (_optional(float, x_stderr), _optional(float, y_stderr), float(z_stderr)),
        bool(force["in_range"]),
    )


def _pair(pair: Any) -> tuple[float, float]:
    x, y = pair
    return float(x), float(y)


def _points(points: Any) -> NDArray[np.float64]:
    return np.array(points, np.float64).reshape(-1, 2)
