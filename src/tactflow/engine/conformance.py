"""Validating and constructing stages, sinks and sources (see `tactflow.engine.contract`)."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Collection, Mapping
from dataclasses import fields, replace
from typing import Any, get_args

from tactflow.engine.contract import Memory, Part, Sink, Source, Stage, StageParams
from tactflow.engine.errors import ConfigError
from tactflow.engine.graph import Component, Delivery, Kind
from tactflow.engine.ports import Ports, read_ports

BASES: dict[Kind, type[Part]] = {"source": Source, "stage": Stage, "sink": Sink}
"""Base class of each kind."""

METHODS: dict[Kind, str] = {"source": "frames", "stage": "process", "sink": "write"}
"""The method whose annotations are the ports."""


def kind_of(cls: type[Any]) -> Kind | None:
    """The kind of a class by its base class; None if it is not a part of a pipeline."""
    return next((kind for kind, base in BASES.items() if issubclass(cls, base)), None)


def component(cls: type[Any], name: str, origin: str, reserved: Collection[str]) -> Component:
    """Validate a class, and describe it as a stage, sink or source.

    name, origin : as in `Component`. reserved : names that parameters must not have.

    Raises
    ------
    ConfigError : the class violates the contract; the message starts with the location of the class.
    """
    kind = kind_of(cls)
    problem = _problem(cls, kind, reserved)
    if kind is None or problem is not None:
        try:
            place = f"{inspect.getsourcefile(cls)}:{inspect.getsourcelines(cls)[1]}"
        except (OSError, TypeError):
            place = cls.__module__
        raise ConfigError(f"{place}: {cls.__name__}{problem}")
    memory: Memory = getattr(cls, "memory", "pure")
    ports = Ports((), ()) if kind == "stage" and declares(cls) else read_ports(cls, METHODS[kind])
    delivery = Delivery()
    if kind == "sink":
        delivery = Delivery(**{field.name: getattr(cls, field.name) for field in fields(Delivery)})
    return Component(name, kind, cls, cls.Params, ports, memory, origin, cls, delivery)


def declares(cls: type[Any]) -> bool:
    """Whether the ports of a class depend on its parameters (`Stage.declare`, `Sink.declare`)."""
    bases: tuple[Any, ...] = (Stage, Sink)
    return any(issubclass(cls, base) and cls.declare.__func__ is not base.declare.__func__ for base in bases)


def configured(component: Component, params: StageParams) -> Component:
    """The component with its ports and memory for these parameters."""
    if not declares(component.cls):
        return component
    declared = component.cls.declare(params)
    if component.kind == "sink":
        ports = component.ports
        return replace(component, ports=replace(ports, inputs=[*ports.inputs, *declared]))
    return replace(component, ports=Ports(declared.inputs, declared.outputs), memory=declared.memory)


def accepts(make: Callable[..., Part], argument: str) -> bool:
    """Whether the constructor of a part takes an argument."""
    return argument in inspect.signature(make).parameters


def build(make: Callable[..., Part], params: StageParams, offered: Mapping[str, Any]) -> Part:
    """Construct a part of a pipeline with the arguments that its constructor takes.

    make : as in `Component`. offered : the optional arguments, see `tactflow.engine.contract`.
    """
    parameters = inspect.signature(make).parameters
    return make(params, **{name: value for name, value in offered.items() if name in parameters})


def _problem(cls: type[Any], kind: Kind | None, reserved: Collection[str]) -> str | None:
    """How a class violates the contract, or None."""
    if kind is None:
        return " must inherit from Stage, Sink or Source of tactflow"
    method, params = METHODS[kind], cls.Params
    if getattr(cls, method, None) is getattr(BASES[kind], method, None):
        role = "which yields its frames" if kind == "source" else "whose annotations are its ports"
        return f": a {kind} has a method {method}(), {role}"
    if not (inspect.isclass(params) and issubclass(params, StageParams)):
        return ".Params must be a subclass of tactflow.StageParams"
    for key, field in params.model_fields.items():
        if (field.alias or key) in reserved:
            return f".Params.{key}: that name is a key of the pipeline file"
    if kind == "stage" and getattr(cls, "memory", None) not in get_args(Memory):
        return ' must declare memory = "pure" (its outputs depend on its inputs alone) or memory = "stateful"'
    return None
