"""Checks of values against port types at run time (`--check`)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from tactflow.engine.frame import Absent
from tactflow.engine.ports import ArrayPort, Port, Ports, SignalPort, port_type


def read_only(value: Any) -> Any:
    """The value; for an array, a read-only view."""
    if isinstance(value, np.ndarray):
        value = value.view()
        value.flags.writeable = False
    return value


def check_values(ports: Ports, inputs: Sequence[Any], outputs: Sequence[Any]) -> None:
    """Raise TypeError or ValueError, naming the port, unless every value matches its port type.

    Named dimensions must agree among all inputs and outputs of a tick.
    """
    sizes: dict[str, int] = {}
    for port, value in zip([*ports.inputs, *ports.outputs], [*inputs, *outputs], strict=True):
        if value is not None and not isinstance(value, Absent):
            _check_value(port, value, sizes)


def _check_value(port: Port, value: Any, sizes: dict[str, int]) -> None:
    spec = port_type(port.annotation)
    if isinstance(spec, ArrayPort):
        _check_array(port.name, spec, value, sizes)
    elif isinstance(spec, SignalPort):
        if not isinstance(value, bool | np.bool_):
            raise TypeError(f"port {port.name}: required a bool, got {type(value).__name__}")
    elif isinstance(spec, type) and not isinstance(value, spec):
        raise TypeError(f"port {port.name}: required {spec.__name__}, got {type(value).__name__}")


def _check_array(name: str, spec: ArrayPort, value: Any, sizes: dict[str, int]) -> None:
    if not isinstance(value, np.ndarray):
        raise TypeError(f"port {name}: required an array, got {type(value).__name__}")
    if value.dtype.name != spec.dtype:
        raise TypeError(f"port {name}: required dtype {spec.dtype}, got {value.dtype.name}")
    required = [sizes.get(axis, axis) if isinstance(axis, str) else axis for axis in spec.shape]
    fits = [isinstance(axis, str) or axis == size for axis, size in zip(required, value.shape, strict=False)]
    if value.ndim != len(spec.shape) or not all(fits):
        shape = ", ".join(map(str, spec.shape))
        known = ", ".join(f"{axis} = {size}" for axis, size in sizes.items() if axis in spec.shape)
        raise ValueError(
            f"port {name}: required shape ({shape}){' with ' if known else ''}{known}, got {value.shape}"
        )
    sizes |= {axis: size for axis, size in zip(spec.shape, value.shape, strict=True) if isinstance(axis, str)}
    if value.dtype.kind == "f" and not np.isfinite(value).all():
        raise ValueError(f"port {name}: required finite numbers, got NaN or infinity")
