"""Whether a class keeps the contract of stages, sinks and sources (`tactflow.engine.contract`)."""

from __future__ import annotations

import difflib
import inspect
from collections.abc import Collection, Iterator
from typing import Any, get_args

from tactflow.engine.contract import Memory, Part, Sink, Source, Stage, StageParams, WhenLive
from tactflow.engine.errors import ConfigError
from tactflow.engine.graph import Component, Kind
from tactflow.engine.ports import read_ports

BASES: dict[Kind, type[Part]] = {"source": Source, "stage": Stage, "sink": Sink}
"""What each kind inherits from."""

METHODS: dict[Kind, str] = {"source": "frames", "stage": "process", "sink": "write"}
"""The method whose annotations are the ports."""

OFFERED = ("sensor", "directory", "skipping", "control")
"""What a constructor may ask for beside `params`."""

_CHOICES = {"memory": get_args(Memory), "when_live": get_args(WhenLive)}
_FLAGS = ("threaded", "observer", "takes_references")
_MISSPELT = 0.85
"""Similarity (`difflib`, 0 to 1) from which a name is taken for a misspelt one; one letter in eight: 0.87."""


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
    problems = [*_wrong_parameters(cls, reserved), *_wrong_constructor(cls), *_wrong_names(cls, kind)]
    problems += [] if problems else [*_wrong_values(cls, kind), *_wrong_methods(cls, kind)]
    if problems:
        raise _broken(cls, problems[0], *problems[1:])
    memory: Memory = getattr(cls, "memory", "pure")
    return Component(name, kind, cls, cls.Params, read_ports(cls, METHODS[kind]), memory, origin)


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
    """Public names of a class that are nearly ones of the contract which it leaves out."""
    known = _contract(kind) | {METHODS[kind]}
    own = _defined(cls)
    for name in sorted(vars(cls)):
        if name.startswith("_") or name in known:
            continue
        near = difflib.get_close_matches(name, sorted(known - own), n=1, cutoff=_MISSPELT)
        if near:
            yield f".{name}: a {kind} has no such attribute; did you mean {near[0]}?"


def _names(base: type) -> set[str]:
    """Public names that a class defines or announces."""
    names = {*vars(base), *vars(base).get("__annotations__", {})}
    return {name for name in names if not name.startswith("_")}


def _contract(kind: Kind) -> set[str]:
    """Every name of the contract of a kind, but for the method that holds its ports."""
    return {name for base in BASES[kind].__mro__[:-1] for name in _names(base)} - {METHODS[kind]}


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
    for name, choices in _CHOICES.items():
        value = getattr(cls, name, choices[0])
        if value not in choices:
            yield f".{name}: required {' or '.join(map(repr, choices))}, got {value!r}"
    for name in _FLAGS:
        value = getattr(cls, name, False)
        if not isinstance(value, bool):
            yield f".{name}: required True or False, got {value!r}"
    capacity = getattr(cls, "queue_capacity", 1)
    if not isinstance(capacity, int) or isinstance(capacity, bool) or capacity < 1:
        yield f".queue_capacity: required a whole number from 1, got {capacity!r}"


def _wrong_methods(cls: type[Part], kind: Kind) -> Iterator[str]:
    """Methods that are missing, or cannot be called as the engine does."""
    other = [method for other, method in METHODS.items() if other != kind and hasattr(cls, method)]
    if other:
        yield f": a {kind} has no {other[0]}(); a class is one of stage, sink and source"
    if kind != "source" and not callable(getattr(cls, METHODS[kind], None)):
        yield f": a {kind} has a method {METHODS[kind]}(), whose annotations are its ports"
    if kind == "source" and "frames" not in _defined(cls):
        yield ": a source has a method frames(), which yields its frames"
    base = BASES[kind]
    for name in sorted(_contract(kind) - {"Params"}):
        ours, theirs = getattr(cls, name, None), getattr(base, name, None)
        if inspect.ismethod(theirs) and callable(ours) and not inspect.ismethod(ours):
            yield f".{name}: required a class method; write @classmethod above it"
        elif inspect.isroutine(theirs):
            yield from _wrong_method(name, ours, theirs)


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
