"""Decoding of result messages."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import MISSING, fields, replace
from functools import cache, partial
from math import nan
from typing import Any, get_type_hints

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, create_model

from tactflow.engine.frame import Absent
from tactflow.message.encoding import STATUS_NAMES
from tactflow.vision.types import Contact, Depth, Features, Flow, Force, Markers, Pose, Scale, Slip


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


@cache
def _model(cls: Any) -> type[BaseModel]:
    """The attributes of a dataclass that a message has as they are: numbers, words and tuples."""
    hints = get_type_hints(cls)
    plain = [field for field in fields(cls) if not re.search("NDArray|Contact", str(field.type))]
    attributes: dict[str, Any] = {
        field.name: (hints[field.name], ... if field.default is MISSING else field.default) for field in plain
    }
    model: type[BaseModel] = create_model("Part", **attributes)
    return model


def _read(cls: Any, part: Any, **arrays: Any) -> Any:
    """A dataclass from the values that a part of the message has under the names of its attributes."""
    return cls(**dict(_model(cls).model_validate(part)), **arrays)


def _points(points: Any) -> NDArray[np.float64]:
    return np.array(points, np.float64).reshape(-1, 2)


def _contact(contact: Any) -> Contact:
    found: Contact = _read(Contact, contact, hull=_points(contact["hull"]))
    return found


def _depth(contact: Any) -> Depth | None:
    if contact.get("depth_mm") is None:
        return None
    keys = ("depth_mm", "depth_mm_stderr", "volume_mm3", "volume_mm3_stderr")
    numbers: list[Any] = [_optional(float, contact.get(key)) for key in keys]
    return Depth(np.zeros((0, 0), np.float32), *numbers)


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
    found: Scale = _read(Scale, {"x": x, "y": y, "stderr": (nan, nan), "origin": scale["origin"]})
    return found


def _pose(pose: Any) -> Pose:
    """Without a covariance in the message, only the variances are known."""
    variances = np.diag(np.square(np.array(pose["stderr"], np.float64)))
    covariance = np.array(pose.get("covariance", variances), np.float64).reshape(6, 6)
    found: Pose = _read(Pose, pose, covariance=covariance)
    return found


def _features(features: Any) -> Features:
    return Features(np.array(features["values"], np.float32), str(features["unit"]))


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
