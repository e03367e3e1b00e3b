"""Ports: inputs and outputs of a stage or sink, read from the annotations of its method.

Each parameter of `process` or `write` is an input; one annotated with a `Tick` stands for the ports that its
class names. The return annotation of `process` gives the outputs: one named after its type, or one per field
of a NamedTuple.
"""

from __future__ import annotations

import inspect
import re
import types
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np

from tactflow.engine.errors import ConfigError
from tactflow.engine.frame import Absent, Frame, Tick


@dataclass(frozen=True, slots=True)
class ArrayPort:
    """Type of a port that carries an array; used as `Annotated[NDArray[...], ArrayPort(...)]`.

    Attributes
    ----------
    name : default name of the port.
    shape : one entry per axis, an int (exact) or a str (a named dimension).
    dtype : numpy dtype name.
    unit : of the values.
    """

    name: str
    shape: tuple[int | str, ...]
    dtype: str
    unit: str


@dataclass(frozen=True, slots=True)
class SignalPort:
    """Type of a boolean port that can gate stages.

    Attributes
    ----------
    closed : the reason while it is False.
    otherwise : outputs of a gated stage then: "absent", or "repeat" for the last ones. closed None: both
        are those of the input signal, for a stage that only holds a signal.
    """

    name: str
    closed: str | None
    otherwise: Literal["absent", "repeat"] = "absent"


@dataclass(frozen=True, slots=True)
class Port:
    """One input or output of a stage.

    Attributes
    ----------
    name : the port's name.
    annotation : the Python type.
    optional : True if the input may be absent.
    """

    name: str
    annotation: Any
    optional: bool = False


@dataclass(frozen=True, slots=True)
class ResultParameter:
    """The first parameter of a sink if it takes a result: the first `count` inputs, as a `kind`."""

    count: int
    kind: type[Tick]


@dataclass(frozen=True, slots=True)
class Ports:
    """The ports of a stage or sink class: inputs in the order of the parameters, and outputs.

    Attributes
    ----------
    result : the parameter that stands for several inputs, or None.
    """

    inputs: Sequence[Port]
    outputs: Sequence[Port]
    result: ResultParameter | None = None


def read_ports(cls: type, method: str) -> Ports:
    """Read the ports of a stage or sink class from the annotations of one of its methods.

    cls : the class.
    method : "process" (a stage), "frames" (a source) or "write" (a sink).

    Raises
    ------
    ConfigError : the annotations do not define ports; the message starts with `file:line`.
    """
    function = inspect.unwrap(getattr(cls, method))
    try:
        return _ports(function, method)
    except _PortError as problem:
        code = function.__code__
        place = f"{code.co_filename}:{code.co_firstlineno}"
        raise ConfigError(f"{place}: {cls.__name__}.{method}: {problem}") from None


def ports_of(kind: type[Tick]) -> list[Port]:
    """The input ports named by the annotations of a subclass of Tick."""
    return [_input(name, annotation) for name, annotation in kind.port_types().items()]


def fits(output: Port, input_: Port) -> bool:
    """Whether `output` can be connected to `input_`.

    A class must be the same or a subclass. Arrays must agree in rank, in each dimension (an exact size
    matches a named one), in dtype and in unit. A signal matches any signal and bool.
    """
    offered, wanted = port_type(output.annotation), port_type(input_.annotation)
    if wanted is Any or wanted is object:
        return True
    if isinstance(offered, ArrayPort) and isinstance(wanted, ArrayPort):
        axes = [
            have == want or (isinstance(have, int) and isinstance(want, str))
            for have, want in zip(offered.shape, wanted.shape, strict=False)
        ]
        same_values = (offered.dtype, offered.unit) == (wanted.dtype, wanted.unit)
        return same_values and len(offered.shape) == len(wanted.shape) and all(axes)
    if isinstance(offered, SignalPort):
        return isinstance(wanted, SignalPort) or wanted is bool
    if inspect.isclass(offered) and inspect.isclass(wanted):
        return issubclass(offered, wanted)
    return bool(offered == wanted)


def port_type(annotation: Any) -> Any:
    """The `ArrayPort` or `SignalPort` of an annotated type, else the type itself."""
    metadata = get_args(annotation)[1:] if get_origin(annotation) is Annotated else ()
    return next((item for item in metadata if isinstance(item, ArrayPort | SignalPort)), annotation)


def describe_type(annotation: Any) -> str:
    """A port type in words: `(H, W, 3) uint8, grey levels, BGR`, `signal`, `Contact`."""
    kind = port_type(annotation)
    if isinstance(kind, ArrayPort):
        return f"({', '.join(map(str, kind.shape))}) {kind.dtype}, {kind.unit}"
    if isinstance(kind, SignalPort):
        return "signal"
    if get_origin(kind) is Annotated:
        kind = get_args(kind)[0]
    return kind.__name__ if inspect.isclass(kind) and not get_args(kind) else str(kind).replace("typing.", "")


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


