"""Further message types of a recording: previews, annotations and results.

The types of Foxglove are defined by its package `foxglove-schemas-protobuf`.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.Point2_pb2 import Point2
from foxglove_schemas_protobuf.PointsAnnotation_pb2 import PointsAnnotation
from google.protobuf.message import Message  # type: ignore[import-untyped]
from mcap_protobuf.schema import build_file_descriptor_set
from numpy.typing import NDArray

from tactflow.message.result import Result
from tactflow.message.schema import message_schema, resolved
from tactflow.recording.frames import RawFrame, timestamp
from tactflow.vision.types import Markers, MarkerStatus

PIXEL_CORNER_PX = 0.5
"""Foxglove's origin is the corner of the first pixel, tactflow's is its centre, px."""
ARROW_SCALE = 3.0
"""Length of an arrow relative to the displacement, as in `visualize`."""
ARROW_HEAD_SHARE = 0.2
"""Length of an arrow's head relative to the arrow. Chosen by hand."""
LINE_WIDTH_PX, DOT_DIAMETER_PX = 2.0, 4.0
"""Width of lines, diameter of dots, px. Chosen by hand."""
CONTACT_COLOUR = Color(r=0.2, g=0.9, b=1.0, a=1.0)
ARROW_COLOUR = Color(r=1.0, g=0.85, b=0.1, a=1.0)
DOT_COLOURS = {
    MarkerStatus.TRACKED: Color(r=0.2, g=1.0, b=0.3, a=1.0),
    MarkerStatus.INFERRED: Color(r=1.0, g=0.6, b=0.0, a=1.0),
    MarkerStatus.LOST: Color(r=1.0, g=0.1, b=0.1, a=1.0),
}
"""Colours. Chosen by hand."""


class ChannelType(NamedTuple):
    """Type of the messages of a channel.

    Attributes
    ----------
    schema : encoding and bytes.
    packing : encoding of the messages.
    """

    name: str
    schema: tuple[str, bytes]
    packing: str


@functools.cache
def channel_types() -> dict[str, ChannelType]:
    """The channels of a recording."""
    raw, results = channel_type(RawFrame), json.dumps(plain_schema(message_schema())).encode()
    return {
        "frames": raw,
        "references": raw,
        "image": channel_type(CompressedImage),
        "annotations": channel_type(ImageAnnotations),
        "results": ChannelType("tactflow.frame", ("jsonschema", results), "json"),
    }


def channel_type(message: type[Message]) -> ChannelType:
    """The type of a channel with such messages."""
    schema = build_file_descriptor_set(message).SerializeToString()
    return ChannelType(message.DESCRIPTOR.full_name, ("protobuf", schema), "protobuf")


def encode_picture(jpeg: bytes, sensor: str, nanoseconds: int) -> bytes:
    """One `foxglove.CompressedImage`."""
    picture = CompressedImage(timestamp=timestamp(nanoseconds), data=jpeg, format="jpeg", frame_id=sensor)
    return bytes(picture.SerializeToString())


def encode_annotations(result: Result, nanoseconds: int) -> bytes:
    """One `foxglove.ImageAnnotations`: outlines of contacts, markers by status, arrows of displacements."""
    stamp = timestamp(nanoseconds)

    def drawn(
        kind: PointsAnnotation.Type.ValueType, points: NDArray[np.float64], colour: Color, thickness: float
    ) -> PointsAnnotation:
        places = [Point2(x=x, y=y) for x, y in (points + PIXEL_CORNER_PX).tolist()]
        return PointsAnnotation(
            timestamp=stamp, type=kind, points=places, outline_color=colour, thickness=thickness
        )

    parts = [
        drawn(PointsAnnotation.LINE_LOOP, part.hull, CONTACT_COLOUR, LINE_WIDTH_PX)
        for part in result.contacts
    ]
    markers = result.markers
    if markers is not None:
        parts.append(drawn(PointsAnnotation.LINE_LIST, _arrows(markers), ARROW_COLOUR, LINE_WIDTH_PX))
        for status, colour in DOT_COLOURS.items():
            chosen = markers.position[markers.status == status]
            if len(chosen):
                parts.append(drawn(PointsAnnotation.POINTS, chosen, colour, DOT_DIAMETER_PX))
    return bytes(ImageAnnotations(timestamp=stamp, points=parts).SerializeToString())


def _arrows(markers: Markers) -> NDArray[np.float64]:
    """End points of three lines per marker that is not lost, in pairs of rows."""
    known = markers.status != MarkerStatus.LOST
    tail, moved = markers.origin[known], ARROW_SCALE * markers.displacement[known]
    tip, across = tail + moved, np.column_stack([-moved[:, 1], moved[:, 0]])
    left, right = tip - ARROW_HEAD_SHARE * (moved - across), tip - ARROW_HEAD_SHARE * (moved + across)
    ends: NDArray[np.float64] = np.stack([tail, tip, tip, left, tip, right], axis=1).reshape(-1, 2)
    return ends


def plain_schema(schema: Mapping[str, Any], definitions: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """A simplified JSON Schema for plotting programs, with one type per field and without references.

    References are resolved, `X or null` becomes an optional field, and a tuple becomes an array. Messages
    with null are not valid under it; the exact schema is an attachment of the recording.
    """
    definitions = schema.get("$defs", {}) if definitions is None else definitions
    part = resolved(schema, definitions)
    result: dict[str, Any] = {key: part[key] for key in ("type", "title", "description") if key in part}
    if part["type"] == "array":
        result["items"] = plain_schema(
            part["items"] if "items" in part else part["prefixItems"][0], definitions
        )
    elif "properties" in part:
        fields = part["properties"].items()
        result["properties"] = {name: plain_schema(field, definitions) for name, field in fields}
    return result
