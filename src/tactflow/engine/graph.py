"""A validated pipeline: nodes and the edges between their ports. Built by `config`, read by `plan`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, Self

from pydantic import BaseModel, Field

from tactflow.engine.contract import Memory, Part, StageParams, WhenLive
from tactflow.engine.ports import Ports

Kind = Literal["source", "stage", "sink"]
FullPolicy = Literal["block", "latest", "drop_oldest"]
ErrorAction = Literal["stop", "skip_frame", "disable"]


@dataclass(frozen=True, slots=True)
class Mark:
    """A place in a pipeline file (line and column from 1), or the command-line option behind a value."""

    file: str
    line: int
    column: int

    def __str__(self) -> str:
        return f"{self.file}:{self.line}:{self.column}" if self.line else self.file


@dataclass(frozen=True, slots=True)
class Delivery:
    """How a sink gets its frames. The attributes are those of `tactflow.engine.contract.Sink`."""

    threaded: bool = False
    when_live: WhenLive = "block"
    queue_capacity: int = 4
    observer: bool = False
    takes_references: bool = False


@dataclass(frozen=True, slots=True)
class Component:
    """A stage or sink, as named by `use:`.

    Attributes
    ----------
    name : as in `use:`.
    cls, params : the class, and the model of its parameters.
    ports : from its annotations.
    memory : always "pure" for sources and sinks.
    origin : for messages ("built-in", "plug-in NAME VERSION", a file, a module).
    make : constructs an instance from parameters; the class, or a function that calls it.
    delivery : of a sink.
    """

    name: str
    kind: Kind
    cls: type[Any]
    params: type[StageParams]
    ports: Ports
    memory: Memory
    origin: str
    make: Callable[..., Part]
    delivery: Delivery = Delivery()

    def with_arguments(self, **arguments: Any) -> Self:
        """The component whose instances are constructed with further arguments."""
        return replace(self, make=partial(self.make, **arguments))


@dataclass(frozen=True, slots=True)
class Ref:
    """An output port of a node."""

    node: str
    port: str

    def __str__(self) -> str:
        return f"{self.node}.{self.port}"


@dataclass(frozen=True, slots=True)
class Gate:
    """Runs a stage only while a signal is True.

    Attributes
    ----------
    signal : the boolean port.
    reason : of the absent outputs while the gate is closed.
    otherwise : "absent" makes the outputs `Absent(reason)`; "repeat" repeats the last outputs (absent if
        there are none).
    """

    signal: Ref
    reason: str
    otherwise: Literal["absent", "repeat"] = "absent"


class Queue(BaseModel, frozen=True, extra="forbid", strict=True):
    """The bounded queue in front of a segment."""

    capacity: int | None = Field(
        default=None, ge=1, description="frames it holds; null: the planner's choice"
    )
    when_full: FullPolicy | None = Field(
        default=None,
        description="block: the segment before it waits, nothing is lost; latest: only the newest frame is "
        "kept; drop_oldest: the oldest frame is dropped; null: the planner's choice",
    )


class OnError(BaseModel, frozen=True, extra="forbid", strict=True):
    """What happens when a stage or sink fails."""

    action: ErrorAction = Field(
        default="stop",
        description="stop: the run ends; skip_frame: the frame continues without its outputs; disable: it is "
        "not called again",
    )
    budget: int = Field(default=10, ge=0, description="frames that skip_frame may skip before the run ends")


@dataclass(frozen=True, slots=True)
class Node:
    """One stage or sink of a pipeline.

    Attributes
    ----------
    inputs : every input port of the component -> connected output, or None for an unconnected optional
        input.
    mark : location of its definition.
    gates : all must be open for it to run.
    segment : name in the file, or None.
    queue : in front of its segment.
    max_rate : limit of a sink, Hz.
    passive_inputs : names in a sink's result -> outputs that are included if they were computed for other
        nodes, but never requested.
    """

    id: str
    component: Component
    params: StageParams
    inputs: Mapping[str, Ref | None]
    mark: Mark
    gates: Sequence[Gate] = ()
    segment: str | None = None
    queue: Queue = field(default_factory=Queue)
    on_error: OnError = field(default_factory=OnError)
    max_rate: float | None = None
    passive_inputs: Mapping[str, Ref] = field(default_factory=dict[str, Ref])


@dataclass(frozen=True, slots=True)
class Pipeline:
    """A validated pipeline. `nodes` is in topological order: producers come before consumers.

    Attributes
    ----------
    file, directory : of the pipeline file.
    nodes : id -> node.
    skipping : whether work may be skipped.
    opencv_threads : None leaves the number to OpenCV.
    calibration : the sensor's calibration file, or None.
    warnings : for the user, before the run.
    settings : the file with all overrides, as plain values that can be written as YAML.
    """

    file: str
    directory: Path
    sensor: str
    nodes: Mapping[str, Node]
    skipping: bool = True
    opencv_threads: int | None = None
    calibration: Path | None = None
    warnings: Sequence[str] = field(default_factory=list[str])
    settings: Mapping[str, Any] = field(default_factory=dict[str, Any])

    @property
    def source(self) -> Node:
        """The node that captures frames."""
        return next(node for node in self.nodes.values() if node.component.kind == "source")

    @property
    def sinks(self) -> Sequence[Node]:
        """The nodes that publish or write."""
        return [node for node in self.nodes.values() if node.component.kind == "sink"]

    @property
    def ports(self) -> frozenset[str]:
        """Names of the outputs of all stages."""
        return frozenset(port.name for node in self.nodes.values() for port in node.component.ports.outputs)
