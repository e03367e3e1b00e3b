"""Base classes of stages, sinks and sources, the parts of a pipeline.

This file is the reference. Subclasses may set each class attribute and override each method below; the
defaults are given here.

A part is constructed from its parameters, as in `Invert(Invert.Params())`, and can be used without the
engine. A constructor may also take, by name:

    sensor : str              name of the sensor
    directory : Path          folder of the pipeline file, for relative paths
    skipping : bool           whether the run may skip work
    control : Control         handle on the run, see `tactflow.engine.control`
    calibration : Calibration | None, the sensor's, read once for all parts; None if the pipeline names none

In each run, `open()` is called once before the first frame, and `close()` once at the end for every part
whose `open()` was started, even after an error. `begin()` of a sink follows when all parts are open.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple, Self

from pydantic import BaseModel, ConfigDict

from tactflow.engine.frame import Frame
from tactflow.engine.once import Once
from tactflow.engine.ports import Port

Memory = Literal["pure", "stateful"]
WhenLive = Literal["block", "latest"]


class StageParams(BaseModel):
    """Base class of parameters: frozen, finite numbers only; unknown keys are errors.

    >>> from pydantic import Field
    >>> class Params(StageParams):
    ...     strength: float = Field(1.0, ge=0, le=1, description="0 keeps the image, 1 inverts it")
    >>> Params(strength=0.5)
    Params(strength=0.5)
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, validate_default=True)

    def needed_inputs(self) -> Mapping[str, str]:
        """Optional inputs that are required with these settings: port -> the parameter that requires it."""
        return {}

    def unused_inputs(self) -> Collection[str]:
        """Optional inputs that are unused with these settings, so that they are neither connected nor
        computed."""
        return ()

    def changed(self, **values: Any) -> Self:
        """A copy with changed values, which are not validated."""
        return self.model_copy(update=values)


class Part:
    """Common base of stages, sinks and sources."""

    Params: ClassVar[type[StageParams]] = StageParams
    """The parameters in the pipeline file; an inner class."""

    description: str | None = None
    """What it reads or where it writes, for messages. May be set by the constructor or by `open`."""

    params: Any
    """Its parameters, even if its constructor does not call `super().__init__`."""

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
        """Open files, sockets, devices.

        Raises
        ------
        StageError from a stage or a sink, SourceError from a source, with a remedy.
        """

    def close(self) -> None:
        """Release resources. Called once if `open` was started, in the reverse order of opening."""


class Declared(NamedTuple):
    """The result of `Stage.declare`: ports in the order of the arguments of `process` and of its results."""

    inputs: Sequence[Port]
    outputs: Sequence[Port]
    memory: Memory


