"""Validates values with pydantic, and reports every error at its location in the document."""

from __future__ import annotations

import inspect
import json
import re
from collections.abc import Collection, Mapping, Sequence
from typing import Annotated, Any, TypeVar, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from tactflow.config.document import Document, Keys, described, dotted, shown
from tactflow.config.models import WORD
from tactflow.engine.contract import StageParams
from tactflow.system.spelling import closest, did_you_mean

Model = TypeVar("Model", bound=BaseModel)

_YAML_TERMS = {
    r"^(Input|String|List|Tuple|Dictionary) (?=should )": "",
    r"\ban? (valid )?(object|dictionary)\b": "a mapping",
    r"\ba valid array\b": "a list",
    r" after validation": "",
    rf"match pattern '{re.escape(WORD)}'": "be a word of letters, digits, _ and -",
}
"""Pydantic's wording -> the terms of YAML."""
_WITHOUT_VALUE = ("missing", "extra_forbidden", "value_error", "assertion_error", "too_short", "too_long")
"""Types of errors whose message does not show the value."""


def validate(
    model: type[Model],
    document: Document,
    keys: Keys = (),
    *,
    without: Collection[str] = (),
    defaults: Keys = (),
    noun: str = "key",
) -> Model | None:
    """The mapping at `keys` as its model; None if it has errors, which are recorded.

    without : keys of the mapping that do not belong to the model. defaults : path of a mapping whose values
    are used for keys of the model that are not given. noun : for its keys, in messages.
    """
    shared = document.mapping(*defaults) if defaults else {}
    values = {key: shared[key] for key in model.model_fields.keys() & shared if shared[key] is not None}
    values |= {key: value for key, value in document.mapping(*keys).items() if key not in without}
    try:
        # Pydantic's strict rules for JSON suit YAML: a list may become a tuple, but text and booleans never
        # become numbers.
        return model.model_validate_json(json.dumps(values), strict=True)
    except ValidationError as error:
        report(error, model, document, keys, also=without, defaults=defaults, noun=noun)
        return None


def validated(model: type[StageParams], values: Mapping[str, Any], name: str, *, origin: str) -> StageParams:
    """Validate parameters from Python.

    name : of the stage or sink, for messages. origin : stands for file, line and column in messages.

    Raises
    ------
    ConfigError : all errors in the values.
    """
    try:
        return model.model_validate(values)
    except ValidationError as error:
        document = Document(origin, {name: dict(values)})
        report(error, model, document, (name,), noun="parameter")
        document.raise_if_mistaken()
        raise


def report(
    error: ValidationError,
    model: type[BaseModel],
    document: Document,
    keys: Keys,
    *,
    also: Collection[str] = (),
    defaults: Keys = (),
    noun: str = "key",
) -> None:
    """Record each error at its value; those of a union together.

    keys : path of the validated mapping. also : its valid keys besides those of the model. defaults : path of
    the mapping with values that are not in it.
    """
    groups: dict[Keys, list[ErrorDetails]] = {}
    for detail in error.errors(include_url=False):
        name = detail["loc"][0] if detail["loc"] else None
        is_default = name in document.mapping(*defaults) and name not in document.mapping(*keys)
        place, rest = _place(document, defaults if defaults and is_default else keys, detail)
        kind, name = detail["type"], str(place[-1]) if place else ""
        named = _fields(model, place[len(keys) : -1])
        if kind == "missing" and not rest:
            about = named[name].description if name in named else None
            message = _message(detail) + (f" ({about})" if about else "")
            document.report_at(document.mark(*place[:-1]), f"{dotted(place)}: {message}")
        elif kind == "extra_forbidden" and not rest:
            known = [*named, *sorted(also)] if len(place) == len(keys) + 1 else [*named]
            hint = did_you_mean(name, known, "there are ") if known else ""
            document.report(place, f"unknown {noun}{hint}")
        elif rest == ("[key]",):
            document.report(place, f"{_message(detail)}, got {shown(name)}")
        else:
            groups.setdefault(place, []).append(detail)
    for place, details in groups.items():
        document.report(place, _words(details, document.get(*place)))


def _fields(model: type[BaseModel], path: Keys) -> dict[str, FieldInfo]:
    """The fields of the model at a path within a model; empty where there is none."""
    kind: Any = model
    for key in path:
        if get_origin(kind) is dict:
            kind = get_args(kind)[1]
        else:
            field = _fields(kind, ()).get(str(key))
            kind = None if field is None else field.annotation
        if get_origin(kind) is Annotated:
            kind = get_args(kind)[0]
    is_model = inspect.isclass(kind) and issubclass(kind, BaseModel)
    return {field.alias or name: field for name, field in kind.model_fields.items()} if is_model else {}


def _place(document: Document, keys: Keys, detail: ErrorDetails) -> tuple[Keys, Keys]:
    """The path of the invalid value, and the rest of the error's location: the member of a union, and the
    part of it."""
    place, rest = keys, list(detail["loc"])
    while rest:
        value = document.get(*place)
        if rest[0] not in (range(len(value)) if isinstance(value, list) else document.mapping(*place)):
            break
        place = (*place, rest.pop(0))
    if detail["type"] == "missing" and len(rest) == 1:
        place = (*place, rest.pop())
    return place, tuple(rest)


def _words(details: Sequence[ErrorDetails], value: Any) -> str:
    """One message for the errors of a value; a union has one for each of its members."""
    choices, got = [], ""
    for detail in details:
        if detail["type"] == "literal_error":
            choices += re.findall("'([^']*)'", detail["ctx"]["expected"])
        if detail["type"] not in _WITHOUT_VALUE:
            got = f", got {described(value)}"
    first, *more = dict.fromkeys(map(_message, details))
    text = " or ".join([first, *(alternative.removeprefix("should be ") for alternative in more)]) + got
    guess = closest(value, choices) if isinstance(value, str) else None
    return f"{text}; did you mean {guess}?" if guess else text


def _message(detail: ErrorDetails) -> str:
    """Pydantic's message in the terms of YAML."""
    if detail["type"] == "missing":
        return "required, but not given"
    if detail["type"] == "extra_forbidden":
        return "unknown key"
    if detail["type"] in ("value_error", "assertion_error"):
        return str(detail["ctx"]["error"])
    text = detail["msg"]
    for pattern, words in _YAML_TERMS.items():
        text = re.sub(pattern, words, text)
    return text[0].lower() + text[1:]
