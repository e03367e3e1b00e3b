"""`tactflow schema`: JSON Schema of the result message, or of a pipeline file."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from typing import Any, get_args

from tactflow.engine.graph import Component, ErrorAction, FullPolicy

Schema = dict[str, Any]

_WORD = "^[A-Za-z0-9_-]+$"
_OWN_CLASS = r"[:/]|\.py$"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `schema`."""
    parser.add_argument(
        "what", nargs="?", choices=("message", "pipeline"), default="message", help="default: message"
    )


def run(args: argparse.Namespace) -> int:
    """Print the schema."""
    if args.what == "message":
        from tactflow.message import message_schema

        schema = message_schema()
    else:
        from tactflow.config.registry import available

        schema = pipeline_schema(available())
    print(json.dumps(schema, indent=2))
    return 0


def pipeline_schema(components: Sequence[Component]) -> Schema:
    """JSON Schema (2020-12) of a pipeline file made of these components.

    `use` decides which parameters are allowed; without it, the id does. The parameters of a class of the
    user's own are not known and so not checked.
    """
    definitions: Schema = {"queue": _QUEUE, "on_error": _ON_ERROR, "gate": _GATE}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "tactflow pipeline",
        "type": "object",
        "additionalProperties": False,
        "required": ["stages"],
        "properties": {
            "sensor": {
                "type": "string",
                "pattern": _WORD,
                "default": "main",
                "description": "name in topics",
            },
            "sensors": {
                "type": "object",
                "minProperties": 1,
                "propertyNames": {"pattern": _WORD},
                "additionalProperties": {"type": ["object", "null"]},
                "description": "name -> changes to this file, for several sensors with the same graph",
            },
            "skipping": {
                "type": "boolean",
                "default": True,
                "description": "false runs every stage every frame",
            },
            "opencv_threads": {
                "type": ["integer", "null"],
                "minimum": 0,
                "description": "null: OpenCV's choice",
            },
            "realtime_priority": {
                "type": "boolean",
                "default": True,
                "description": "false does not ask the system to run live frames before all else",
            },
            "stages": _section("stages", [c for c in components if c.kind != "sink"], definitions),
            "sinks": _section("sinks", [c for c in components if c.kind == "sink"], definitions),
        },
        "$defs": definitions,
    }


def _section(section: str, components: Sequence[Component], definitions: Schema) -> Schema:
    for component in components:
        _define(component, section, definitions)
    known = [component.name for component in components]
    named = [
        {
            "if": {"properties": {"use": {"const": name}}, "required": ["use"]},
            "then": {"$ref": f"#/$defs/{section}.{name}"},
        }
        for name in known
    ]
    definitions[section] = {
        "type": "object",
        "required": ["use"],
        "properties": {
            **_envelope(section),
            "use": {"anyOf": [{"enum": known}, {"type": "string", "pattern": _OWN_CLASS}]},
        },
        "allOf": named,
    }
    by_id = {
        name: {
            "if": {"type": "object", "required": ["use"]},
            "then": {"$ref": f"#/$defs/{section}"},
            "else": {"$ref": f"#/$defs/{section}.{name}"},
        }
        for name in known
    }
    return {
        "type": ["object", "null"] if section == "sinks" else "object",
        "propertyNames": {"pattern": _WORD},
        "properties": by_id,
        "additionalProperties": {"$ref": f"#/$defs/{section}"},
    }


def _define(component: Component, section: str, definitions: Schema) -> None:
    prefix = f"{section}.{component.name}"
    schema = component.params.model_json_schema(ref_template=f"#/$defs/{prefix}.{{model}}")
    for name, inner in schema.pop("$defs", {}).items():
        definitions[f"{prefix}.{name}"] = inner
    schema["properties"] = {**_envelope(section), **schema.get("properties", {})}
    if not schema.get("required"):
        schema["type"] = ["object", "null"]
    schema["title"] = component.name
    summary = (component.cls.__doc__ or "").strip().partition("\n")[0]
    if summary:
        schema["description"] = summary
    definitions[prefix] = schema


def _envelope(section: str) -> Schema:
    common: Schema = {
        "use": {"type": "string"},
        "in": {"type": ["object", "null"], "additionalProperties": {"type": ["string", "null"]}},
        "when": {"anyOf": [{"$ref": "#/$defs/gate"}, {"type": "array", "items": {"$ref": "#/$defs/gate"}}]},
        "segment": {"type": ["string", "null"], "pattern": _WORD},
        "queue": {"$ref": "#/$defs/queue"},
        "on_error": {"$ref": "#/$defs/on_error"},
    }
    if section == "sinks":
        common["max_rate"] = {"type": ["number", "null"], "exclusiveMinimum": 0, "description": "Hz"}
    return common


_ACTION: Schema = {"enum": list(get_args(ErrorAction))}
_QUEUE: Schema = {
    "type": ["object", "null"],
    "additionalProperties": False,
    "properties": {
        "capacity": {"type": ["integer", "null"], "minimum": 1},
        "when_full": {"enum": list(get_args(FullPolicy))},
    },
}
_ON_ERROR: Schema = {
    "anyOf": [
        _ACTION,
        {
            "type": "object",
            "additionalProperties": False,
            "properties": {"action": _ACTION, "budget": {"type": ["integer", "null"], "minimum": 0}},
        },
    ]
}
_GATE: Schema = {
    "anyOf": [
        {"type": ["string", "null"]},
        {
            "type": "object",
            "additionalProperties": False,
            "required": ["signal"],
            "properties": {
                "signal": {"type": "string"},
                "otherwise": {"enum": ["absent", "repeat"]},
                "hold": {"type": ["integer", "null"], "minimum": 0},
                "at_least_every": {"type": ["integer", "null"], "minimum": 1},
                "reason": {"type": ["string", "null"], "pattern": _WORD},
            },
        },
    ]
}
