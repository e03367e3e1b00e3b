"""Run-time checks of values against the port types of a node (`--check`)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import is_dataclass
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np

from tactflow.engine.frame import Absent
from tactflow.engine.graph import Node
from tactflow.engine.ports import ArrayPort, Port, SignalPort, port_type

NUMBERS = frozenset(scalar for scalar in np.sctypeDict.values() if issubclass(scalar, np.number | np.bool_))
"""Types of elements that stand for one dtype each; np.floating, np.str_ and Any stand for several."""


class ArrayCheck:
    """Checks one node's values. Named dimensions must agree among all its inputs and outputs of a tick."""

    def __init__(self, node: Node) -> None:
        self._node = node

    def read_only(self, value: Any) -> Any:
        """The value, or a view of an array that cannot be written through."""
        if isinstance(value, np.ndarray):
            value = value.view()
            value.flags.writeable = False
        return value

    def outputs(self, arguments: Sequence[Any], values: Sequence[Any]) -> None:
        """Raise TypeError or ValueError, naming the port, unless every value is what its port promises."""
        ports = self._node.component.ports
        sizes: dict[str, int] = {}
        for port, value in zip(ports.inputs, arguments, strict=True):
            if value is not None:
                _check_value(port, value, sizes)
        for port, value in zip(ports.outputs, values, strict=True):
            if not isinstance(value, Absent):
                _check_value(port, value, sizes)


def wrong_input(node: Node, values: Sequence[Any]) -> str | None:
    """Which node gave a value that its port does not allow, and what is wrong with it; None if all are right.

    values : of the inputs, in the order of the ports. Each is looked at alone: of two that differ in size,
    either may be the wrong one.
    """
    for port, value in zip(node.component.ports.inputs, values, strict=True):
        giver = node.inputs[port.name]
        if value is None or giver is None:
            continue
        try:
            _check_value(port, value, {})
        except (TypeError, ValueError) as error:
            return f"{giver.node} gave a wrong value: {error}"
    return None


def _check_value(port: Port, value: Any, sizes: dict[str, int]) -> None:
    spec = port_type(port.annotation)
    if isinstance(spec, ArrayPort):
        if not isinstance(value, np.ndarray):
            raise TypeError(f"port {port.name}: required an array, got {type(value).__name__}")
        if value.dtype.name != spec.dtype:
            raise TypeError(f"port {port.name}: required dtype {spec.dtype}, got {value.dtype.name}")
        if value.ndim != len(spec.shape):
            raise ValueError(
                f"port {port.name}: required shape {_text(spec.shape)}, got {_text(value.shape)}"
            )
        for expected, actual in zip(spec.shape, value.shape, strict=True):
            required = expected if isinstance(expected, int) else sizes.setdefault(expected, actual)
            if required != actual:
                known = ", ".join(f"{name} = {size}" for name, size in sizes.items())
                raise ValueError(
                    f"port {port.name}: required shape {_text(spec.shape)} with {known or 'no named size'}, "
                    f"got {_text(value.shape)}"
                )
        if value.dtype.kind == "f" and not np.isfinite(value).all():
            raise ValueError(f"port {port.name}: required finite numbers, got NaN or infinity")
    elif isinstance(spec, SignalPort):
        if not isinstance(value, bool | np.bool_):
            raise TypeError(f"port {port.name}: required a bool, got {type(value).__name__}")
    elif isinstance(spec, type) and not isinstance(value, spec):
        raise TypeError(f"port {port.name}: required {spec.__name__}, got {type(value).__name__}")
    elif is_dataclass(value):
        for field, dtype in _array_fields(type(value)):
            got = getattr(getattr(value, field), "dtype", type(getattr(value, field)).__name__)
            if got != dtype:
                raise TypeError(f"port {port.name}, {field}: required an array of {dtype}, got {got}")


def _array_fields(record: type) -> Iterator[tuple[str, str]]:
    """Name and dtype of each field that is annotated as an array of one dtype, such as NDArray[np.uint8]."""
    try:
        hints = get_type_hints(record)
    except NameError:  # a name that only type checkers see
        return
    for name, hint in hints.items():
        if get_origin(hint) is np.ndarray:
            for scalar in get_args(get_args(hint)[-1]):
                if scalar in NUMBERS:
                    yield name, np.dtype(scalar).name


def _text(shape: Sequence[int | str]) -> str:
    return "(" + ", ".join(str(size) for size in shape) + ")"
