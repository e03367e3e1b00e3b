"""What a pipeline file may say, apart from the parameters of its stages and sinks.

From these models come both the checks of a file and its JSON Schema. What depends on several parts of a file
(wiring, gates, sensors) is checked in code beside them.
"""

from __future__ import annotations

import re
from typing import Annotated, Any, Final, Literal, LiteralString

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    StringConstraints,
    ValidationError,
    ValidatorFunctionWrapHandler,
    WrapValidator,
)
from pydantic_core import PydanticCustomError

from tactflow.engine.graph import ErrorAction, FullPolicy

STATISTICS = "stats"
"""The topic of a run's statistics, so that no sensor may have this name."""

WORD = "^[A-Za-z0-9_-]+$"

MOST_THREADS: Final = 1024
"""OpenCV starts as many threads as it is told, and the system refuses some ten thousand. Chosen by hand: more
than a computer has processors."""


def is_word(text: str) -> bool:
    """True for a word of ASCII letters, digits, `_` and `-`, such as every id is.

    >>> is_word("marker_mask"), is_word("left hand")
    (True, False)
    """
    return re.fullmatch(WORD[1:-1], text) is not None


def _says(words: LiteralString) -> WrapValidator:
    """Report any wrong value as "expected ..." in these words."""
    return _fails_with(PydanticCustomError("expected", words))


def _fails_with(mistake: ValueError) -> WrapValidator:
    def check(value: Any, handler: ValidatorFunctionWrapHandler) -> Any:
        try:
            return handler(value)
        except ValidationError:
            raise mistake from None

    return WrapValidator(check)


def _mapping(words: LiteralString) -> BeforeValidator:
    """Report what is no mapping as "expected a mapping ..."; its parts are reported by themselves.

    A key with nothing after it is an empty mapping.
    """

    def check(value: Any) -> Any:
        if value is None:
            return {}
        if not isinstance(value, dict):
            raise PydanticCustomError("expected", words)
        return value

    return BeforeValidator(check)


def _free(name: str) -> str:
    if name == STATISTICS:
        raise ValueError(f"{name} is the topic of a run's statistics; give the sensor another name")
    return name


def _at_least_one(sensors: dict[str, Any]) -> dict[str, Any]:
    if not sensors:
        raise PydanticCustomError(
            "expected", "a name -> changes for each sensor, as in {left: {stages: ...}, right: {}}"
        )
    return sensors


Word = Annotated[str, StringConstraints(pattern=WORD), _says("a word of letters, digits, _ and -")]
Id = Annotated[
    str,
    StringConstraints(pattern=WORD),
    _fails_with(ValueError("an id is a word of letters, digits, _ and -")),
]
Sensor = Annotated[Word, AfterValidator(_free)]
SensorKey = Annotated[
    str,
    StringConstraints(pattern=WORD),
    _fails_with(ValueError("a name is a word of letters, digits, _ and -")),
    AfterValidator(_free),
]
Count = Annotated[int, Field(ge=0), _says("a whole number >= 0")]
Threads = Annotated[int, Field(ge=0, le=MOST_THREADS), _says(f"a whole number >= 0 and <= {MOST_THREADS}")]
Capacity = Annotated[int, Field(ge=1), _says("a whole number >= 1")]
Rate = Annotated[float, Field(gt=0, allow_inf_nan=False), _says("a rate in Hz, > 0")]
Output = Annotated[str, _says("stage.port")]
Signal = Annotated[str, _says("the name of a signal or stage.port")]


