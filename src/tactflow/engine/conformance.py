"""Whether a class keeps the contract of stages, sinks and sources (`tactflow.engine.contract`)."""

from __future__ import annotations

import difflib
import functools
import inspect
from collections.abc import Callable, Collection, Iterator, Mapping
from typing import Any, get_args

from tactflow.engine.contract import Memory, Part, Sink, Source, Stage, StageParams, WhenLive
from tactflow.engine.errors import ConfigError
from tactflow.engine.graph import Component, Kind, Mark, Node, Pipeline
from tactflow.engine.ports import read_ports

BASES: dict[Kind, type[Part]] = {"source": Source, "stage": Stage, "sink": Sink}
"""What each kind inherits from."""

METHODS: dict[Kind, str] = {"source": "frames", "stage": "process", "sink": "write"}
"""The method whose annotations are the ports."""

OFFERED = ("sensor", "directory", "skipping", "control", "calibration")
"""What a constructor may ask for beside `params`."""

_FLAG = ("True or False", lambda value: isinstance(value, bool))
_TEXT = ("a text or None", lambda value: value is None or isinstance(value, str))
_VALUES: dict[str, tuple[str, Callable[[Any], bool]]] = {
    "memory": ("'pure' or 'stateful'", lambda value: value in get_args(Memory)),
    "when_live": ("'block' or 'latest'", lambda value: value in get_args(WhenLive)),
    "threaded": _FLAG,
    "observer": _FLAG,
    "takes_references": _FLAG,
    "on_demand": _FLAG,
    "live": _FLAG,
    "description": _TEXT,
    "wants_reference": _TEXT,
    "queue_capacity": ("a whole number from 1", lambda value: type(value) is int and value >= 1),
    "total": ("a whole number or None", lambda value: value is None or type(value) is int),
}
"""Attribute of the contract -> what is required of its value, in words and in code."""
_MISSPELT = 0.85
"""Similarity (`difflib`, 0 to 1) from which a name is taken for a misspelt one; one letter in eight: 0.87.
Stricter than for what users type: a class is refused for it."""


def kind_of(cls: type[Any]) -> Kind | None:
    """What a class is, by what it inherits from; None if it is no part of a pipeline."""
    return next((kind for kind, base in BASES.items() if issubclass(cls, base)), None)


def component(cls: type[Any], name: str, origin: str, reserved: Collection[str]) -> Component:
    """Read a class as a stage, sink or source.

    name, origin : as in `Component`. reserved : names that a parameter may not have.

    Raises
    ------
    ConfigError : the class breaks the contract; every message begins with the place of the class.
    """
    kind = kind_of(cls)
    if kind is None:
        raise _broken(cls, f" must inherit from {_bases_in_words(cls)} of tactflow")
    problems = [*_wrong_parameters(cls, reserved), *_wrong_constructor(cls), *_wrong_methods(cls, kind)]
    problems += [*_wrong_names(cls, kind), *_wrong_values(cls, kind)]
    if problems:
        raise _broken(cls, problems[0], *problems[1:])
    memory: Memory = getattr(cls, "memory", "pure")
    return Component(name, kind, cls, cls.Params, read_ports(cls, METHODS[kind]), memory, origin)


def own_sink(pipeline: Pipeline, cls: type[Sink], id_: str, origin: str, **values: Any) -> Node:
    """A sink of the program itself, for the end of a pipeline: each input is the last output of its name.

    values : attributes of its class, by which it reaches who made it. origin : as in `Component`.
    """
    found = component(type(cls.__name__, (cls,), values | {"__annotations__": {}}), id_, origin, ())
    inputs = {port.name: pipeline.last_output(port.name) for port in found.ports.inputs}
    return Node(id_, found, StageParams(), inputs, Mark(origin, 0, 0))


def build(cls: type[Any], params: StageParams, offered: Mapping[str, Any]) -> Part:
    """Construct a part of a pipeline with what its constructor asks for.

    offered : value for each name of `OFFERED`.
    """
    wanted = inspect.signature(cls).parameters
    part: Part = cls(params, **{name: value for name, value in offered.items() if name in wanted})
    # Whether or not the constructor calls that of its base class.
    part.params = params
    return part


def _bases_in_words(cls: type) -> str:
    """The base class that the method of a class asks for, else all of them."""
    fits = [BASES[kind].__name__ for kind, method in METHODS.items() if hasattr(cls, method)]
    return " or ".join(fits or [base.__name__ for base in BASES.values()])


def _wrong_parameters(cls: type[Part], reserved: Collection[str]) -> Iterator[str]:
    params: Any = cls.Params
    if not (inspect.isclass(params) and issubclass(params, StageParams)):
        yield ".Params must be a subclass of tactflow.StageParams"
        return
    for key, field in params.model_fields.items():
        if (field.alias or key) in reserved:
            yield f".Params.{key}: that name is a key of the pipeline file"


def _wrong_constructor(cls: type) -> Iterator[str]:
    try:
        signature = inspect.signature(cls)
        asked = {word: None for word in OFFERED if word in signature.parameters}
        signature.bind(None, **asked)
    except (TypeError, ValueError):
        yield (
            " must be built from its parameters: __init__(self, params), and if it needs them "
            f"{', '.join(OFFERED)}"
        )