class Stage(Part):
    """Computes outputs from inputs, frame by frame.

    Its ports are the annotations of `process`, which every stage defines. Each parameter is an input of its
    name; `X | None` marks one that may be absent. The output is named after the returned type; each field of
    a NamedTuple is an output, such as `brightness: float`. `process` may return `Absent("reason")` instead;
    `None` means `Absent("none")`.

    A stage must not modify its inputs, nor its outputs after returning them.

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
    """Required. "pure": outputs depend on the inputs alone, so that the stage may be skipped if its outputs
    are not requested, and its results reused. "stateful": it processes every accepted frame, in order."""

    on_demand: ClassVar[bool] = False
    """Whether it runs only for a sink that may be added. No warning is given if no sink needs it, and
    collecting all ports leaves it out."""

    watches: ClassVar[str | None] = None
    """Port of a signal of later stages whose value in the previous frame it needs, see `watched`."""

    watched: bool = False
    """The value of that signal, set by the engine before `process`, from the last stage that has it. True if
    unknown (absent, or computed in another segment). False before the first frame, and if no stage has it."""

    wants_reference: str | None = None
    """The reason for requesting a new reference, in snake_case, or None. `process` sets it on `self`; the
    engine clears it and makes a frame the reference of a new epoch, which resets all stages: the next frame
    if all stages are in one segment, as by default; else the source is asked to retake."""

    @cached_property
    def once(self) -> Once:
        """Keeps what depends on the reference or on settings alone, for all stages of a run.

        `rest = self.once(Rest, untouched)` computes `Rest(untouched)` when there is another `untouched`.
        """
        return Once()

    process: Callable[..., Any]
    """Computes the outputs of a frame, see above."""

    @classmethod
    def declare(cls, params: Any) -> Declared | None:  # noqa: ARG003 (for stages whose ports are settings)
        """Ports and memory, if they depend on the parameters.

        None, the default: the ports are the annotations of `process`, the memory is that of the class.
        """
        return None

    def reset(self) -> None:
        """Clear the state: a new reference follows, in a new epoch."""


class Sink(Part):
    """Writes, publishes or shows results.

    Its inputs are the annotations of `write`, which every sink defines: ports as for a stage. The first
    parameter may be a result: the frame, the ports that its class names, and the reasons for missing values.
    `tick: Tick` has the frame and the ports that follow.

    >>> from tactflow import Result
    >>> class Print(Sink):
    ...     def write(self, result: Result) -> None:
    ...         print(result.seq, result.contact)
    >>> Print(Print.Params()).observer
    False
    """

    threaded: ClassVar[bool] = False
    """Whether it runs in its own thread: for a sink that is slow or may block."""

    when_live: ClassVar[WhenLive] = "block"
    """Policy in a live run while the sink is busy. "block": frames wait, nothing is lost (files). "latest":
    it gets the newest frame when it is ready again (messages, pictures)."""

    queue_capacity: ClassVar[int] = 4
    """Length of the queue in front of its thread, frames."""

    observer: ClassVar[bool] = False
    """Whether it only shows results: it does not count for the latency, and an error disables it instead of
    ending the run."""

    takes_references: ClassVar[bool] = False
    """Whether it gets every reference frame even if it wants none, and a reference image that is not part of
    the source (`Frame.seq` -1)."""

    @classmethod
    def declare(cls, params: Any) -> Sequence[Port] | None:  # noqa: ARG003 (for sinks whose ports are settings)
        """Further inputs that depend on the parameters; `write` takes their values as `*values`.

        None, the default: the annotations of `write` name all inputs.
        """
        return None

    def begin(self) -> None:
        """Replace earlier output. Called once when every part of the run is open, before the first frame.

        If a part cannot be opened, the run ends without it, and earlier output stays.
        """

    def wants(self) -> bool:
        """Whether it wants the next frame. Values that no sink wants are not computed.

        Called once per frame by the capturing thread: it must be fast and thread-safe.
        """
        return True

    def counters(self) -> Mapping[str, int]:
        """Counters for the statistics: name -> number. Thread-safe."""
        return {}

    @classmethod
    def outputs(cls, params: Any) -> Mapping[str, Path]:  # noqa: ARG003 (for sinks that write files)
        """The files and folders that a sink with these parameters writes: parameter with the path -> path.

        Without standard output and devices. Two sinks that write the same file are an error.
        """
        return {}


class Recorder(Sink):
    """A sink whose recording can be started and stopped, from any thread."""

    verdict = ""
    """Whether the last finished recording is good, in one line; "" before."""

    @property
    def recording(self) -> bool:
        """Whether it is recording."""
        return False

    def start_recording(self) -> None:
        """Start a recording, unless one is running. Raises StageError if that is not possible."""

    def stop_recording(self) -> None:
        """Finish the recording, if any."""


class Source(Part):
    """Provides the frames: the first stage of a pipeline.

    It defines `frames(self) -> Iterator[Frame]`, which ends with the source.

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
    """Whether frames arrive at their own pace; those that arrive too fast are dropped."""

    total: int | None = None
    """Number of frames, if known."""

    pictures: bool = False
    """Whether each frame is a picture file, so that frames may show moments far apart."""

    @property
    def missed(self) -> int:
        """Number of frames that a newer one replaced before they were read: gaps in `Frame.seq`."""
        return 0

    @property
    def state(self) -> str:
        """State in words: `running`, `reconnecting since 3 s`."""
        return "running"

    def frames(self) -> Iterator[Frame]:
        """All frames in order, until the end or `stop`."""
        raise NotImplementedError

    def stop(self) -> None:
        """End `frames` soon, even while it waits for the next frame. Thread-safe."""

    def retake(self) -> None:
        """Take the next frames as a new reference, in a new epoch. Thread-safe."""
