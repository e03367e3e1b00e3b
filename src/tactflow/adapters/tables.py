"""Result messages as tables: what the JSON Schema of the message says, one column for each value.

A message becomes a row of `frames`, a row of `contacts` for each separate contact, and a row of `markers` for
each dot. Every table has the same columns whatever a pipeline computes, so that tables of several runs can
be put below each other; what a message lacks is null.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from itertools import chain
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from tactflow.message.schema import message_schema

if TYPE_CHECKING:
    import pyarrow as pa  # type: ignore[import-untyped]

APART = ("schema", "contacts", "markers", "field")
"""Keys of a message that are no columns of `frames`: the first is always the same, two have tables of their
own. A displacement field has thousands of numbers a frame; who needs it reads the JSON lines."""
PAIRS = {"size": ("width", "height"), "axes": ("major", "minor"), "shear": ("1", "2"), "shear_mm": ("1", "2")}
"""What the parts of a pair are called that are not x and y."""
XYZ = ("x", "y", "z")


class Column(NamedTuple):
    """One column of a table.

    name : `contact_center_x`. path : keys and indices that lead to the value in a message.
    kind : number, integer, string, boolean, points (a list of pairs) or words (name -> text).
    description : for people.
    """

    name: str
    path: tuple[str | int, ...]
    kind: str
    description: str

    def value(self, message: Mapping[str, Any]) -> Any:
        """What a message has here, or None."""
        value: Any = message
        for key in self.path:
            value = value.get(key) if isinstance(key, str) else value[key]
            if value is None:
                return None
        return list(value.items()) if self.kind == "words" else value


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
"""Of the table `markers`, behind `seq`."""


@cache
def frame_columns() -> Sequence[Column]:
    """The columns of `frames`, in the order of the message.

    >>> [column.name for column in frame_columns()][:6]
    ['sensor', 'seq', 't', 'size_width', 'size_height', 'contact_area']
    """
    schema = message_schema()
    kept = {key: part for key, part in schema["properties"].items() if key not in APART}
    return tuple(_columns({"properties": kept, "type": "object"}, schema["$defs"], (), ()))


@cache
def contact_columns() -> Sequence[Column]:
    """The columns of `contacts` that describe one contact.

    >>> [column.name for column in contact_columns()][:3]
    ['area', 'center_x', 'center_y']
    """
    schema = message_schema()
    one = schema["properties"]["contacts"]["items"]
    return tuple(_columns(one, schema["$defs"], (), ()))


def _columns(
    part: Mapping[str, Any], defs: Mapping[str, Any], names: tuple[str, ...], path: tuple[str | int, ...]
) -> Iterator[Column]:
    """The columns of one part of the schema, which stands at `path` and is called `names`."""
    described = part.get("description", "")
    choices = [choice for choice in part.get("anyOf", [part]) if choice.get("type") != "null"]
    part = choices[0]
    if "$ref" in part:
        part = defs[part["$ref"].rsplit("/", 1)[1]]
    name, kind = "_".join(names), part.get("type", "string")
    if "properties" in part:
        for key, inner in part["properties"].items():
            yield from _columns(inner, defs, (*names, key), (*path, key))
    elif "prefixItems" in part:
        suffixes = PAIRS.get(names[-1], XYZ)
        for index, inner in enumerate(part["prefixItems"]):
            suffix = suffixes[index] if index < len(suffixes) else str(index + 1)
            yield Column(f"{name}_{suffix}", (*path, index), inner.get("type", "number"), described)
    else:
        kind = {"array": "points", "object": "words"}.get(kind, kind)
        yield Column(name, path, kind, described)


class Tables:
    """Collects messages and gives them as Arrow tables.

    facts : name -> text, kept as the metadata of every table.

    >>> Tables({}).schemas["markers"].names[:4]
    ['seq', 'marker', 'x', 'y']
    """

    def __init__(self, facts: Mapping[str, str]) -> None:
        import pyarrow as pa

        self._frames, self._contacts = frame_columns(), contact_columns()
        seq = Column("seq", ("seq",), "integer", "the frame's seq in the table frames")
        contact = Column("contact", (), "integer", "0 is the contact with the most pixels")
        columns = {
            "frames": self._frames,
            "contacts": [seq, contact, *self._contacts],
            "markers": [seq, *MARKER_COLUMNS],
        }
        about = dict(facts)
        self.schemas = {name: pa.schema(map(_field, of), metadata=about) for name, of in columns.items()}
        """The Arrow schema of each table."""

    def build(self, messages: Sequence[Mapping[str, Any]]) -> dict[str, pa.Table]:
        """Put messages into tables.

        Parameters
        ----------
        messages : parsed result messages.

        Returns
        -------
        tables : `contacts`, `markers` and `frames`.
        """
        import pyarrow as pa

        rows = {
            "contacts": [
                {"seq": message["seq"], "contact": index}
                | {column.name: column.value(contact) for column in self._contacts}
                for message in messages
                for index, contact in enumerate(message["contacts"])
            ],
            "frames": [{c.name: c.value(message) for c in self._frames} for message in messages],
        }
        tables = {name: pa.Table.from_pylist(rows[name], self.schemas[name]) for name in rows}
        return tables | {"markers": self._markers(messages)}

    def _markers(self, messages: Sequence[Mapping[str, Any]]) -> pa.Table:
        import pyarrow as pa

        seqs, found = [], []
        for message in messages:
            if message["markers"] is not None and message["markers"]["position"]:
                seqs.append(message["seq"])
                found.append(message["markers"])
        counts = [len(markers["position"]) for markers in found]
        position, origin = (
            np.concatenate([np.empty((0, 2)), *(np.array(markers[key]) for markers in found)])
            for key in ("position", "origin")
        )
        unknown = [None] * max(counts, default=0)
        stderr = [m.get("stderr", unknown[:count]) for m, count in zip(found, counts, strict=True)]
        columns = [
            np.repeat(np.array(seqs, np.int64), counts),
            np.concatenate([np.empty(0, np.int64), *(np.arange(count) for count in counts)]),
            *position.T,
            *(position - origin).T,
            *origin.T,
            list(chain.from_iterable(markers["status"] for markers in found)),
            list(chain.from_iterable(stderr)),
        ]
        schema = self.schemas["markers"]
        arrays = [pa.array(column, field.type) for column, field in zip(columns, schema, strict=True)]
        return pa.Table.from_arrays(arrays, schema=schema)


def _field(column: Column) -> pa.Field:
    import pyarrow as pa

    kinds = {
        "number": pa.float64(),
        "integer": pa.int64(),
        "boolean": pa.bool_(),
        "points": pa.list_(pa.list_(pa.float64())),
        "words": pa.map_(pa.string(), pa.string()),
    }
    return pa.field(
        column.name, kinds.get(column.kind, pa.string()), metadata={"description": column.description}
    )
