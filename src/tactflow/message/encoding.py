"""Encoding of results as dicts, lists and arrays, which `orjson` writes as the message `tactflow.frame/1`.

Numbers have full precision: the shortest decimal that reads back as the same double.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
import orjson

from tactflow.message.fields import CONDITIONS, Message, Part

if TYPE_CHECKING:
    from tactflow.message.result import Result

_Step = tuple[str, str, Callable[[Any, "Result"], Any] | None, bool, "_Plan | None"]
"""How a key is encoded: its name, its place in the message, the function for its value, whether it is left
out if unknown, and how the object in it is encoded."""
_Plan = tuple[Callable[[Any, str], Any], Sequence[_Step], "list[tuple[Any, orjson.Fragment | None]] | None"]
"""How a part is encoded: the function for values without one of their own, and its keys; for a part that
often repeats, also its last value with the text for it."""

NUMBERS: frozenset[Any] = frozenset({float, int})
"""Types of numbers that need no conversion."""


def encode(result: Result, detail: bool, field: bool) -> dict[str, Any]:
    """The message of a result, for `to_json`.

    Raises ValueError with the name of the field for a number that is not finite.
    """
    options = {"detail": detail, "field": field}
    given = [need for need in CONDITIONS if options.get(need, result.value(need) is not None)]
    message: dict[str, Any] = _encoded(result, _plan(Message, frozenset(given), ""), result)
    return message


@cache
def _plan(part: type[Part], given: frozenset[str], path: str) -> _Plan:
    """How a part is encoded. given : the ports and options that there are. path : of the part."""
    steps: list[_Step] = []
    for name, sending, inner in part.all_keys():
        if given.issuperset(sending.needs):
            plan = None if inner is None else _plan(inner, given, f"{path}{name}.")
            steps.append((name, path + name, sending.value, sending.if_known, plan))
    return part.source, steps, [(None, None)] if part.repeats else None


def to_json(message: dict[str, Any]) -> bytes:
    """A message of `encode`, or a part of it, as JSON in UTF-8."""
    return orjson.dumps(message, option=orjson.OPT_SERIALIZE_NUMPY)


def _encoded(value: Any, plan: _Plan, result: Result) -> Any:
    source, steps, kept = plan
    if kept is not None:
        # Read as a whole, and replaced as a whole: sinks of several threads encode the same value.
        last, text = kept[0]
        if last is value:
            return text
    message: dict[str, Any] = {}
    for name, path, value_of, if_known, inner in steps:
        found = source(value, name) if value_of is None else value_of(value, result)
        if found is None:
            if not if_known:
                message[name] = None
        elif inner is None:
            # Most values: comparing costs less than a call.
            kind = found.__class__
            simple = kind is str or kind is int or (kind is float and found - found == 0)
            message[name] = found if simple else _finite(found, path)
        elif isinstance(found, tuple):
            message[name] = [_encoded(part, inner, result) for part in found]
        else:
            message[name] = _encoded(found, inner, result)
    if kept is None:
        return message
    text = orjson.Fragment(to_json(message))
    kept[0] = value, text
    return text


def _finite(value: Any, path: str) -> Any:
    """Check and convert for the encoder. NaN is allowed in standard errors and probabilities (null)."""
    if isinstance(value, tuple):
        if len(value) != 2 or not (value[0].__class__ in NUMBERS and value[1].__class__ in NUMBERS):
            return [_finite(part, path) for part in value]
        # Points. The differences are 0 or NaN.
        total = (value[0] - value[0]) + (value[1] - value[1])
    elif isinstance(value, float):
        total = value
    elif isinstance(value, np.ndarray):
        value = np.ascontiguousarray(value, np.float64)
        # The sum of squares is finite only if all numbers are; this needs no temporary array.
        total = float(np.vdot(value, value))
    elif isinstance(value, np.floating):
        value = total = float(value)
    else:
        return value
    if math.isfinite(total) or (path.endswith(("stderr", "probability")) and not np.isinf(value).any()):
        return value
    raise ValueError(f"{path}: required finite numbers, got NaN or infinity")
