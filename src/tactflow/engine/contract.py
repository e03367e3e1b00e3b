"""What a stage, a sink and a source are: the classes that a pipeline is built of inherit from these.

This file is the reference. Each class attribute below may be set and each method overridden; everything has
the default that stands here.

All three kinds are built from their parameters, as in `Invert(Invert.Params())`, and can be called without
the engine. A constructor that takes more than `params` is given, by name, what it asks for:

    sensor : str              name of the sensor
    directory : Path          folder of the pipeline file, against which relative paths are read
    skipping : bool           whether the run may skip work
    control : Control         handle on the run, see `tactflow.engine.control`
    calibration : Path | None the sensor's calibration file, if the pipeline names one

For each run, `open()` is called once before the first frame, and `close()` once at the end for every
part whose `open()` was started, also after an error.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple, Self

from pydantic import BaseModel, ConfigDict

from tactflow.engine.frame import Frame
from tactflow.engine.ports import Port

Memory = Literal["pure", "stateful"]
WhenLive = Literal["block", "latest"]


class StageParams(BaseModel):
    """Base of all parameters: frozen, unknown keys refused, finite numbers only.

    >>> from pydantic import Field
    >>> class Params(StageParams):
    ...     strength: float = Field(1.0, ge=0, le=1, description="0 keeps the image, 1 inverts it")
    >>> Params(strength=0.5)
    Params(strength=0.5)
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, validate_default=True)

    def needed_inputs(self) -> Mapping[str, str]:
        """Optional inputs that these settings cannot do without: port -> the parameter that needs it."""
        return {}

    def unused_inputs(self) -> Collection[str]:
        """Optional inputs that these settings make no use of: they are not connected, and nothing is computed
        for them."""
        return ()

    def changed(self, **values: Any) -> Self:
        """A copy with other values; they are not validated again."""
        return self.model_copy(update=values)


class Part:
    """What stages, sinks and sources have in common."""

    Params: ClassVar[type[StageParams]] = StageParams
    """The parameters that stand in the pipeline file; an inner class."""

    description: str | None = None
    """For people: what it reads or where it writes. May be set by the constructor or by `open`."""

    params: Any
    """Its parameters. Every part keeps them, whether or not its constructor calls that of this class."""

    def __new__(cls, params: Any = None, *_: Any, **__: Any) -> Self:
        """Keep the parameters."""
        part = super().__new__(cls)
        part.params = params
        return part

    def __init__(self, params: Any) -> None:
        """Prepare; nothing is opened yet.

        params : of the class's own `Params`.
        """

    def open(self) -> None:
        """Take what the run needs: files, sockets, devices.

        Raises
        ------
        StageError from a stage or a sink, SourceError from a source: what is wrong, and what to do.
        """

    def close(self) -> None:
        """Give it back. Called once after `open` was started, in the reverse order of opening."""


class Declared(NamedTuple):
    """What `Stage.declare` returns: the ports, in the order in which `process` takes inputs and returns a
    tuple of outputs, and the memory."""

    inputs: Sequence[Port]
    outputs: Sequence[Port]
    memory: Memory


class Stage(Part):
    """Computes outputs from inputs, frame by frame.

    Its ports are read from the annotations of `process`, which every stage defines:

    - an input for each parameter, named like it; `X | None` marks an input that may be absent.
    - one output named after the type returned, or one for each field of a NamedTuple (a number is a field
      such as `brightness: float`). `process` may return `Absent("reason")` instead; `None` is
      `Absent("none")`.

    What a stage returns it must not change later; what it receives it must not change at all.

    >>> from tactflow.ports import Image
    >>> class Invert(Stage):
    ...     memory = "pure"
    ...     def process(self, image: Image) -> Image:
    ...         return 255 - image
    >>> import numpy as np
    >>> Invert(Invert.Params()).process(np.zeros((1, 1, 3), np.uint8)).ravel()
    array([255, 255, 255], dtype=uint8)
    """

    memory: ClassVar[Memory]
    """Required. "pure": the outputs depend on the inputs alone, so the stage may be left out of a frame that
    nobody asks for, and results may be reused. "stateful": it sees every accepted frame, in order."""

    on_demand: ClassVar[bool] = False
    """Whether it waits in pipelines for a sink that may be added. That nothing needs it is then not worth a
    warning, and collecting every port leaves it out."""

    watches: ClassVar[str | None] = None
    """A signal of stages below that it wants to know from the frame before, by the name of its port."""

    watched: bool = False
    """The value of that signal, set by the engine before `process`: of the last stage that has it. True where
    it is not known: it is absent, or computed in another segment. False before the first frame, and where no
    stage has it."""

    wants_reference: str | None = None
    """Why a new reference is needed, a short snake_case word, or None. `process` sets it on `self`; the
    engine clears it and makes the next frame a reference in a new epoch, so that all stages are reset. With
    all stages in one segment, the default, it is the very next frame; else the source is asked to retake."""

    process: Callable[..., Any]
    """Computes the outputs of one frame; see above."""

    @classmethod
    def declare(cls, params: Any) -> Declared | None:  # noqa: ARG003 (for stages whose ports are settings)
        """Ports and memory, for a stage in which these depend on its parameters.

        None, the default: ports are the annotations of `process`, and `memory` is that of the class.

        >>> class Mean(Stage):
        ...     memory = "pure"
        ...     class Params(StageParams):
        ...         port: str = "image"
        ...     @classmethod
        ...     def declare(cls, params: Params) -> Declared:
        ...         return Declared([Port(params.port, Any)], [Port(f"{params.port}_mean", float)], "pure")
        ...     def process(self, *inputs: Any) -> tuple[float]:
        ...         return (float(inputs[0].mean()),)
        """
        return None

    def reset(self) -> None:
        """Forget everything: a new reference follows (`Frame.epoch` has grown)."""


