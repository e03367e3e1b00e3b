"""`tactflow stages`: what a pipeline can be made of."""

from __future__ import annotations

import argparse
import inspect
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic.json_schema import GenerateJsonSchema

from tactflow.config.document import shown
from tactflow.config.models import is_word
from tactflow.config.registry import Section, catalogue, names, resolve
from tactflow.config.replacements import grouped, replacements
from tactflow.engine.conformance import declares
from tactflow.engine.errors import ConfigError
from tactflow.engine.graph import Component
from tactflow.engine.ports import Port, describe_type
from tactflow.system.spelling import did_you_mean
from tactflow.system.terminal import say, show, table

_TYPES = {"integer": "whole number", "string": "text", "boolean": "true | false", "object": "mapping"}
"""Type of JSON Schema -> how it is called here; others keep their names."""
_LIMITS = {"minimum": ">=", "exclusiveMinimum": ">", "maximum": "<=", "exclusiveMaximum": "<"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `stages`."""
    parser.add_argument(
        "name",
        nargs="?",
        metavar="NAME",
        help="explain this one: a built-in, a plug-in, module:Class or ./file.py:Class (its code is run)",
    )


def run(args: argparse.Namespace) -> int:
    """Print the table, or one component in full."""
    components, problems = ([_find(args.name)], []) if args.name is not None else catalogue()
    for problem in problems:
        say(f"tactflow: warning: {problem}")
    if args.name is not None:
        print("\n".join(details(components[0])))
        return 0
    heading = ("NAME", "KIND", "INPUTS", "OUTPUTS", "ORIGIN", "WHAT IT DOES")
    show(table([heading, *_rows(components)]))
    return 0


def details(component: Component) -> Iterator[str]:
    """Lines that explain one stage or sink: what it does, its ports, its parameters."""
    yield f"{component.name}: {component.kind}, {component.origin}"
    document = inspect.cleandoc(component.cls.__doc__ or "")
    if document:
        yield ""
        yield textwrap.indent(document, "  ")
    if component.kind == "stage":
        yield ""
        yield f"memory: {component.memory}"
        if others := [other.name for other in replacements(component)]:
            yield f"can be replaced by: {', '.join(others)}"
    if declares(component.cls):
        yield ""
        yield "inputs and outputs: as the parameters say"
    for title, ports in (("inputs", component.ports.inputs), ("outputs", component.ports.outputs)):
        if ports:
            yield ""
            yield f"{title}:"
            yield from (f"  {line}" for line in table([(port.name, _port_type(port)) for port in ports]))
    yield ""
    rows = list(_parameters(component.params))
    yield "parameters:" if rows else "parameters: none"
    for name, kind, field in rows:
        yield f"  {name}: {kind} {_default(field)}"
        yield from textwrap.wrap(
            field.description or "", 96, initial_indent=" " * 6, subsequent_indent=" " * 6
        )


def _find(name: str) -> Component:
    sections: tuple[Section, Section] = ("stages", "sinks")
    errors = []
    for section in sections:
        try:
            return resolve(name, section, Path())
        except ConfigError as error:
            if not is_word(name) or name in names(section):
                errors.append(error)
    if errors:
        # A class in a file is tried as a stage, then as a sink; the last error is reported.
        raise errors[-1]
    known = [*names("stages"), *names("sinks")]
    raise ConfigError(f"there is no stage or sink {name!r}{did_you_mean(name, known)}")


def _rows(components: Sequence[Component]) -> Iterator[Sequence[str]]:
    """A row for each; indented below a stage, those that can take its place."""
    for component, others in grouped(components):
        yield _row(component)
        yield from (_row(other, "  ") for other in others)


def _row(component: Component, indent: str = "") -> Sequence[str]:
    inputs = ", ".join(port.name + ("?" if port.optional else "") for port in component.ports.inputs)
    outputs = ", ".join(port.name for port in component.ports.outputs)
    paragraph = " ".join(inspect.cleandoc(component.cls.__doc__ or "").partition("\n\n")[0].split())
    summary = paragraph.partition(". ")[0].removesuffix(".") + "." if paragraph else ""
    return indent + component.name, component.kind, inputs, outputs, component.origin, summary


def _port_type(port: Port) -> str:
    text = describe_type(port.annotation)
    return f"{text} (may be absent)" if port.optional else text


def _parameters(model: type[BaseModel], prefix: str = "") -> Iterator[tuple[str, str, FieldInfo]]:
    """(name, type in words, field) of every parameter; those of nested models with a dot."""
    schema = model.model_json_schema(schema_generator=_AnySchema)
    for key, field in model.model_fields.items():
        name = field.alias or key
        yield prefix + name, _kind(schema["properties"][name], schema.get("$defs", {})), field
        for member in (field.annotation, *get_args(field.annotation)):
            if isinstance(member, type) and issubclass(member, BaseModel):
                yield from _parameters(member, f"{prefix}{name}.")


class _AnySchema(GenerateJsonSchema):
    """A parameter of a type that JSON Schema cannot express takes any value."""

    def handle_invalid_for_json_schema(self, *_: object) -> dict[str, Any]:
        return {}


def _kind(schema: Mapping[str, Any], definitions: Mapping[str, Any]) -> str:
    """A part of a JSON Schema in words."""
    if "$ref" in schema:
        return _kind(definitions[schema["$ref"].rpartition("/")[2]], definitions)
    if "anyOf" in schema:
        return " or ".join(_kind(part, definitions) for part in schema["anyOf"])
    if "enum" in schema or "const" in schema:
        return " | ".join(map(str, schema.get("enum", [schema.get("const")])))
    if "prefixItems" in schema:
        return f"[{', '.join(_kind(part, definitions) for part in schema['prefixItems'])}]"
    if "items" in schema:
        return f"list of {_kind(schema['items'], definitions)}"
    if schema.get("format") == "path":
        return "path"
    kind = schema.get("type", "any value")
    limits = [f"{sign} {schema[limit]:g}" for limit, sign in _LIMITS.items() if limit in schema]
    return ", ".join([_TYPES.get(kind, kind), *limits])


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return "(required)"
    value = field.get_default(call_default_factory=True, validated_data={})
    if isinstance(value, BaseModel):
        return "= {...}"
    return "= null" if value is None else f"= {shown(value)}"
