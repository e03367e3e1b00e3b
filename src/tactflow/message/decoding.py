"""Decoding of result messages."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from tactflow.engine.frame import Absent
from tactflow.message.encoding import FLOW_DETAILS, SLIP_DETAILS, STATUS_NAMES
from tactflow.vision.types import Contact, Depth, Ellipse, Features, Flow, Force, Markers, Pose, Scale, Slip

T = TypeVar("T")

_UNKNOWN = float("nan")


def decode_values(message: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, str]]:
    """Port -> value or `Absent`, and the reasons for skipped values.

    Raises KeyError, TypeError or ValueError if it is not a result message.
    """
    skipped = {str(port): str(reason) for port, reason in message["skipped"].items()}
    values: dict[str, Any] = {
        "contact": _optional(_contact, message["contact"]),
        "flow": _optional(_flow, message["flow"]),
        "markers": _optional(_markers, message["markers"]),
        "scale": _optional(_scale, message.get("scale")),
        "depth": _optional(_depth, message["contact"]),
        "slip": _optional(_slip, message.get("slip")),
        "force": _optional(_force, message.get("force")),
        "pose": _optional(_pose, message.get("pose")),
        "features": _optional(_features, message.get("features")),
    }
    parts = tuple(map(_contact, message.get("contacts", ())))
    if values["contact"] is not None and len(parts) > 1:
        values["contact"] = replace(values["contact"], separate=parts)
    absent = {port: Absent(skipped.get(port, "none")) for port, value in values.items() if value is None}
    return values | absent, skipped


def _optional(decode: Callable[[Any], T], value: Any) -> T | None:
    return None if value is None else decode(value)


def _numbers(value: Any) -> Any:
    """A number, or a tuple of numbers; None if unknown."""
    return tuple(map(_numbers, value)) if isinstance(value, list | tuple) else _optional(float, value)


def _pair(pair: Any) -> tuple[float, float]:
    x, y = pair
    return float(x), float(y)


def _points(points: Any) -> NDArray[np.float64]:
    return np.array(points, np.float64).reshape(-1, 2)


def _contact(contact: Any) -> Contact:
    return Contact(
        area=float(contact["area"]),
        center=_pair(contact["center"]),
        angle=_optional(float, contact["angle"]),
        slope=_optional(float, contact["slope"]),
        hull=_points(contact["hull"]),
        ellipse=_optional(_ellipse, contact["ellipse"]),
        confidence=float(contact.get("confidence", 0.0)),
        evidence=contact.get("evidence", "light"),
        probability=contact.get("probability"),
    )


def _ellipse(ellipse: Any) -> Ellipse:
    return Ellipse(_pair(ellipse["center"]), _pair(ellipse["axes"]), _optional(float, ellipse["angle"]))


def _depth(contact: Any) -> Depth | None:
    if contact.get("depth_mm") is None:
        return None
    depth, depth_stderr, volume, volume_stderr = (
        _numbers(contact.get(key))
        for key in ("depth_mm", "depth_mm_stderr", "volume_mm3", "volume_mm3_stderr")
    )
    return Depth(np.zeros((0, 0), np.float32), depth, depth_stderr, volume, volume_stderr)


def _flow(flow: Any) -> Flow:
    details = {key: _numbers(flow.get(key)) for key in FLOW_DETAILS}
    return Flow(_optional(_pair, flow["mean"]), int(flow["count"]), **details)


def _markers(markers: Any) -> Markers:
    status, probability = markers["status"], markers.get("probability")
    return Markers(
        origin=_points(markers["origin"]),
        position=_points(markers["position"]),
        status=np.array([STATUS_NAMES.index(name) for name in status], np.uint8),
        # None becomes NaN: unknown.
        stderr=np.array(markers.get("stderr", [None] * len(status)), np.float64),
        probability=None if probability is None else np.array(probability, np.float64),
    )


def _scale(scale: Any) -> Scale:
    return Scale(*_pair(scale["mm_per_px"]), (_UNKNOWN, _UNKNOWN), _pair(scale["origin"]))


def _slip(slip: Any) -> Slip:
    keys = ("probability", "translation", "rotation", "speed", "since", *SLIP_DETAILS)
    known = {key: _numbers(slip.get(key)) for key in keys}
    since = _optional(int, known.pop("since"))
    return Slip(bool(slip["slipping"]), float(slip["stick_ratio"]), since=since, **known)


def _force(force: Any) -> Force:
    return Force(_numbers(force["value"]), _numbers(force["stderr"]), bool(force["in_range"]))


def _pose(pose: Any) -> Pose:
    """Without a covariance in the message, only the variances are known."""
    variances = np.diag(np.square(np.array(pose["stderr"], np.float64)))
    covariance = np.array(pose.get("covariance", variances), np.float64).reshape(6, 6)
    center, translation, rotation = (_numbers(pose[key]) for key in ("center", "translation", "rotation"))
    return Pose(pose["status"], int(pose["since"]), center, translation, rotation, covariance)


def _features(features: Any) -> Features:
    return Features(np.array(features["values"], np.float32), str(features["unit"]))