def _wrong_names(cls: type, kind: Kind) -> Iterator[str]:
    """Public names of a class that are nearly ones of the contract which it leaves out.

    Only a name of the same sort counts: a method `publish` is no misspelt class method `publishes`.
    """
    known = _contract(kind)
    left_out = sorted(known - _defined(cls))
    for name in sorted(vars(cls)):
        if name.startswith("_") or name in known or name in METHODS.values():
            continue
        sort = _sort(inspect.getattr_static(cls, name))
        alike = [other for other in left_out if _sort(_of_contract(kind, other)) == sort]
        near = difflib.get_close_matches(name, alike, n=1, cutoff=_MISSPELT)
        if near:
            yield f".{name}: a {kind} has no such attribute; did you mean {near[0]}?"
    for name in sorted(_VALUES.keys() - known):
        if name in vars(cls) and _sort(vars(cls)[name]) == "value":
            yield f".{name}: a {kind} has no such attribute"
    inner = [n for n, v in vars(cls).items() if inspect.isclass(v) and issubclass(v, StageParams)]
    if inner and "Params" not in _defined(cls):
        yield f".{inner[0]}: nobody reads it; the parameters are an inner class called Params"


def _sort(attribute: Any) -> str:
    """What sort of attribute it is, as it stands in the class."""
    if isinstance(attribute, property | functools.cached_property):
        return "property"
    if isinstance(attribute, classmethod):
        return "class method"
    return "method" if inspect.isroutine(attribute) else "value"


def _names(base: type) -> set[str]:
    """Public names that a class defines or announces."""
    names = {*vars(base), *vars(base).get("__annotations__", {})}
    return {name for name in names if not name.startswith("_")}


def _contract(kind: Kind) -> set[str]:
    """Every name of the contract of a kind, but for the method that holds its ports."""
    return {name for base in BASES[kind].__mro__[:-1] for name in _names(base)} - {METHODS[kind]}


def _of_contract(kind: Kind, name: str) -> Any:
    """An attribute of the contract as it stands there."""
    return inspect.getattr_static(BASES[kind], name, None)


def _defined(cls: type) -> set[str]:
    """Names that a class does not have from the contract."""
    own = [base for base in cls.__mro__ if base.__module__ != Part.__module__]
    return {name for base in own for name in vars(base)}


def _wrong_values(cls: type, kind: Kind) -> Iterator[str]:
    if kind == "stage" and not hasattr(cls, "memory"):
        yield (
            ' must declare memory = "pure" (its outputs depend on its inputs alone) or memory = "stateful", '
            "got nothing"
        )
    for name in sorted(_VALUES.keys() & _contract(kind) & _defined(cls)):
        words, fits = _VALUES[name]
        value = inspect.getattr_static(cls, name)
        if _sort(value) != "property" and not fits(value):
            yield f".{name}: required {words}, got {value!r}"


def _wrong_methods(cls: type[Part], kind: Kind) -> Iterator[str]:
    """Methods that are missing, or cannot be called as the engine does."""
    for other, method in METHODS.items():
        if other != kind and callable(getattr(cls, method, None)):
            yield f": a {kind} has no {method}(); a class is one of stage, sink and source"
    if METHODS[kind] not in _defined(cls) or not callable(getattr(cls, METHODS[kind])):
        makes = "which yields its frames" if kind == "source" else "whose annotations are its ports"
        yield f": a {kind} has a method {METHODS[kind]}(), {makes}"
    for name in sorted(_contract(kind) & _defined(cls) - {"Params"}):
        ours, theirs = inspect.getattr_static(cls, name), _of_contract(kind, name)
        if _sort(theirs) == "class method" and _sort(ours) == "method":
            yield f".{name}: required a class method; write @classmethod above it"
        elif _sort(theirs) == "property" and _sort(ours) == "method":
            yield f".{name}: required a property; write @property above it"
        elif _sort(theirs) in ("method", "class method"):
            yield from _wrong_method(name, getattr(cls, name), getattr(BASES[kind], name))


def _wrong_method(name: str, ours: Any, theirs: Any) -> Iterator[str]:
    """A method that does not take what the one of the contract takes."""
    if not callable(ours):
        yield f".{name}: required a method, got {ours!r}"
        return
    if inspect.iscoroutinefunction(ours):
        yield f".{name}: async functions are not awaited here; write def"
    wanted = [None] * len(inspect.signature(theirs).parameters)
    try:
        inspect.signature(ours).bind(*wanted)
    except TypeError:
        asked = ", ".join(inspect.signature(theirs).parameters)
        yield f".{name}: required ({asked}), got {inspect.signature(ours)}"


def _broken(cls: type, *problems: str) -> ConfigError:
    """The error for a class that breaks the contract, with the place of the class."""
    try:
        place = f"{inspect.getsourcefile(cls)}:{inspect.getsourcelines(cls)[1]}"
    except (OSError, TypeError):
        place = cls.__module__
    return ConfigError("\n".join(f"{place}: {cls.__name__}{problem}" for problem in problems))
