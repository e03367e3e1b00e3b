"""Turns what pydantic finds wrong with a part of a file into plain words at its place."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, get_args

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from tactflow.config.yamlmap import Item, Problems, shown, wrap
from tactflow.engine.contract import StageParams
from tactflow.engine.graph import Mark
from tactflow.system.spelling import closest, did_you_mean

_EXPECTED = {
    "int_type": "a whole number",
    "int_parsing": "a whole number",
    "int_from_float": "a whole number",
    "float_type": "a number",
    "float_parsing": "a number",
    "finite_number": "a finite number",
    "bool_type": "true or false",
    "bool_parsing": "true or false",
    "string_type": "text",
    "path_type": "a path",
    "list_type": "a list",
    "tuple_type": "a list",
    "set_type": "a list",
    "frozen_set_type": "a list",
    "dict_type": "a mapping",
    "mapping_type": "a mapping",
    "model_type": "a mapping",
    "model_attributes_type": "a mapping",
    "dataclass_type": "a mapping",
    "none_required": "null",
    "greater_than": "a number > {gt}",
    "greater_than_equal": "a number >= {ge}",
    "less_than": "a number < {lt}",
    "less_than_equal": "a number <= {le}",
    "multiple_of": "a multiple of {multiple_of}",
    "literal_error": "{expected}",
    "enum": "{expected}",
    "string_pattern_mismatch": "text that matches {pattern}",
    "string_too_short": "text of at least {min_length} characters",
    "string_too_long": "text of at most {max_length} characters",
    "too_short": "at least {min_length} items",
    "too_long": "at most {max_length} items",
}

_QUOTED = re.compile("'([A-Za-z_][A-Za-z0-9_-]*)'")

_MANY = 1000
"""Mistakes in a member of a union that was not meant at all; more than a member that was meant may have."""


@dataclass(slots=True)
class _Spot:
    """Where an error belongs: the value (None if it is not in the file), its key's place, and its name.

    union : where a union was tried on the way, and which member of it; None without a union.
    inside : True if the error is about a part of that member, so that the member as such was meant.
    """

    item: Item | None
    mark: Mark
    key_mark: Mark
    path: str
    union: tuple[str, str] | None = None
    inside: bool = False


def validated(model: type[StageParams], values: Mapping[str, Any], name: str, *, origin: str) -> StageParams:
    """The parameters that a program gives a stage or sink, as its own model.

    name : what a message calls the stage. origin : what it begins with, in place of file, line and column.

    Raises
    ------
    ConfigError : every mistake in the values.
    """
    try:
        return model.model_validate(values)
    except ValidationError as error:
        problems = Problems()
        complain(error, model, wrap(values, Mark(origin, 0, 0)), name, problems, noun="parameter")
        problems.raise_if_any()
        raise


def complain(
    error: ValidationError,
    model: type[BaseModel],
    item: Item,
    path: str,
    problems: Problems,
    *,
    noun: str = "key",
    other_keys: Sequence[str] = (),
    advice: Mapping[str, str] | None = None,
) -> None:
    """Report each error of a validation at its own value.

    model : what was validated. item : the mapping it was read from. path : its name, "" for a whole file.
    noun : what a key of the mapping is called. other_keys : keys that may stand beside those of the model.
    advice : unknown key -> what to say about it in place of a suggestion.
    """
    found = [(detail, _spot(item, path, detail)) for detail in error.errors(include_url=False)]
    # A union of scalars reports one error per member; together they are one mistake.
    groups: dict[tuple[Mark, str], list[tuple[ErrorDetails, _Spot]]] = {}
    for detail, spot in _meant(found):
        groups.setdefault((spot.mark, spot.path), []).append((detail, spot))
    for (mark, name), members in groups.items():
        detail, spot = members[0]
        loc = detail["loc"]
        if detail["type"] == "extra_forbidden":
            known = [*_fields(model, loc[:-1]), *(other_keys if len(loc) == 1 else ())]
            key = str(loc[-1])
            hint = (advice or {}).get(key) or did_you_mean(key, known, "there are ")
            problems.add(spot.key_mark, f"{name}: unknown {noun}{hint}")
        else:
            field = _fields(model, loc[:-1]).get(str(loc[-1])) if detail["type"] == "missing" else None
            about = f" ({field.description})" if field and field.description else ""
            place = spot.key_mark if loc[-1:] == ("[key]",) else mark
            problems.add(place, f"{name}: {_words(members)}{about}")


def _meant(found: list[tuple[ErrorDetails, _Spot]]) -> list[tuple[ErrorDetails, _Spot]]:
    """Leave out the members of unions that fit worse: another kind of value, more missing or unknown keys."""
    misfit: dict[tuple[str, str], int] = {}
    for detail, spot in found:
        if spot.union is not None:
            keys = int(detail["type"] in ("missing", "extra_forbidden"))
            misfit[spot.union] = misfit.get(spot.union, 0) + (keys if spot.inside else _MANY)
    least = {place: min(n for (where, _), n in misfit.items() if where == place) for place, _ in misfit}
    return [
        (detail, spot)
        for detail, spot in found
        if spot.union is None or misfit[spot.union] == least[spot.union[0]]
    ]


def _spot(item: Item, path: str, detail: ErrorDetails) -> _Spot:
    spot = _Spot(item, item.mark, item.mark, path)
    union: tuple[str, str] | None = None
    inside = False
    last = len(detail["loc"]) - 1
    for index, part in enumerate(detail["loc"]):
        content = spot.item.content if spot.item is not None else None
        if isinstance(content, dict) and part in content:
            entry = content[part]
            spot = _Spot(entry.item, entry.item.mark, entry.mark, _joined(spot.path, part))
            inside = union is not None
        elif isinstance(content, list) and isinstance(part, int) and part < len(content):
            inner = content[part]
            spot = _Spot(inner, inner.mark, inner.mark, _joined(spot.path, part))
            inside = union is not None
        elif index == 0 or (index == last and detail["type"] == "missing"):
            spot = _Spot(None, spot.mark, spot.key_mark, _joined(spot.path, part))
            inside = union is not None
        elif union is None:
            # Not part of the file: the name of the member of a union that was tried.
            union = (spot.path, str(part))
    spot.union, spot.inside = union, inside
    return spot


def _joined(path: str, part: int | str) -> str:
    return f"{path}.{part}" if path else str(part)


def _words(members: Sequence[tuple[ErrorDetails, _Spot]]) -> str:
    expected: list[str] = []
    for detail, spot in members:
        kind, context = detail["type"], detail.get("ctx", {})
        if kind == "missing":
            if spot.item is None and isinstance(detail["loc"][-1], int):
                return "this item of the list is missing"
            return "required, but not given"
        if kind in ("value_error", "assertion_error"):
            return str(context.get("error")) or "not accepted"
        if kind == "expected":
            expected.append(detail["msg"])
        elif kind in _EXPECTED:
            words = _EXPECTED[kind].format_map(_Numbers(context))
            # Choices are written as in YAML.
            expected.append(_QUOTED.sub(r"\1", words) if kind in ("literal_error", "enum") else words)
        else:
            message = detail["msg"]
            return f"{message[0].lower()}{message[1:]}, got {_got(members[0])}"
    text = f"expected {' or '.join(dict.fromkeys(expected))}, got {_got(members[0])}"
    value = members[0][0]["input"]
    choices = [name for detail, _ in members for name in _choices(detail)]
    guess = closest(value, choices) if isinstance(value, str) else None
    return f"{text}; did you mean {guess}?" if guess else text


class _Numbers(dict[str, Any]):
    """Context of an error in which 5.0 is written 5."""

    def __init__(self, context: Mapping[str, Any]) -> None:
        super().__init__({k: f"{v:g}" if isinstance(v, float) else v for k, v in context.items()})


def _got(member: tuple[ErrorDetails, _Spot]) -> str:
    detail, spot = member
    if detail["type"] in ("too_short", "too_long"):
        return str(detail["ctx"]["actual_length"])
    return spot.item.words() if spot.item is not None else shown(detail["input"])


def _choices(detail: ErrorDetails) -> list[str]:
    if detail["type"] not in ("literal_error", "enum"):
        return []
    return [part.strip(" '") for part in str(detail["ctx"]["expected"]).replace(" or ", ",").split(",")]


def _fields(model: type[BaseModel], loc: Sequence[int | str]) -> dict[str, FieldInfo]:
    """The fields of the (nested) model at `loc`, by the names they have in a file."""
    choices: list[type[BaseModel]] = [model]
    for part in loc:
        named = [choice for choice in choices if choice.__name__ == part]
        fields = _named_fields(choices)
        if named:
            choices = named
        elif isinstance(part, str) and part in fields:
            choices = _models_in(fields[part].annotation)
    return _named_fields(choices)


def _named_fields(models: Sequence[type[BaseModel]]) -> dict[str, FieldInfo]:
    return {field.alias or key: field for model in models for key, field in model.model_fields.items()}


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for part in get_args(annotation) for model in _models_in(part)]
