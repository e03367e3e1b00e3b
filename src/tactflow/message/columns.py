"""Result messages as rows of tables, with columns derived from the JSON Schema of the message.

All tables have the same columns, whatever the pipeline computes, so that tables of several runs can be
concatenated; values missing in a message are null.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import cache
from typing import Any, NamedTuple

from tactflow.message.schema import message_schema, resolved

LEFT_OUT = ("schema", "contacts", "markers", "field")
"""Keys without a column in `frames`: the first is constant, two have their own tables, and a displacement
field has thousands of numbers per frame."""
PAIRS = {"size": ("width", "height"), "axes": ("major", "minor"), "shear": ("1", "2"), "shear_mm": ("1", "2")}
"""Pair -> names of its parts, if not x and y."""
XYZ = ("x", "y", "z")
UNIT = re.compile(r"(?:^|, )(px(?:\^2|/s)?|mm(?:\^[23]|/s| per px)?|degrees|s|N)(?=[;:, ]|$)")
"""Unit in a description, which is its first words or stands behind a comma."""


class Column(NamedTuple):
    """A column of a table.

    name : such as `contact_center_x`. path : keys and indices of the value in a message.
    kind : number, integer, string, boolean, numbers, points (a list of pairs) or words (name -> text).
    description : with unit.
    """

    name: str
    path: tuple[str | int, ...]
    kind: str
    description: str

    def value(self, message: Mapping[str, Any]) -> Any:
        """The value in a message, or None."""
        value: Any = message
        for key in self.path:
            value = value.get(key) if isinstance(key, str) else value[key]
            if value is None:
                return None
        return list(value.items()) if self.kind == "words" else value

    @property
    def unit(self) -> str:
        """The unit that the description names; empty without one, or where parts of it differ.

        >>> Column("t", ("t",), "number", "capture time, s: from the start").unit
        's'
        """
        units = set(UNIT.findall(self.description))
        return units.pop() if len(units) == 1 else ""

    @property
    def heading(self) -> str:
        """The name as in the message, with the unit, such as `contact.center.x [px]`."""
        words = [key for key in self.path if isinstance(key, str)]
        if len(words) < len(self.path):
            words.append(self.name.removeprefix("_".join(words) + "_"))
        return ".".join(words) + (f" [{self.unit}]" if self.unit else "")


MARKER_COLUMNS = (
    Column("marker", (), "integer", "the same physical marker for the whole run"),
    Column("x", (), "number", "position now, px"),
    Column("y", (), "number", "position now, px"),
    Column("dx", (), "number", "displacement since the reference, px"),
    Column("dy", (), "number", "displacement since the reference, px"),
    Column("origin_x", (), "number", "position in the reference frame, px"),
    Column("origin_y", (), "number", "position in the reference frame, px"),
    Column("status", (), "string", "tracked, inferred or lost"),
    Column("stderr", (), "number", "standard error of the position, px; null when unknown"),
)
"""Columns of the table `markers`, after `seq`."""


@cache
def frame_columns() -> Sequence[Column]:
    """The columns of `frames`, in the order of the message.

    >>> [column.name for column in frame_columns()][:6]
    ['sensor', 'seq', 't', 'size_width', 'size_height', 'contact_area']
    """
    schema = message_schema()
    kept = {key: part for key, part in schema["properties"].items() if key not in LEFT_OUT}
    return tuple(_columns({"properties": kept, "type": "object"}, schema["$defs"], (), ()))


@cache
def contact_columns() -> Sequence[Column]:
    """The columns of `contacts` that describe one contact.

    >>> [column.name for column in contact_columns()][:3]
    ['area', 'center_x', 'center_y']
    """
    schema = message_schema()
    return tuple(_columns(schema["properties"]["contacts"]["items"], schema["$defs"], (), ()))


def scalar_columns(ports: Collection[str] | None = None, *, detail: bool = True) -> Sequence[Column]:
    """The columns of `frames` that hold a number or a word; `skipped` counts as one.

    ports : outputs of the stages that run; leaves out parts of the message that need another port. None: all.
    detail : include the columns of detailed messages.

    >>> [column.heading for column in scalar_columns((), detail=False)][5:8]
    ['contact.area [px^2]', 'contact.center.x [px]', 'contact.center.y [px]']
    """
    always = message_schema()["required"]
    return [
        column
        for column in frame_columns()
        if column.kind not in ("numbers", "points")
        and (ports is None or column.path[0] in ports or column.path[0] in always)
        and (detail or not column.description.endswith("detail)"))
    ]


def _columns(
    part: Mapping[str, Any], defs: Mapping[str, Any], names: tuple[str, ...], path: tuple[str | int, ...]
) -> Iterator[Column]:
    """The columns of a part of the schema; names, path : its location, as words and as keys."""
    part = resolved(part, defs)
    description = part.get("description", "")
    name, kind = "_".join(names), part.get("type", "string")
    if "properties" in part:
        for key, inner in part["properties"].items():
            yield from _columns(inner, defs, (*names, key), (*path, key))
    elif "prefixItems" in part:
        suffixes = PAIRS.get(names[-1], XYZ)
        for index, inner in enumerate(part["prefixItems"]):
            suffix = suffixes[index] if index < len(suffixes) else str(index + 1)
            yield Column(f"{name}_{suffix}", (*path, index), inner.get("type", "number"), description)
    else:
        kind = {"array": "points", "object": "words"}.get(kind, kind)
        if part.get("items", {}).get("type") == "number":
            kind = "numbers"
        yield Column(name, path, kind, description)
