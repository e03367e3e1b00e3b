"""The other message types of a recording: pictures for people, and results."""

from __future__ import annotations

from typing import Any

from tactflow.recording.protobuf import describe, encode, timestamp

PICTURE_TYPE = "foxglove.CompressedImage"
PICTURE_DESCRIPTOR = describe(
    PICTURE_TYPE,
    [("timestamp", 1, "Timestamp"), ("data", 2, "bytes"), ("format", 3, "string"), ("frame_id", 4, "string")],
)
"""https://docs.foxglove.dev/docs/visualization/message-schemas/compressed-image"""

RESULT_TYPE = "tactflow.frame"


def encode_picture(jpeg: bytes, sensor: str, nanoseconds: int) -> bytes:
    """One `foxglove.CompressedImage`."""
    return encode([(1, timestamp(nanoseconds)), (2, jpeg), (3, "jpeg"), (4, sensor)])


def plain_schema(schema: dict[str, Any]) -> dict[str, Any]:
    """A JSON Schema for programs that plot: what each field is where it is known.

    They want one type per field and no references. So references are filled in, `X or null` becomes a field
    that may be missing, and a tuple becomes an array. Messages with null in them are not valid under it; the
    exact schema is an attachment of the recording.
    """
    definitions = schema.get("$defs", {})

    def plain(part: dict[str, Any]) -> dict[str, Any]:
        if "$ref" in part:
            inner = definitions[part["$ref"].rpartition("/")[2]]
            return plain(inner | {key: value for key, value in part.items() if key != "$ref"})
        if "anyOf" in part:
            known = next(choice for choice in part["anyOf"] if choice.get("type") != "null")
            return plain(known | {key: value for key, value in part.items() if key != "anyOf"})
        if "const" in part:
            return {"type": "string"} | _words(part)
        kind = part["type"]
        result = {"type": kind} | _words(part)
        if kind == "array":
            result["items"] = plain(part["items"] if "items" in part else part["prefixItems"][0])
        elif kind == "object" and "properties" in part:
            result["properties"] = {name: plain(field) for name, field in part["properties"].items()}
        return result

    return plain(schema)


def _words(part: dict[str, Any]) -> dict[str, Any]:
    return {key: part[key] for key in ("title", "description") if key in part}
