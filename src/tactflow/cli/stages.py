"""`tactflow stages`: what a pipeline can be made of."""

from __future__ import annotations

import argparse
import inspect
import sys
import textwrap
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from tactflow.config.document import shown
from tactflow.config.models import is_word
from tactflow.config.registry import Section, catalogue, names, resolve
from tactflow.engine.errors import ConfigError
from tactflow.engine.graph import Component
from tactflow.engine.ports import Port, describe_type
from tactflow.system.spelling import did_you_mean

_LIMITS = {"ge": ">=", "gt": ">", "le": "<=", "lt": "<"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `stages`."""
    parser.add_argument(
        "name",
        nargs="?",
        metavar="NAME",
        help="explain one: a built-in, a plug-in, module:Class or ./file.py:Class, which is run",
    )


def run(args: argparse.Namespace) -> int:
    """Print the table, or one component in full."""
    if args.name is not None:
        print("\n".join(details(_find(args.name))))
        return 0
    components, problems = catalogue()
    for problem in problems:
        print(f"tactflow: warning: {problem}", file=sys.stderr)
    if sys.stdout.isatty():
        _print_table(components)
    else:
        print("\n".join(plain_table(components)))
    return 0


def plain_table(components: Sequence[Component]) -> Iterator[str]:
    """Lines of a table with aligned columns."""
    heading = ("NAME", "KIND", "INPUTS", "OUTPUTS", "ORIGIN", "WHAT IT DOES")
    rows = [heading, *(_row(component) for component in components)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        yield "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()


def details(component: Component) -> Iterator[str]:
    """Lines that explain one stage or sink: what it does, its ports, its parameters."""
    yield f"{component.name}: {component.kind}, {component.origin}"
    document = _document(component.cls)
    if document:
        yield ""
        yield textwrap.indent(document, "  ")
    if component.kind == "stage":
        yield ""
        yield f"memory: {component.memory}"
    for title, ports in (("inputs", component.ports.inputs), ("outputs", component.ports.outputs)):
        if ports:
            yield ""
            yield f"{title}:"
            yield from _aligned([(port.name, _port_type(port)) for port in ports])
    yield ""
    rows = list(_parameters(component.params))
    yield "parameters:" if rows else "parameters: none"
    for name, kind, default, description in rows:
        yield f"  {name}: {kind}{' (required)' if default is None else f' = {default}'}"
        yield from textwrap.wrap(description, 96, initial_indent="      ", subsequent_indent="      ")


def _find(name: str) -> Component:
    sections: tuple[Section, Section] = ("stages", "sinks")
    errors = []
    for section in sections:
        try:
            return resolve(name, section, Path())
        except ConfigError as error:
            if not is_word(name) or name in names(section):
                errors.append(error)
    known = [*names("stages"), *names("sinks")]
    # A class in a file is looked for as a stage, then as a sink; the last word is the one that counts.
    raise (
        errors[-1]
        if errors
        else ConfigError(f"there is no stage or sink {name!r}{did_you_mean(name, known)}")
    )


def _row(component: Component) -> tuple[str, str, str, str, str, str]:
    inputs = ", ".join(port.name + ("?" if port.optional else "") for port in component.ports.inputs)
    outputs = ", ".join(port.name for port in component.ports.outputs)
    summary = _document(component.cls).partition("\n")[0]
    return component.name, component.kind, inputs, outputs, component.origin, summary


def _print_table(components: Sequence[Component]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table("name", "inputs", "outputs", box=None, header_style="bold", pad_edge=False)
    table.add_column("what it does", overflow="fold")
    for component in components:
        name, _, inputs, outputs, origin, summary = _row(component)
        source = "" if origin == "built-in" else f" ({origin})"
        table.add_row(name, inputs, outputs, summary + source)
    Console(highlight=False).print(table)


def _document(cls: type) -> str:
    return inspect.cleandoc(cls.__doc__ or "")


def _port_type(port: Port) -> str:
    text = describe_type(port.annotation)
    return f"{text} (may be absent)" if port.optional else text


def _aligned(rows: Sequence[tuple[str, str]]) -> Iterator[str]:
    width = max(len(name) for name, _ in rows)
    for name, text in rows:
        yield f"  {name.ljust(width)}  {text}"


def _parameters(model: type[BaseModel], prefix: str = "") -> Iterator[tuple[str, str, str | None, str]]:
    """(name, type, default or None if required, description) of every parameter; nested ones with a dot."""
    for key, field in model.model_fields.items():
        name = prefix + (field.alias or key)
        yield name, _kind(field), _default(field), field.description or ""
        for member in _members(field.annotation):
            if isinstance(member, type) and issubclass(member, BaseModel):
                yield from _parameters(member, f"{name}.")


def _kind(field: FieldInfo) -> str:
    limits = [
        f"{sign} {getattr(item, name):g}"
        for item in field.metadata
        for name, sign in _LIMITS.items()
        if getattr(item, name, None) is not None
    ]
    return ", ".join([_type_words(field.annotation), *limits])


def _type_words(annotation: Any) -> str:
    origin, args = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return _type_words(args[0])
    if origin in (Union, UnionType):
        return " or ".join(_type_words(member) for member in _members(annotation))
    if origin is Literal:
        return " | ".join(str(value) for value in args)
    if origin is tuple:
        return f"[{', '.join('...' if arg is Ellipsis else _type_words(arg) for arg in args)}]"
    if origin in (list, set, frozenset) or (
        args and isinstance(origin, type) and issubclass(origin, Sequence)
    ):
        return f"list of {_type_words(args[0])}"
    if annotation is NoneType:
        return "null"
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return "mapping"
    plain = {int: "whole number", float: "number", str: "text", bool: "true | false", Path: "path"}
    return plain.get(annotation, getattr(annotation, "__name__", str(annotation)))


def _members(annotation: Any) -> tuple[Any, ...]:
    return get_args(annotation) if get_origin(annotation) in (Union, UnionType) else (annotation,)


def _default(field: FieldInfo) -> str | None:
    if field.is_required():
        return None
    value = field.get_default(call_default_factory=True, validated_data={})
    if value is PydanticUndefined:
        return None
    return "null" if value is None else "{...}" if isinstance(value, BaseModel) else shown(value)
