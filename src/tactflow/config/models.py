"""Models of a pipeline file, without the parameters of its stages and sinks.

They validate a file and give its JSON Schema. Constraints between parts of a file (wiring, gates, sensors)
are checked elsewhere in this package.
"""

from __future__ import annotations

import re
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, StringConstraints

from tactflow.engine.graph import ErrorAction, OnError, Queue

STATISTICS = "stats"
"""Reserved name of a sensor: the topic of statistics."""

WORD = "^[A-Za-z0-9_-]+$"


def is_word(text: str) -> bool:
    """Whether a text is a valid id: ASCII letters, digits, `_` and `-`.

    >>> is_word("marker_mask"), is_word("left hand")
    (True, False)
    """
    return re.fullmatch(WORD[1:-1], text) is not None


def _not_the_topic(name: str) -> str:
    if name == STATISTICS:
        raise ValueError(f"{name} is the topic of a run's statistics; give the sensor another name")
    return name


_EMPTY = BeforeValidator(lambda value: {} if value is None else value)
"""A key without a value is an empty mapping."""

Word = Annotated[str, StringConstraints(pattern=WORD)]
Sensor = Annotated[Word, AfterValidator(_not_the_topic)]


class Part(BaseModel):
    """Base of all parts of a pipeline file: unknown keys are errors, values are not converted."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


def _on_error(value: Any) -> Any:
    return value if isinstance(value, dict | None) else {"action": value}


class Entry(Part):
    """Keys of stages and sinks. All other keys are parameters."""

    model_config = ConfigDict(extra="allow")

    inputs: Annotated[dict[str, str | None], _EMPTY] = Field(
        {},
        alias="in",
        description="input -> the output it takes, as stage.port or port; null leaves an "
        "optional input unconnected; by default the nearest output of its name above",
    )
    when: str | list[str] | None = Field(
        None, description="the signals that must all be true for it to run: bool ports, as port or stage.port"
    )
    segment: Word | None = Field(
        None, description="the segment it runs in, one thread each; null: the planner's choice"
    )
    queue: Annotated[Queue, _EMPTY] = Field(
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
    "which {}: a built-in, a plug-in, package.module:Class or ./file.py:Class; by default the one "
    "named like the id"
)


class StageEntry(Entry):
    """A stage, without its parameters."""

    use: str = Field("", description=_USE.format("stage"))


class SinkEntry(Entry):
    """A sink, without its parameters."""

    use: str = Field("", description=_USE.format("sink"))
    max_rate: float | None = Field(
        None, gt=0, allow_inf_nan=False, description="frames per second at most, Hz; null: all"
    )


class Gel(Part):
    """Properties of the gel, for every stage that has a parameter of the same name and does not set it."""

    repeatability: float | None = Field(
        None, ge=0, le=1, description="variation of the light on the untouched gel, relative; null: 0.025"
    )
    tint: float | None = Field(
        None,
        ge=0,
        le=1,
        description="variation of the colour of that light, relative to its brightness; null: 0.01",
    )
    dot: float | None = Field(
        None, ge=1, le=100, description="radius of a dot, processed px; null finds it in the first frame"
    )
    polarity: Literal["auto", "dark", "bright"] | None = Field(
        None, description="dots against the gel; null: auto"
    )


class Changes(Part):
    """Changes of the file for a sensor: the keys of `PipelineFile` that may differ between sensors.

    The values are validated after merging.
    """

    calibration: Any = None
    gel: Any = None
    skipping: Any = None
    opencv_threads: Any = None
    stages: Any = None
    sinks: Any = None


class PipelineFile(Part):
    """A pipeline file."""

    sensor: Sensor | None = Field("main", description="the sensor's name in results and topics; null: main")
    sensors: Annotated[dict[Sensor, Annotated[Changes, _EMPTY]], Field(min_length=1)] = Field(
        {}, description="name -> changes to this file, for several sensors with the same graph"
    )
    calibration: str | None = Field(
        None,
        min_length=1,
        description="the sensor's calibration file, from the folder of this file or the current one, or the "
        "default of a kind of sensor, mini or digit; null: results in pixels only",
    )
    gel: Annotated[Gel, _EMPTY] = Field(
        {}, validate_default=True, description="properties of the gel that several stages use"
    )
    skipping: bool = Field(True, description="false runs every stage in every frame")
    opencv_threads: int | None = Field(
        None,
        ge=0,
        # The system refuses some ten thousand.
        le=1024,
        description="threads of OpenCV; 1: only the caller's; null: OpenCV's choice",
    )
    stages: Annotated[dict[Word, Annotated[StageEntry, _EMPTY]], _EMPTY] = Field(
        description="id -> stage, in order; the source of frames is one of them"
    )
    sinks: Annotated[dict[Word, Annotated[SinkEntry, _EMPTY]], _EMPTY] = Field({}, description="id -> sink")


RESERVED = frozenset(field.alias or name for name, field in SinkEntry.model_fields.items())
"""Keys of stages and sinks that must not be names of parameters."""
