"""Results as sinks get them, and the message as a subscriber has it after parsing."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from tactflow.engine.frame import Tick
from tactflow.message.result import Result
from tactflow.ports import Image
from tactflow.vision.flow.displacement_field import DisplacementField
from tactflow.vision.types import Contact, Depth, Ellipse, Flow, Force, Markers, Pose, Scale, Slip

PROCESSED = np.zeros((400, 300, 3), np.uint8)
CONTACT = Contact(
    area=5123.5,
    center=(150.2, 201.7),
    angle=-12.31,
    slope=0.218,
    hull=np.array([[1.0, 2.0], [3.0, 4.5], [0.1, 9.0]]),
    ellipse=Ellipse((150.0, 200.0), (90.5, 60.25), -12.9),
    confidence=0.75,
    evidence="both",
)
SHEAR = {"shear": (0.02, -0.01), "rotation_stderr": 0.3, "divergence_stderr": 0.01, "shear_stderr": 0.01}
FLOW = Flow((1.21, -0.33), 9, stderr=(0.1, 0.2), rotation=3.5, divergence=0.01, residual=0.05, **SHEAR)  # type: ignore[arg-type]
MARKERS = Markers(
    origin=np.array([[10.0, 20.0], [30.0, 40.0], [50.0, 60.0]]),
    position=np.array([[10.5, 20.5], [30.25, 40.0], [50.0, 61.0]]),
    status=np.array([0, 1, 2], np.uint8),
    stderr=np.array([0.02, np.nan, np.nan]),
)


class Results(NamedTuple):
    """Values of the well-known ports; None where there is nothing."""

    image: Image | None = None
    contact: Contact | None = None
    flow: Flow | None = None
    markers: Markers | None = None
    scale: Scale | None = None
    depth: Depth | None = None
    field: DisplacementField | None = None
    slip: Slip | None = None
    force: Force | None = None
    pose: Pose | None = None


def result_of(tick: Tick, results: Results) -> Result:
    """The result that a sink gets for these values."""
    return Result(tick.frame, results._asdict(), tick.skipped)


def build_message(tick: Tick, results: Results, *, detail: bool = False) -> dict[str, Any]:
    """The message about one frame as plain dicts, lists and numbers."""
    return result_of(tick, results).to_dict(detail=detail)
