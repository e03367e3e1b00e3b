"""The parts of a result message, read back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactflow.engine.frame import Absent
from tactflow.vision.types import Contact, Depth, Ellipse, Flow, Force, Markers, MarkerStatus, Scale, Slip

_STATUS = {status.name.lower(): int(status) for status in MarkerStatus}
_UNKNOWN = float("nan")


def decode_values(message: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, str]]:
    """Port -> value or `Absent`, and the reasons of what was skipped.

    Raises KeyError, TypeError or ValueError for what is no result message.
    """
    skipped = {str(port): str(reason) for port, reason in message["skipped"].items()}
    values: dict[str, Any] = {
        "contact": _contact(message["contact"], message.get("contacts", ())),
        "flow": _flow(message["flow"]),
        "markers": _markers(message["markers"]),
        "scale": _scale(message.get("scale")),
        "depth": _depth(message["contact"]),
        "slip": _slip(message.get("slip")),
        "force": _force(message.get("force")),
    }
    absent = {port: Absent(skipped.get(port, "none")) for port, value in values.items() if value is None}
    return values | absent, skipped


def _contact(whole: Any, all_contacts: Any = ()) -> Contact | None:
    if whole is None:
        return None
    ellipse = whole.get("ellipse")
    parts = [part for part in map(_contact, all_contacts) if part is not None]
    return Contact(
        area=float(whole["area"]),
        center=_pair(whole["center"]),
        angle=_optional(whole.get("angle")),
        slope=_optional(whole.get("slope")),
        hull=_points(whole["hull"]),
        ellipse=None
        if ellipse is None
        else Ellipse(_pair(ellipse["center"]), _pair(ellipse["axes"]), _optional(ellipse["angle"])),
        confidence=float(whole.get("confidence", 0.0)),
        evidence=whole.get("evidence", "light"),
        separate=tuple(parts) if len(parts) > 1 else (),
    )


def _depth(contact: Any) -> Depth | None:
    if contact is None or contact.get("depth_mm") is None:
        return None
    return Depth(
        heights=np.zeros((0, 0), np.float32),
        greatest=float(contact["depth_mm"]),
        greatest_stderr=_optional(contact.get("depth_mm_stderr")),
        volume=float(contact["volume_mm3"]),
        volume_stderr=_optional(contact.get("volume_mm3_stderr")),
    )


def _flow(flow: Any) -> Flow | None:
    if flow is None:
        return None
    pairs = ("mean", "stderr", "shear")
    numbers = ("rotation", "divergence", "residual", "rotation_stderr", "divergence_stderr", "shear_stderr")
    values: dict[str, Any] = {key: _optional_pair(flow.get(key)) for key in pairs}
    values |= {key: _optional(flow.get(key)) for key in numbers}
    return Flow(count=int(flow["count"]), **values)


def _markers(markers: Any) -> Markers | None:
    if markers is None:
        return None
    position, status = _points(markers["position"]), markers["status"]
    stderr = [_UNKNOWN if s is None else s for s in markers.get("stderr", [None] * len(status))]
    return Markers(
        origin=_points(markers["origin"]),
        position=position,
        status=np.array([_STATUS[name] for name in status], np.uint8),
        stderr=np.array(stderr, np.float64),
    )


def _scale(scale: Any) -> Scale | None:
    if scale is None:
        return None
    return Scale(*_pair(scale["mm_per_px"]), (_UNKNOWN, _UNKNOWN), _pair(scale["origin"]))


def _slip(slip: Any) -> Slip | None:
    return None if slip is None else Slip(bool(slip["slipping"]), float(slip["stick_ratio"]))


def _force(force: Any) -> Force | None:
    if force is None:
        return None
    (x, y, z), (x_stderr, y_stderr, z_stderr) = force["value"], force["stderr"]
    return Force(
        (_optional(x), _optional(y), float(z)),
        (_optional(x_stderr), _optional(y_stderr), float(z_stderr)),
        bool(force["in_range"]),
    )


def _optional(value: Any) -> float | None:
    return None if value is None else float(value)


def _optional_pair(pair: Any) -> tuple[float, float] | None:
    return None if pair is None else _pair(pair)


def _pair(pair: Any) -> tuple[float, float]:
    x, y = pair
    return float(x), float(y)


def _points(points: Any) -> NDArray[np.float64]:
    return np.array(points, np.float64).reshape(-1, 2)
