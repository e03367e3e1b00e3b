"""The JSON Schema of the result message `tactflow.frame/1`."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any

from pydantic.json_schema import GenerateJsonSchema

from tactflow.message.fields import Message


class _NoDefaults(GenerateJsonSchema):
    """Without defaults, because a field missing in a message has no value."""

    def default_schema(self, schema: Any) -> dict[str, Any]:
        return self.generate_inner(schema["schema"])


@functools.cache
def message_schema() -> dict[str, Any]:
    """JSON Schema (draft 2020-12) of the result message; cached, do not modify it.

    `field` and the fields marked (detail) or (calibrated) are optional.
    """
    schema = Message.model_json_schema(by_alias=True, schema_generator=_NoDefaults)
    return {"$schema": GenerateJsonSchema.schema_dialect, **schema}


def resolved(part: Mapping[str, Any], definitions: Mapping[str, Any]) -> dict[str, Any]:
    """A part of a JSON Schema with `$ref` and `anyOf` resolved, assuming that it is not null."""
    inner = next((choice for choice in part.get("anyOf", ()) if choice.get("type") != "null"), part)
    if "$ref" in inner:
        inner = definitions[inner["$ref"].rpartition("/")[2]]
    return {key: value for key, value in {**inner, **part}.items() if key not in ("$ref", "anyOf")}
