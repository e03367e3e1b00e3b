"""Ports: what a stage or sink takes and gives, read from the annotations of its method.

Each parameter of `process` or `write` is an input port, or a NamedTuple of input ports. The return annotation
of `process` gives the output ports: one named after its type, or one per field of a NamedTuple.
"""

from __future__ import annotations

import inspect
import re
import types
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np

from tactflow.engine.errors import ConfigError
from tactflow.engine.frame import Absent, Frame, Tick


@dataclass(frozen=True, slots=True)
class ArrayPort:
    """Type of a port that carries an array; used as `Annotated[NDArray[...], ArrayPort(...)]`.

    name : default name of the port. shape : one entry per axis, an int (exact) or a str (a dimension with
    that name). dtype : numpy dtype name. unit : what one unit of the value means.
    """

    name: str
    shape: tuple[int | str, ...]
    dtype: str
    unit: str


@dataclass(frozen=True, slots=True)
class SignalPort:
    """Type of a boolean port that can gate stages.

    closed : the reason given while it is False. otherwise : what a gated stage's outputs are then, unless its
    `when:` says something else: "absent", or "repeat" for the last ones again. closed None: both are those of
    the signal that the stage itself takes, for a stage that only holds another's signal.
    """

    name: str
    closed: str | None
    otherwise: Literal["absent", "repeat"] = "absent"


