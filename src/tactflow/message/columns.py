"""Result messages as rows of tables, with columns derived from the description of the message.

All tables have the same columns, whatever the pipeline computes, so that tables of several runs can be
concatenated; values missing in a message are null.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import cache
from itertools import repeat
from typing import Any, NamedTuple

from tactflow.message.fields import Markers, Message, Part, SeparateContact
from tactflow.message.schema import message_schema, resolved

KEYS_WITHOUT_COLUMN = ("schema", "contacts", "markers", "field")
"""Keys without a column in `frames`: the first is constant, two have their own tables, and a displacement
field has thousands of numbers per frame."""
AXIS_NAMES = ("x", "y", "z")
"""Names of the elements of a tuple that the description does not name."""


class Column(NamedTuple):
    """A column of a table.

    Attributes
    ----------
    name : such as `contact_center_x`.
    path : keys and indices of the value in a message.
    kind : number, integer, string, boolean, numbers, points (a list of pairs) or words (name -> text).
    description : with unit.
    unit : of the numbers; empty without one.
    detail : whether only detailed messages have it.
    """

    name: str
    path: tuple[str | int, ...]
    kind: str
    description: str
    unit: str = ""
    detail: bool = False

    def value(self, message: Mapping[str, Any]) -> Any:
        """The value in a message, or None."""
        value: Any = message
        for key in self.path:
            value = value.get(key) if isinstance(key, str) else value[key]
            if value is None:
                return None
        return list(value.items()) if self.kind == "words" else value

    @property
    def heading(self) -> str:
        """The name as in the message, with the unit, such as `contact.center.x [px]`."""
        words = [key for key in self.path if isinstance(key, str)]
        if len(words) < len(self.path):
            words.append(self.name.removeprefix("_".join(words) + "_"))
        return ".".join(words) + (f" [{self.unit}]" if self.unit else "")


@cache
def frame_columns() -> Sequence[Column]:
    """The columns of `frames`, in the order of the message.

    >>> [column.name for column in frame_columns()][:6]
    ['sensor', 'seq', 't', 'size_width', 'size_height', 'contact_area']
    """
    return tuple(column for column in _columns(Message) if column.path[0] not in KEYS_WITHOUT_COLUMN)


@cache
def contact_columns() -> Sequence[Column]:
    """The columns of `contacts` that describe one contact.

    >>> [column.name for column in contact_columns()][:3]
    ['area', 'center_x', 'center_y']
    """
    return tuple(_columns(SeparateContact))


@cache
def marker_columns() -> Sequence[Column]:
    """The columns of `markers`: index, position, displacement and origin of a marker, then its other keys.

    >>> [column.name for column in marker_columns()][-4:]
    ['origin_y', 'status', 'probability', 'stderr']
    """
    places = (("", "position now"), ("d", "displacement"), ("origin_", "position in the reference frame"))
    return (
        Column("marker", (), "integer", "the same physical marker for the whole run"),
        *(
            Column(f"{name}{axis}", (), "number", f"{about}, px", "px")
            for name, about in places
            for axis in "xy"
        ),
        *(
            column._replace(kind="number" if column.kind == "numbers" else "string")
            for column in _columns(Markers)
            if column.name not in ("origin", "position")
        ),
    )


def marker_rows(markers: Mapping[str, Any] | None) -> Iterator[tuple[Any, ...]]:
    """The row of each marker. markers : of a message.

    >>> next(marker_rows({"origin": [[1.0, 2.0]], "position": [[1.5, 2.0]], "status": ["tracked"]}))
    (0, 1.5, 2.0, 0.5, 0.0, 1.0, 2.0, 'tracked', None, None)
    """
    if markers is None:
        return
    lists = (markers.get(column.name) or repeat(None) for column in marker_columns()[7:])
    for index, ((x, y), (origin_x, origin_y), *others) in enumerate(
        zip(markers["position"], markers["origin"], *lists, strict=False)
    ):
        yield index, x, y, x - origin_x, y - origin_y, origin_x, origin_y, *others


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
        and (detail or not column.detail)
    ]


def _columns(part: type[Part], path: tuple[str, ...] = ()) -> Iterator[Column]:
    """The columns of a part of the message. path : its keys."""
    schema = message_schema()
    properties = (schema if part is Message else schema["$defs"][part.__name__])["properties"]
    for key in part.all_keys():
        place = (*path, key.name)
        form = resolved(properties[key.name], schema["$defs"])
        about = form["description"], key.sending.unit, "detail" in key.sending.needs
        if key.part is not None:
            yield from _columns(key.part, place)
        elif "prefixItems" in form:
            names = (*key.sending.elements, *AXIS_NAMES[len(key.sending.elements) :])
            for index, element in enumerate(form["prefixItems"]):
                suffix = names[index] if index < len(names) else str(index + 1)
                kind = element.get("type", "number")
                yield Column("_".join((*place, suffix)), (*place, index), kind, *about)
        else:
            yield Column("_".join(place), place, _kind(form), *about)


def _kind(form: Mapping[str, Any]) -> str:
    """The kind of a column for values with this JSON Schema."""
    if form["type"] == "array":
        return "numbers" if resolved(form["items"], {}).get("type") == "number" else "points"
    return "words" if form["type"] == "object" else str(form["type"])
