"""Validating and constructing stages, sinks and sources (see `tactflow.engine.contract`)."""

from __future__ import annotations

import inspect
from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from typing import Any, get_args

from tactflow.engine.contract import Memory, Part, Sink, Source, Stage, StageParams
from tactflow.engine.errors import ConfigError
from tactflow.engine.graph import Component, Kind
from tactflow.engine.ports import Ports, read_ports

BASES: dict[Kind, type[Part]] = {"source": Source, "stage": Stage, "sink": Sink}
"""Base class of each kind."""

METHODS: dict[Kind, str] = {"source": "frames", "stage": "process", "sink": "write"}
"""The method whose annotations are the ports."""

OFFERED = ("sensor", "directory", "skipping", "control", "calibration")
"""Optional constructor arguments besides `params`."""


def kind_of(cls: type[Any]) -> Kind | None:
    """The kind of a class by its base class; None if it is not a part of a pipeline."""
    return next((kind for kind, base in BASES.items() if issubclass(cls, base)), None)


def component(cls: type[Any], name: str, origin: str, reserved: Collection[str]) -> Component:
    """Validate a class, and describe it as a stage, sink or source.

    name, origin : as in `Component`. reserved : names that parameters must not have.

    Raises
    ------
    ConfigError : the class violates the contract; each message starts with the location of the class.
    """
    kind = kind_of(cls)
    if kind is None:
        bases = [BASES[kind].__name__ for kind, method in METHODS.items() if hasattr(cls, method)]
        candidates = " or ".join(bases or [base.__name__ for base in BASES.values()])
        raise _broken(cls, f" must inherit from {candidates} of tactflow")
    problems = list(_problems(cls, kind, reserved))
    if problems:
        raise _broken(cls, *problems)
    memory: Memory = getattr(cls, "memory", "pure")
    ports = Ports((), ()) if declares(cls) else read_ports(cls, METHODS[kind])
    return Component(name, kind, cls, cls.Params, ports, memory, origin)


def declares(cls: type[Any]) -> bool:
    """Whether the ports of a class depend on its parameters (`Stage.declare`)."""
    return issubclass(cls, Stage) and cls.declare.__func__ is not Stage.declare.__func__  # type: ignore[attr-defined]


def configured(component: Component, params: StageParams) -> Component:
    """The component with its ports and memory for these parameters."""
    if not declares(component.cls):
        return component
    declared = component.cls.declare(params)
    return replace(component, ports=Ports(declared.inputs, declared.outputs), memory=declared.memory)


def build(cls: type[Any], params: StageParams, offered: Mapping[str, Any]) -> Part:
    """Construct a part of a pipeline with the arguments that its constructor takes.

    offered : value for each name of `OFFERED`.
    """
    parameters = inspect.signature(cls).parameters
    part: Part = cls(params, **{name: value for name, value in offered.items() if name in parameters})
    return part


def _problems(cls: type[Part], kind: Kind, reserved: Collection[str]) -> Iterator[str]:
    method = METHODS[kind]
    if getattr(cls, method, None) is getattr(BASES[kind], method, None):
        role = "which yields its frames" if kind == "source" else "whose annotations are its ports"
        yield f": a {kind} has a method {method}(), {role}"
    params: Any = cls.Params
    if not (inspect.isclass(params) and issubclass(params, StageParams)):
        yield ".Params must be a subclass of tactflow.StageParams"
    else:
        for key, field in params.model_fields.items():
            if (field.alias or key) in reserved:
                yield f".Params.{key}: that name is a key of the pipeline file"
    try:
        signature = inspect.signature(cls)
        signature.bind(None, **{name: None for name in OFFERED if name in signature.parameters})
    except (TypeError, ValueError):
        names = ", ".join(OFFERED)
        yield f" must be built from its parameters: __init__(self, params), and if it needs them {names}"
    memory = getattr(cls, "memory", None)
    if kind == "stage" and memory not in get_args(Memory):
        yield (
            ' must declare memory = "pure" (its outputs depend on its inputs alone) or memory = "stateful", '
            f"got {'nothing' if memory is None else repr(memory)}"
        )


def _broken(cls: type, *problems: str) -> ConfigError:
    """The error for a class that violates the contract, with its location."""
    try:
        place = f"{inspect.getsourcefile(cls)}:{inspect.getsourcelines(cls)[1]}"
    except (OSError, TypeError):
        place = cls.__module__
    return ConfigError("\n".join(f"{place}: {cls.__name__}{problem}" for problem in problems))