@dataclass(frozen=True, slots=True)
class Output:
    """A file or folder that a sink writes.

    path : where it is. kind : what it is. parameter : the one that names it. refuses_existing : that `open`
    fails if there is something in it; the sink itself must check.
    """

    path: Path
    kind: Literal["file", "folder"]
    parameter: str
    refuses_existing: bool = False


@dataclass(frozen=True, slots=True)
class Publication:
    """An address at which a sink publishes.

    backlog : messages that may wait there for each subscriber. keys : folder that says who may read; None:
    everybody who can reach the address. linger : time to deliver the last messages at the end, s.
    """

    address: str
    backlog: int
    keys: str | None = None
    linger: float = 1.0


class Sink(Part):
    """Takes results out of the run.

    Its inputs are read from the annotations of `write`, which every sink defines and which returns nothing:
    single ports as for a stage, or a result, which has the frame, the ports that its class names, and the
    reasons of what is missing; `tick: Tick` is the frame and the ports that are named next to it.

    >>> from tactflow import Result
    >>> class Print(Sink):
    ...     def write(self, result: Result) -> None:
    ...         print(result.seq, result.contact)
    >>> Print(Print.Params()).observer
    False
    """

    threaded: ClassVar[bool] = False
    """Whether it runs in a thread of its own: for one that is slow or may have to wait."""

    when_live: ClassVar[WhenLive] = "block"
    """What happens in a live run while it is busy. "block": every frame waits for it, nothing is lost
    (files). "latest": it gets the newest frame when it is ready again (messages, pictures)."""

    queue_capacity: ClassVar[int] = 4
    """Frames that may wait in front of its thread."""

    observer: ClassVar[bool] = False
    """Whether it only looks on: it does not count in the latency, and an error disables it instead of ending
    the run."""

    takes_references: ClassVar[bool] = False
    """Whether it gets every reference frame even while it wants nothing, and a reference image that is not
    part of the source (`Frame.seq` -1)."""

    def wants(self) -> bool:
        """Whether the next frame is of interest. What no sink wants is not computed.

        Asked once a frame by the capturing thread: it must be quick and safe to call from any thread.
        """
        return True

    def counters(self) -> Mapping[str, int]:
        """What it has done, for the statistics: name -> number. From any thread."""
        return {}

    @classmethod
    def outputs(cls, params: Any) -> Sequence[Output]:  # noqa: ARG003 (for sinks that write files)
        """The files and folders that a sink with these parameters writes; not standard output, no devices.

        Two sinks that write the same file are refused, and a run of several sensors watches over them.
        """
        return ()

    @classmethod
    def on_restart(cls, params: Any) -> StageParams:
        """The parameters with which it goes on when its sensor is started again in the same run.

        For a sink that can continue its file. The others keep their parameters.
        """
        kept: StageParams = params
        return kept

    @classmethod
    def binds(cls, params: Any) -> Mapping[str, str]:  # noqa: ARG003 (for sinks that listen)
        """The addresses that it takes for itself alone: parameter -> address; not those of `publishes`.

        Several sensors with one address are refused. An address that picks a free port is left out.
        """
        return {}

    @classmethod
    def publishes(cls, params: Any) -> Publication | None:  # noqa: ARG003 (for sinks that publish)
        """Where it publishes messages over ZeroMQ that a relay of several sensors can pass on, or None."""
        return None

    @classmethod
    def among(cls, params: Any, folder: Path, address: str | None) -> StageParams:  # noqa: ARG003
        """The same parameters for one of several sensors that run side by side.

        folder : theirs alone, for what they tell each other; removed at the end. address : where a sink that
        `publishes` does so instead, if a relay publishes for all of them; else None.
        """
        kept: StageParams = params
        return kept


class Recorder(Sink):
    """A sink that can be told to record. All of this may be called from any thread."""

    @property
    def recording(self) -> bool:
        """Whether it is recording."""
        return False

    def start_recording(self) -> None:
        """Begin a recording; nothing if it is recording. Raises StageError if that is not possible."""

    def stop_recording(self) -> None:
        """Finish the recording; nothing if there is none."""


class Source(Part):
    """Where frames come from: the first stage of a pipeline.

    It defines `frames(self) -> Iterator[Frame]`, an iterator that ends where the source ends.

    >>> import numpy as np
    >>> class Black(Source):
    ...     def frames(self) -> Iterator[Frame]:
    ...         for seq in range(3):
    ...             yield Frame("main", seq, seq / 30, np.zeros((4, 6, 3), np.uint8), reference=seq == 0)
    >>> [frame.seq for frame in Black(Black.Params()).frames()]
    [0, 1, 2]

    `live`, `total` and `pictures` are known once it is open.
    """

    live: bool = False
    """Whether frames come by themselves, at their own pace: then those that come too fast are dropped."""

    total: int | None = None
    """How many frames there will be, where that is known."""

    pictures: bool = False
    """Whether frames are pictures in files of their own, which may show moments far apart."""

    @property
    def missed(self) -> int:
        """Frames that a newer one overtook before they were taken; each leaves a gap in `Frame.seq`."""
        return 0

    @property
    def state(self) -> str:
        """In words, for people: `running`, `reconnecting since 3 s`."""
        return "running"

    def frames(self) -> Iterator[Frame]:
        """Every frame, in order, until the end or `stop`."""
        raise NotImplementedError

    def stop(self) -> None:
        """End `frames` soon, also where it waits for the next frame. From any thread."""

    def retake(self) -> None:
        """Take the next frames as a new reference, in a new epoch. From any thread."""
