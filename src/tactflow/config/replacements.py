"""Find what can take the place of a stage: everything registered with the same ports."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from typing import Any, get_args

from tactflow.config.models import RESERVED
from tactflow.config.registry import catalogue
from tactflow.config.shipped import default_stages
from tactflow.engine.conformance import component, declares, kind_of
from tactflow.engine.errors import ConfigError
from tactflow.engine.frame import Frame
from tactflow.engine.graph import Component
from tactflow.engine.ports import Port, fits


def replacements(stage: Component, used: Iterable[Component] = ()) -> list[Component]:
    """The built-in stages, plug-ins and classes of loose files that can take the place of a stage, by name.

    They provide the same outputs, except for those that may be missing beside others; they require no other
    inputs than it has, except for the frame, which every pipeline has; and every parameter has a default. The
    stage itself is not among them.

    used : the components of a pipeline; other stages in the files of these are considered, too.

    >>> from tactflow.config.registry import resolve
    >>> [found.name for found in replacements(resolve("inpaint", "stages"))]
    ['frequency_selective']
    """
    known = [*catalogue(("stages",))[0], *used]
    known += [other for component in known for other in _beside(component)]
    found = {other.cls: other for other in known if _can_replace(other, stage)}
    return sorted(found.values(), key=lambda other: other.name)


def methods_of(stage: Component) -> tuple[str, ...]:
    """What the parameter `method` of a stage allows; nothing if it has none.

    >>> from tactflow.config.registry import resolve
    >>> methods_of(resolve("flow_in_mask", "stages"))
    ('field', 'mean', 'median')
    """
    field = stage.params.model_fields.get("method")
    return () if field is None else get_args(field.annotation)


def grouped(components: Iterable[Component]) -> list[tuple[Component, list[Component]]]:
    """Components, each with those that can take its place, by name.

    Of stages that can replace each other, that of the shipped default pipeline has the others behind it; they
    have no entry of their own.
    """
    components, usual = list(components), default_stages()
    leaders = [component for component in components if component.name in usual]
    followers = {
        leader.name: [other for other in components if _can_replace(other, leader)] for leader in leaders
    }
    behind = {other.name for others in followers.values() for other in others}
    return [(c, followers.get(c.name, [])) for c in components if c.kind == "sink" or c.name not in behind]


def _can_replace(other: Component, stage: Component) -> bool:
    if other.cls is stage.cls or other.kind != "stage" or declares(other.cls):
        return False
    if any(field.is_required() for field in other.params.model_fields.values()):
        return False
    inputs, outputs = _by_name(stage.ports.inputs), _main_outputs(stage)
    provided = _main_outputs(other)
    return (
        outputs.keys() == provided.keys()
        and all(fits(provided[name], port) for name, port in outputs.items())
        and all(
            port.optional
            or port.annotation is Frame
            or (port.name in inputs and fits(inputs[port.name], port))
            for port in other.ports.inputs
        )
    )


def _main_outputs(stage: Component) -> dict[str, Port]:
    """The outputs that are never missing; all where there are none."""
    return _by_name(port for port in stage.ports.outputs if not port.optional) or _by_name(
        stage.ports.outputs
    )


def _by_name(ports: Iterable[Port]) -> dict[str, Port]:
    return {port.name: port for port in ports}


def _beside(used: Component) -> list[Component]:
    """The other stages in the loose file of a component, named `FILE:Class`."""
    file = used.name.partition(":")[0]
    if not file.endswith(".py"):
        return []
    found = []
    for name, cls in vars(sys.modules[used.cls.__module__]).items():
        if _is_own_stage(cls, used.cls.__module__) and cls is not used.cls:
            try:
                found.append(component(cls, f"{file}:{name}", used.origin, RESERVED))
            except ConfigError:
                # It is not used, so its mistakes do not matter.
                continue
    return found


def _is_own_stage(cls: Any, module: str) -> bool:
    is_public = isinstance(cls, type) and cls.__module__ == module and cls.__name__[0] != "_"
    return is_public and kind_of(cls) == "stage"