class _PortError(Exception):
    """The annotations of a method do not describe ports."""


def _ports(function: Callable[..., Any], method: str) -> Ports:
    if method == "frames":
        return Ports((), (Port("frame", Frame),))
    hints = _hints(function)
    parameters = list(inspect.signature(function).parameters.values())[1:]
    if method == "write":
        # Their types are those that `Sink.declare` gives.
        parameters = [parameter for parameter in parameters if parameter.kind != parameter.VAR_POSITIONAL]
    inputs: list[Port] = []
    result: ResultParameter | None = None
    named = {parameter.name for parameter in parameters}
    for parameter in parameters:
        annotation = hints.get(parameter.name)
        if not (inspect.isclass(annotation) and issubclass(annotation, Tick)):
            inputs.append(_parameter(parameter, annotation))
        elif method != "write" or parameter is not parameters[0]:
            raise _PortError("only a sink may take a result, first; a stage can take the port frame: Frame")
        else:
            # A port that is also a parameter of its own is passed there.
            ports = [port for port in ports_of(annotation) if port.name not in named]
            result = ResultParameter(len(ports), annotation)
            inputs += ports
    if method == "write":
        return Ports(inputs, (), result)
    if not inputs:
        raise _PortError("a stage needs at least one input; a source has frames() instead")
    return Ports(inputs, _outputs(hints.get("return", inspect.Parameter.empty)))


def _hints(annotated: Any) -> dict[str, Any]:
    try:
        return get_type_hints(annotated, include_extras=True)
    except NameError as error:
        raise _PortError(
            f"the annotations of {annotated.__name__} use {error.name}, which is not known when the program "
            "runs; import it at the top of the file, not under TYPE_CHECKING or inside a function"
        ) from None
    except Exception as error:
        raise _PortError(f"the annotations cannot be evaluated ({type(error).__name__}: {error})") from None


def _parameter(parameter: inspect.Parameter, annotation: Any) -> Port:
    name = parameter.name
    if annotation is None:
        raise _PortError(
            f"parameter {name} has no annotation; an input needs a type, as in {name}: Image, and what takes "
            "the whole result is annotated result: Result"
        )
    if parameter.default not in (parameter.empty, None):
        raise _PortError(f"parameter {name} has a default, but ports have none; settings belong in Params")
    port = _input(name, annotation)
    return Port(name, port.annotation, port.optional or parameter.default is None)


def _input(name: str, annotation: Any) -> Port:
    """An input; `X | None` is one that may be absent."""
    if Absent in _members(annotation):
        raise _PortError(f"{name}: an input that may be absent is annotated X | None")
    return Port(name, *_single_type(annotation, name))


def _outputs(annotation: Any) -> tuple[Port, ...]:
    if annotation is inspect.Parameter.empty:
        raise _PortError(
            "no return annotation; it says which outputs the stage has, as in -> Contact | Absent"
        )
    result, optional = _single_type(annotation, "the return annotation")
    if inspect.isclass(result) and issubclass(result, tuple) and hasattr(result, "_fields"):
        fields = {
            name: _single_type(hint, f"{result.__name__}.{name}") for name, hint in _hints(result).items()
        }
        return tuple(Port(name, type_, optional or may) for name, (type_, may) in fields.items())
    spec = port_type(result)
    if isinstance(spec, ArrayPort | SignalPort):
        return (Port(spec.name, result, optional),)
    if not inspect.isclass(result) or result.__module__ in ("builtins", "typing"):
        raise _PortError(
            f"the return annotation {describe_type(result)} gives the output port no name; return a "
            "NamedTuple with a field for it, as in brightness: float, a dataclass (Contact gives the port "
            "contact) or a type of tactflow.ports; a signal is Annotated[bool, "
            'SignalPort("name", closed="reason")]'
        )
    name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", "_", result.__name__).lower()
    return (Port(name, result, optional),)


def _single_type(annotation: Any, place: str) -> tuple[Any, bool]:
    """X of `X | Absent | None`, and whether the value may be absent."""
    members = [member for member in _members(annotation) if member not in (Absent, type(None))]
    if len(members) != 1:
        raise _PortError(
            f"{place}: required one type for one port, X or X | None; several outputs are a NamedTuple"
        )
    origin = get_origin(members[0]) or members[0]
    if inspect.isclass(origin) and issubclass(origin, np.ndarray):
        raise _PortError(
            f"{place}: a bare array does not say what it holds; use a type of tactflow.ports (Image, "
            'ContactMask) or Annotated[NDArray[np.uint8], ArrayPort("name", ("H", "W"), "uint8", "unit")]'
        )
    return members[0], len(_members(annotation)) > 1


def _members(annotation: Any) -> tuple[Any, ...]:
    is_union = get_origin(annotation) in (Union, types.UnionType)
    return get_args(annotation) if is_union else (annotation,)
