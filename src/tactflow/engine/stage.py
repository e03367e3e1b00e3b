"""The contract of stages and sinks, and the port types read from their annotations.

A stage is a plain class::

    class Invert:
        \"\"\"Swap dark and bright.\"\"\"

        memory = "pure"                      # or "stateful"

        class Params(StageParams):
            strength: float = Field(1.0, ge=0, le=1, description="0 keeps the image, 1 inverts it")

        def __init__(self, params: Params) -> None: ...
        def process(self, image: Image) -> Image: ...

Its input ports are the parameters of `process`; `X | None` marks an input that may be absent. Its output
ports come from the return annotation: one port named after its type, or one port per field of a
NamedTuple. `process` may return `Absent("reason")` instead. Optional methods: `open()`, `close()`, and for
stateful stages `reset()` (forget everything; a new reference follows).

A pure stage's outputs depend on its inputs alone. A stateful stage sees every accepted frame, in order.
What a stage returns it must not change later; what it receives it must not change at all.

A source stage has `frames()`, an iterator of `Frame`, instead of `process`. A sink has `write`, which
returns nothing and may also take a `Tick`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict

Memory = Literal["pure", "stateful"]


class StageParams(BaseModel):
    """Base of every stage's and sink's parameters: frozen, unknown keys refused, finite numbers only."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, validate_default=True)


@dataclass(frozen=True, slots=True)
class ArrayPort:
    """Type of a port that carries an array; used as `Annotated[NDArray[...], ArrayPort(...)]`.

    name : default name of the port. shape : one entry per axis, an int (exact) or a str (a dimension with
    that name). dtype : numpy dtype name. unit : what one unit of the value means.
    """

    name: str
    shape: tuple[int | str, ...]
    dtype: str
    unit: str


@dataclass(frozen=True, slots=True)
class SignalPort:
    """Type of a boolean port that can gate stages; `closed` is the reason given while it is False."""

    name: str
    closed: str


@dataclass(frozen=True, slots=True)
class Port:
    """One input or output of a stage.

    name : the port's name. annotation : the Python type. optional : True if the input may be absent.
    """

    name: str
    annotation: Any
    optional: bool = False


@dataclass(frozen=True, slots=True)
class Ports:
    """The ports of a stage or sink class, read from its annotations."""

    inputs: Sequence[Port]
    outputs: Sequence[Port]
    takes_tick: bool = False