class Part(BaseModel):
    """Base of all parts of a pipeline file: unknown keys are mistakes, and no value is converted."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


class Queue(Part):
    """The bounded queue in front of a segment."""

    capacity: Capacity | None = Field(None, description="frames it holds; null: the planner's choice")
    when_full: FullPolicy | None = Field(
        None,
        description="block: whoever puts waits, nothing is lost; latest: only the newest frame is kept; "
        "drop_oldest: the oldest frame makes room; null: the planner's choice",
    )


class OnError(Part):
    """What happens when a stage or sink fails."""

    action: ErrorAction = Field(
        "stop",
        description="stop: the run ends; skip_frame: the frame goes on without its outputs; disable: it is "
        "not called again",
    )
    budget: Count = Field(10, description="frames that skip_frame may skip before the run ends")


class Gate(Part):
    """A stage runs only while a signal is true."""

    signal: Signal = Field(description="the signal: the name of a bool port, or stage.port")
    otherwise: Literal["absent", "repeat"] | None = Field(
        None,
        description="what the outputs are while the gate is closed: absent, or repeat for the last ones "
        "again; null: the signal's own choice",
    )
    reason: Word | None = Field(
        None, description="what `skipped` in the results says then; null: the signal's own word"
    )


def _gates(value: Any) -> Any:
    """One gate or several, each perhaps only the name of its signal, as a list of mappings."""
    gates = value if isinstance(value, list) else [] if value is None else [value]
    return [gate if isinstance(gate, dict) else {"signal": gate} for gate in gates]


def _on_error(value: Any) -> Any:
    return value if isinstance(value, dict | None) else {"action": value}


class Entry(Part):
    """What stages and sinks have in common. Every key that is not named here is a parameter."""

    model_config = ConfigDict(extra="allow")

    inputs: Annotated[dict[str, Output | None], _mapping("a mapping of input -> stage.port")] = Field(
        {},
        alias="in",
        description="input -> the output it takes, as stage.port, or as stage where that has one output; "
        "null: an optional input takes nothing; by default the nearest output of its name above",
    )
    when: Annotated[
        list[Gate],
        BeforeValidator(_gates, json_schema_input_type=None | Signal | Gate | list[Signal | Gate]),
    ] = Field([], description="the signals that must all be true for it to run")
    segment: Word | None = Field(
        None, description="the segment it runs in, one thread each; null: the planner's choice"
    )
    queue: Annotated[Queue, _mapping("a mapping, as in {capacity: 4, when_full: block}")] = Field(
        {}, validate_default=True, description="the queue in front of its segment"
    )
    on_error: Annotated[
        OnError | None, BeforeValidator(_on_error, json_schema_input_type=ErrorAction | OnError | None)
    ] = Field(
        None,
        description="what happens when it fails: an action, or action and budget; null: stop, for a "
        "viewer disable",
    )


_USE = (
    "which {}: a built-in, a plug-in, package.module:Class or ./file.py:Class; by default the one that is "
    "called like the id"
)


class StageEntry(Entry):
    """A stage of a pipeline, beside its parameters."""

    use: Annotated[str, _says("the name of a stage")] = Field("", description=_USE.format("stage"))


class SinkEntry(Entry):
    """A sink of a pipeline, beside its parameters."""

    use: Annotated[str, _says("the name of a sink")] = Field("", description=_USE.format("sink"))
    max_rate: Rate | None = Field(None, description="frames it is given a second at most, Hz; null: all")


class Changes(Part):
    """What one of several sensors changes: the keys of `PipelineFile` that may differ between sensors.

    The values are checked where they are laid over the file's.
    """

    calibration: Any = None
    skipping: Any = None
    opencv_threads: Any = None
    realtime_priority: Any = None
    stages: Any = None
    sinks: Any = None


_Stages = Annotated[
    dict[Id, Annotated[StageEntry, _mapping("a mapping of settings, as in {use: hull}")]],
    _mapping("a mapping of id -> stage"),
]
_Sinks = Annotated[
    dict[Id, Annotated[SinkEntry, _mapping("a mapping of settings, as in {use: jsonl}")]],
    _mapping("a mapping of id -> sink"),
]
_Sensors = Annotated[
    dict[
        SensorKey, Annotated[Changes, _mapping("a mapping of changes, as in {stages: {capture: ...}}")] | None
    ],
    AfterValidator(_at_least_one),
    Field(json_schema_extra={"additionalProperties": False, "minProperties": 1}),
    _mapping("a mapping of name -> changes, as in {left: {stages: ...}}"),
]


class PipelineFile(Part):
    """A pipeline file."""

    sensor: Sensor | None = Field("main", description="the sensor's name in results and topics; null: main")
    sensors: _Sensors = Field(
        {}, description="name -> changes to this file, for several sensors with the same graph"
    )
    calibration: Annotated[str, StringConstraints(min_length=1), _says("the path of a file")] | None = Field(
        None,
        description="the sensor's calibration file, from the folder of this file or the current one; "
        "null: results in pixels only",
    )
    skipping: bool = Field(True, description="false runs every stage in every frame")
    opencv_threads: Threads | None = Field(
        None, description="threads of OpenCV; 1: none beside the caller's; null: OpenCV's choice"
    )
    realtime_priority: bool = Field(
        False, description="true asks the system to run the threads of live frames before all else"
    )
    stages: _Stages = Field(description="id -> stage, in order; the source of frames is one of them")
    sinks: _Sinks = Field({}, description="id -> sink")


RESERVED = frozenset(field.alias or name for name, field in SinkEntry.model_fields.items())
"""Keys of a stage or sink that belong to the engine and so cannot be names of parameters."""
