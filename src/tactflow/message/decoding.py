"""Decoding of result messages."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactflow.engine.frame import Absent
from tactflow.message.encoding import STATUS_NAMES
from tactflow.vision.types import Contact, Depth, Ellipse, Features, Flow, Force, Markers, Pose, Scale, Slip

_UNKNOWN = float("nan")


def decode_values(message: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, str]]:
    """Port -> value or `Absent`, and the reasons for skipped values.

    Raises KeyError, TypeError or ValueError if it is not a result message.
    """
    skipped = {str(port): str(reason) for port, reason in message["skipped"].items()}
    values = {port: _optional(decode, message.get(port)) for port, decode in _DECODERS.items()}
    values["depth"] = _optional(_depth, message["contact"])
    parts = tuple(map(_contact, message.get("contacts", ())))
    if values["contact"] is not None and len(parts) > 1:
        values["contact"] = replace(values["contact"], separate=parts)
    absent = {port: Absent(skipped.get(port, "none")) for port, value in values.items() if value is None}
    return values | absent, skipped


def _optional(decode: Callable[[Any], Any], value: Any) -> Any:
    return None if value is None else decode(value)


def _plain(value: Any) -> Any:
    """Lists as tuples; numbers and words as they are."""
    return tuple(map(_plain, value)) if isinstance(value, list) else value


def _read(cls: Any, part: Any, **own: Any) -> Any:
    """A dataclass from the values that a part of the message has under the names of its attributes.

    own : attributes that are not such values.
    """
    names = [field.name for field in fields(cls) if field.name in part and field.name not in own]
    return cls(**{name: _plain(part[name]) for name in names}, **own)


def _points(points: Any) -> NDArray[np.float64]:
    return np.array(points, np.float64).reshape(-1, 2)


def _contact(contact: Any) -> Contact:
    ellipse = _optional(partial(_read, Ellipse), contact["ellipse"])
    found: Contact = _read(Contact, contact, hull=_points(contact["hull"]), ellipse=ellipse)
    return found


def _depth(contact: Any) -> Depth | None:
    if contact.get("depth_mm") is None:
        return None
    keys = ("depth_mm", "depth_mm_stderr", "volume_mm3", "volume_mm3_stderr")
    return Depth(np.zeros((0, 0), np.float32), *map(contact.get, keys))


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
    x, y = scale["mm_per_px"]
    return Scale(x, y, (_UNKNOWN, _UNKNOWN), _plain(scale["origin"]))


def _pose(pose: Any) -> Pose:
    """Without a covariance in the message, only the variances are known."""
    variances = np.diag(np.square(np.array(pose["stderr"], np.float64)))
    covariance = np.array(pose.get("covariance", variances), np.float64).reshape(6, 6)
    found: Pose = _read(Pose, pose, covariance=covariance)
    return found


def _features(features: Any) -> Features:
    return Features(np.array(features["values"], np.float32), features["unit"])


_DECODERS: dict[str, Callable[[Any], Any]] = {
    "contact": _contact,
    "flow": partial(_read, Flow),
    "markers": _markers,
    "scale": _scale,
    "slip": partial(_read, Slip),
    "force": partial(_read, Force),
    "pose": _pose,
    "features": _features,
}
