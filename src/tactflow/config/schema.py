"""JSON Schema of a pipeline file, for editors: its models, with the parameters of every component."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tactflow.config.models import WORD, PipelineFile
from tactflow.engine.graph import Component

Schema = dict[str, Any]

_OWN_CLASS = r"[:/]|\.py$"
"""What `use` may say beside the names that are known: a class in a file or a module."""


def pipeline_schema(components: Sequence[Component]) -> Schema:
    """JSON Schema (2020-12) of a pipeline file made of these components.

    `use` decides which parameters are allowed; without it, the id does. The parameters of a class of the
    user's own are not known and so not checked.

    >>> from tactflow.config.registry import available
    >>> sorted(pipeline_schema(available())["properties"])[:3]
    ['calibration', 'opencv_threads', 'realtime_priority']
    """
    schema = PipelineFile.model_json_schema()
    definitions: Schema = schema["$defs"]
    for section, entry in (("stages", "StageEntry"), ("sinks", "SinkEntry")):
        known = [c for c in components if (c.kind == "sink") == (section == "sinks")]
        common = definitions.pop(entry)["properties"]
        for component in known:
            _define(component, f"{section}.{component.name}", common, definitions)
        definitions[section] = _by_use(section, [c.name for c in known], common)
        about = schema["properties"][section]["description"]
        schema["properties"][section] = _by_id(section, [c.name for c in known]) | {"description": about}
    draft = "https://json-schema.org/draft/2020-12/schema"
    return {"$schema": draft, **schema, "title": "tactflow pipeline"}


def _define(component: Component, name: str, common: Schema, definitions: Schema) -> None:
    """Add what may stand under a component's id: its parameters, and what all have in common."""
    schema = component.params.model_json_schema(ref_template=f"#/$defs/{name}.{{model}}")
    for inner, definition in schema.pop("$defs", {}).items():
        definitions[f"{name}.{inner}"] = definition
    schema["properties"] = {**common, **schema.get("properties", {})}
    if not schema.get("required"):
        schema["type"] = ["object", "null"]
    summary = (component.cls.__doc__ or "").strip().partition("\n")[0]
    about = {"description": summary} if summary else {}
    definitions[name] = {**schema, "title": component.name, **about}


def _by_use(section: str, names: Sequence[str], common: Schema) -> Schema:
    """An entry that says what it is with `use`."""
    use = {"anyOf": [{"enum": names}, {"type": "string", "pattern": _OWN_CLASS}]}
    return {
        "type": "object",
        "required": ["use"],
        "properties": {**common, "use": use},
        "allOf": [
            {
                "if": {"properties": {"use": {"const": name}}, "required": ["use"]},
                "then": {"$ref": f"#/$defs/{section}.{name}"},
            }
            for name in names
        ],
    }


def _by_id(section: str, names: Sequence[str]) -> Schema:
    """A section, where an id may stand for the component of that name."""
    return {
        "type": ["object", "null"] if section == "sinks" else "object",
        "propertyNames": {"pattern": WORD},
        "properties": {
            name: {
                "if": {"type": "object", "required": ["use"]},
                "then": {"$ref": f"#/$defs/{section}"},
                "else": {"$ref": f"#/$defs/{section}.{name}"},
            }
            for name in names
        },
        "additionalProperties": {"$ref": f"#/$defs/{section}"},
    }
