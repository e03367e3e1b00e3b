"""Results as sinks get them, and the message as a subscriber has it after parsing."""

from __future__ import annotations

from typing import Any, NamedTuple

from tactflow.engine.frame import Tick
from tactflow.message.result import Result
from tactflow.ports import Image
from tactflow.vision.flow.displacement_field import DisplacementField
from tactflow.vision.types import Contact, Depth, Flow, Force, Markers, Scale, Slip


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


def result_of(tick: Tick, results: Results) -> Result:
    """The result that a sink gets for these values."""
    return Result(tick.frame, results._asdict(), tick.skipped)


def build_message(tick: Tick, results: Results, *, detail: bool = False) -> dict[str, Any]:
    """The message about one frame as plain dicts, lists and numbers."""
    return result_of(tick, results).to_dict(detail=detail)