@dataclass(frozen=True, slots=True)
class Port:
    """One input or output of a stage.

    name : the port's name. annotation : the Python type. optional : True if the input may be absent.
    """

    name: str
    annotation: Any
    optional: bool = False


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter of a stage's `process` or a sink's `write`.

    ports : the input ports that it stands for. group : the NamedTuple or subclass of Tick that takes them
    together; None where the one port is the parameter itself.
    """

    name: str
    ports: Sequence[Port]
    group: type | None = None


@dataclass(frozen=True, slots=True)
class Ports:
    """The ports of a stage or sink class, read from its annotations.

    parameters : what its method takes, in order. outputs : what it gives.
    """

    parameters: Sequence[Parameter]
    outputs: Sequence[Port]

    @property
    def inputs(self) -> list[Port]:
        """Every input port, in the order of the parameters."""
        return [port for parameter in self.parameters for port in parameter.ports]


def read_ports(cls: type, method: str) -> Ports:
    """Read the ports of a stage or sink class from the annotations of one of its methods.

    cls : the class.
    method : "process" (a stage), "frames" (a source) or "write" (a sink).

    Returns
    -------
    The ports, inputs in the order of the parameters.

    Raises
    ------
    ConfigError : the annotations do not say what the ports are; the message starts with `file:line`.
    """
    function = inspect.unwrap(getattr(cls, method))
    try:
        _check_method(cls, function, method)
        return _ports(function, method)
    except _PortError as problem:
        raise ConfigError(f"{_place(function)}: {cls.__name__}.{method}: {problem}") from None


def mismatch(output: Port, input_: Port) -> str | None:
    """Say why a value of `output` cannot be given to `input_`, or None if it can.

    Classes must be the same or a subclass. Arrays must agree in rank, in each dimension (an exact size fits a
    named one), in dtype and in unit. A signal fits any signal and a plain bool.
    """
    reasons = [
        _misfit(port_type(output.annotation), port_type(member)) for member in _members(input_.annotation)
    ]
    return None if None in reasons else reasons[0]


def port_type(annotation: Any) -> Any:
    """The `ArrayPort` or `SignalPort` of an annotated type, else the type itself."""
    return next(
        (item for item in _metadata(annotation) if isinstance(item, ArrayPort | SignalPort)), annotation
    )


def describe_type(annotation: Any) -> str:
    """A port type in words: `(H, W, 3) uint8, grey levels, BGR`, `signal`, `Contact`."""
    return " or ".join(_describe(port_type(member)) for member in _members(annotation))


class _PortError(Exception):
    """The annotations of a method do not describe ports."""


_ARRAY_ADVICE = (
    "a bare array does not say what it holds; use a type of tactflow.ports (Image, ContactMask, ...) "
    'or Annotated[NDArray[np.uint8], ArrayPort("name", ("H", "W"), "uint8", "unit")]'
)


def _check_method(cls: type, function: Callable[..., Any], method: str) -> None:
    """Raise if a function cannot be called as the engine does: on an instance, for its result."""
    if isinstance(inspect.getattr_static(cls, method), staticmethod | classmethod):
        raise _PortError("required a method of the instance, with self as its first parameter")
    if inspect.iscoroutinefunction(function) or inspect.isasyncgenfunction(function):
        raise _PortError("async functions are not awaited here; write def")
    if method != "frames" and inspect.isgeneratorfunction(function):
        raise _PortError("it yields, but is called once a frame for what it returns; write return")


def _ports(function: Callable[..., Any], method: str) -> Ports:
    try:
        hints = get_type_hints(function, include_extras=True)
    except NameError as error:
        raise _PortError(
            f"the annotations use {error.name}, which is not known when the program runs; import it at the "
            "top of the file, not under TYPE_CHECKING or inside a function"
        ) from None
    except Exception as error:
        raise _PortError(f"the annotations cannot be evaluated ({type(error).__name__}: {error})") from None
    parameters = list(inspect.signature(function).parameters.values())[1:]
    if method == "frames":
        if parameters:
            raise _PortError(
                f"a source has no inputs, but {parameters[0].name} is one; settings belong in Params"
            )
        return Ports((), (_source_port(hints.get("return")),))
    found = [_parameter(parameter, hints.get(parameter.name), method) for parameter in parameters]
    found = _without_twice_named(found)
    _check_names(found)
    if method == "process":
        if not any(parameter.ports for parameter in found):
            raise _PortError("a stage needs at least one input; a source has frames() instead")
        return Ports(found, _output_ports(hints.get("return", inspect.Parameter.empty)))
    if hints.get("return", type(None)) is not type(None):
        raise _PortError("a sink returns nothing; annotate it with -> None")
    return Ports(found, ())


def _parameter(parameter: inspect.Parameter, annotation: Any, method: str) -> Parameter:
    name = parameter.name
    if parameter.kind not in (parameter.POSITIONAL_OR_KEYWORD, parameter.KEYWORD_ONLY):
        raise _PortError(f"{name}: a port cannot be positional-only, *args or **kwargs; name each input")
    if inspect.isclass(annotation) and issubclass(annotation, Tick):
        if method != "write":
            raise _PortError("only a sink may take a Tick; a stage can take the port frame: Frame")
        return Parameter(name, ports_of(annotation), annotation)
    if _is_group(annotation):
        return Parameter(name, ports_of(annotation), annotation)
    if annotation is None and method == "write" and name in ("tick", "result", "results"):
        raise _PortError(f"the parameter {name} takes the result; annotate it as in result: Result")
    return Parameter(name, (_input_port(parameter, annotation),))


def _is_group(annotation: Any) -> bool:
    return inspect.isclass(annotation) and issubclass(annotation, tuple) and hasattr(annotation, "_fields")


def ports_of(group: type) -> tuple[Port, ...]:
    """The input ports that the annotations of a NamedTuple or of a subclass of Tick name."""
    ports = []
    for name, annotation in _field_hints(group).items():
        members = _members(annotation)
        types_ = tuple(member for member in members if member is not type(None))
        for member in types_:
            _check_array(f"{group.__name__}.{name}", member)
        ports.append(Port(name, Union[types_], len(types_) < len(members)))  # noqa: UP007 (built at run time)
    return tuple(ports)


def _without_twice_named(parameters: Sequence[Parameter]) -> list[Parameter]:
    """A port that a parameter names is asked for by that parameter alone, not by the result beside it."""
    named = {port.name for parameter in parameters if parameter.group is None for port in parameter.ports}

    def rest(parameter: Parameter) -> Parameter:
        if parameter.group is None or not issubclass(parameter.group, Tick):
            return parameter
        return replace(parameter, ports=[port for port in parameter.ports if port.name not in named])

    return [rest(parameter) for parameter in parameters]


def _check_names(parameters: Sequence[Parameter]) -> None:
    names = [port.name for parameter in parameters for port in parameter.ports]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise _PortError(f"two parameters take the port {twice}; one of them is enough")


def _source_port(annotation: Any) -> Port:
    origin, args = get_origin(annotation), get_args(annotation)
    iterates = inspect.isclass(origin) and issubclass(origin, Iterable)
    if not (iterates and inspect.isclass(args[0]) and issubclass(args[0], Frame)):
        raise _PortError("the return annotation must be Iterator[Frame]")
    return Port("frame", args[0])


def _input_port(parameter: inspect.Parameter, annotation: Any) -> Port:
    name = parameter.name
    if annotation is None:
        raise _PortError(f"parameter {name} has no annotation; an input needs a type, as in {name}: Image")
    members = _members(annotation)
    optional = type(None) in members
    members = tuple(member for member in members if member is not type(None))
    if parameter.default not in (parameter.empty, None):
        raise _PortError(f"parameter {name} has a default, but ports have none; settings belong in Params")
    if parameter.default is None and not optional:
        raise _PortError(f"parameter {name} has the default None; annotate it as optional: X | None")
    if not members or Absent in members:
        raise _PortError(f"parameter {name}: an input that may be absent is annotated X | None")
    for member in members:
        _check_array(name, member)
    return Port(name, Union[members], optional)  # noqa: UP007 (built at run time)


def _output_ports(annotation: Any) -> tuple[Port, ...]:
    if annotation is inspect.Parameter.empty:
        raise _PortError(
            "no return annotation; it says which outputs the stage has, as in -> Contact | Absent"
        )
    result, optional = _single_type(annotation, "the return annotation")
    if _is_group(result):
        return _field_ports(result, optional)
    spec = port_type(result)
    if isinstance(spec, ArrayPort | SignalPort):
        return (Port(spec.name, result, optional),)
    _check_array("the return annotation", result)
    if result is Any or not inspect.isclass(result) or result.__module__ == "builtins":
        nameless = f"the return annotation {_describe(result)} gives the output port no name"
        raise _PortError(f"{nameless}; {_named_output(result)}")
    return (Port(_snake_case(result.__name__), result, optional),)


def _named_output(result: Any) -> str:
    """How an output is written so that its port has a name."""
    if result is bool:
        return (
            'a signal that can gate stages is Annotated[bool, SignalPort("name", closed="reason")], '
            "another bool a field of a NamedTuple, as in name: bool"
        )
    if result in (int, float, str):
        return f"return a NamedTuple with a field for it, as in name: {result.__name__}"
    return (
        "return a dataclass (Contact gives the port contact), a type of tactflow.ports, "
        "or a NamedTuple of ports"
    )


def _field_hints(group: type) -> dict[str, Any]:
    try:
        return group.port_types() if issubclass(group, Tick) else get_type_hints(group, include_extras=True)
    except NameError as error:
        raise _PortError(
            f"the fields of {group.__name__} use {error.name}, which is not known when the program runs; "
            "import it at the top of the file"
        ) from None


def _field_ports(result: type, all_optional: bool) -> tuple[Port, ...]:
    ports = []
    for name, annotation in _field_hints(result).items():
        field, optional = _single_type(annotation, f"{result.__name__}.{name}")
        _check_array(f"{result.__name__}.{name}", field)
        ports.append(Port(name, field, optional or all_optional))
    if not ports:
        raise _PortError(f"{result.__name__} has no annotated fields, so the stage has no output ports")
    return tuple(ports)


def _single_type(annotation: Any, what: str) -> tuple[Any, bool]:
    """The one type of `X | Absent | None`, and whether the value may be absent."""
    members = [member for member in _members(annotation) if member not in (Absent, type(None))]
    if len(members) != 1:
        words = "several types" if members else "no type"
        raise _PortError(f"{what} names {words} for one port; write X, X | Absent or a NamedTuple")
    return members[0], len(_members(annotation)) > 1


def _check_array(what: str, annotation: Any) -> None:
    if isinstance(port_type(annotation), ArrayPort | SignalPort):
        return
    origin = get_origin(annotation) or annotation
    if inspect.isclass(origin) and issubclass(origin, np.ndarray):
        raise _PortError(f"{what}: {_ARRAY_ADVICE}")


def _members(annotation: Any) -> tuple[Any, ...]:
    if get_origin(annotation) in (Union, types.UnionType):
        return get_args(annotation)
    return (annotation,)


def _metadata(annotation: Any) -> tuple[Any, ...]:
    return get_args(annotation)[1:] if get_origin(annotation) is Annotated else ()


def _misfit(given: Any, wanted: Any) -> str | None:
    if wanted is Any or wanted is object:
        return None
    if isinstance(given, ArrayPort) and isinstance(wanted, ArrayPort):
        return _array_misfit(given, wanted)
    if isinstance(given, SignalPort):
        fits = isinstance(wanted, SignalPort) or wanted is bool
    elif inspect.isclass(given) and inspect.isclass(wanted):
        fits = issubclass(given, wanted)
    else:
        fits = given == wanted
    return None if fits else "the types differ"


def _array_misfit(given: ArrayPort, wanted: ArrayPort) -> str | None:
    if len(given.shape) != len(wanted.shape):
        return f"{len(given.shape)} axes where {len(wanted.shape)} are wanted"
    for have, want in zip(given.shape, wanted.shape, strict=True):
        # An exact size is a case of a named one, but a named size need not be the exact one.
        if have != want and not (isinstance(want, str) and isinstance(have, int)):
            return f"axis of size {have} where {want} is wanted"
    if given.dtype != wanted.dtype:
        return f"dtype {given.dtype} where {wanted.dtype} is wanted"
    if given.unit != wanted.unit:
        return f"unit '{given.unit}' where '{wanted.unit}' is wanted"
    return None


def _describe(kind: Any) -> str:
    if isinstance(kind, ArrayPort):
        return f"({', '.join(map(str, kind.shape))}) {kind.dtype}, {kind.unit}"
    if isinstance(kind, SignalPort):
        return "signal"
    if get_origin(kind) is Annotated:
        return _describe(get_args(kind)[0])
    return kind.__name__ if inspect.isclass(kind) and not get_args(kind) else str(kind).replace("typing.", "")


def _snake_case(name: str) -> str:
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", "_", name).lower()


def _place(function: Callable[..., Any]) -> str:
    code = getattr(function, "__code__", None)
    return f"{code.co_filename}:{code.co_firstlineno}" if code else repr(function)
