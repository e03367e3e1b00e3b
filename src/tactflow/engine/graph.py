"""A validated pipeline: nodes and the edges between their ports. Built by `config`, read by `plan`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, Field

from tactflow.engine.contract import Memory, StageParams
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
class Component:
    """A stage or sink class that `use:` can name.

    name : what `use:` says. cls, params : the class, and the model of its parameters. ports : read from its
    annotations. memory : always "pure" for sources and sinks. origin : where it comes from, for people
    ("built-in", "plug-in NAME VERSION", a file, a module).
    """

    name: str
    kind: Kind
    cls: type[Any]
    params: type[StageParams]
    ports: Ports
    memory: Memory
    origin: str


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

    signal : the boolean port. reason : why outputs are absent while it is closed.
    otherwise : "absent" makes the outputs `Absent(reason)`; "repeat" gives the last outputs again (absent if
    there are none yet).
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
        description="block: whoever puts waits, nothing is lost; latest: only the newest frame is kept; "
        "drop_oldest: the oldest frame makes room; null: the planner's choice",
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

    inputs : every input port of the component -> the output it is connected to, or None for an optional
    input that nothing provides. mark : the place that set it up. gates : all must be open for it to run.
    segment : name given in the file, or None. queue : in front of its segment. max_rate : a sink's limit in
    Hz. marks : key of the node -> the place of its value, for those that the plan may refuse.
    passive_inputs : names in a sink's result -> outputs that it holds where the tick has computed them for
    others; they are never a reason to compute anything.
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
    marks: Mapping[str, Mark] = field(default_factory=dict[str, Mark])
    passive_inputs: Mapping[str, Ref] = field(default_factory=dict[str, Ref])


@dataclass(frozen=True, slots=True)
class Pipeline:
    """A pipeline that is known to be right. `nodes` is ordered so that every input comes before its user.

    file, directory : where it was read from. nodes : id -> node. skipping : whether work may be skipped.
    opencv_threads : None leaves them to OpenCV. runs : sensors of the same file, each with a run of its own.
    calibration : the sensor's calibration file, or None. warnings : what the user should know before the run.
    settings : what the file and all overrides come to, as plain values that can be written as YAML again.
    """

    file: str
    directory: Path
    sensor: str
    nodes: Mapping[str, Node]
    skipping: bool = True
    opencv_threads: int | None = None
    runs: int = 1
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
