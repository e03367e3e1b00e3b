"""JSON Schema of a pipeline file for editors, including the parameters of every component."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tactflow.config.models import PipelineFile
from tactflow.engine.graph import Component


def pipeline_schema(components: Sequence[Component]) -> dict[str, Any]:
    """JSON Schema (2020-12) of a pipeline file.

    Parameters are validated if the id names a component; with `use:`, any are allowed.

    >>> from tactflow.config.registry import catalogue
    >>> sorted(pipeline_schema(catalogue()[0])["properties"])[:3]
    ['calibration', 'gel', 'opencv_threads']
    """
    schema = PipelineFile.model_json_schema()
    definitions = schema["$defs"]
    for entry in ("StageEntry", "SinkEntry", "Gel"):
        definitions[entry]["type"] = ["object", "null"]
    for component in components:
        section, entry = ("sinks", "SinkEntry") if component.kind == "sink" else ("stages", "StageEntry")
        name = f"{section}.{component.name}"
        params = component.params.model_json_schema(ref_template=f"#/$defs/{name}.{{model}}")
        definitions |= {f"{name}.{inner}": part for inner, part in params.pop("$defs", {}).items()}
        params["properties"] = {**definitions[entry]["properties"], **params.get("properties", {})}
        params["type"] = "object" if params.get("required") else ["object", "null"]
        definitions[name] = params | {"description": (component.cls.__doc__ or "").partition("\n")[0]}
        schema["properties"][section].setdefault("properties", {})[component.name] = {
            "if": {"type": "object", "required": ["use"]},
            "then": {"$ref": f"#/$defs/{entry}"},
            "else": {"$ref": f"#/$defs/{name}"},
        }
    schema["properties"]["sinks"]["type"] = ["object", "null"]
    for key in ("stages", "sinks", "sensors"):
        schema["properties"][key]["additionalProperties"] = False
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema, "title": "tactflow pipeline"}
