"""What a stage or sink may ask of the run it belongs to."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

from tactflow.engine.contract import Recorder, Source
from tactflow.engine.graph import Pipeline


class Control(Protocol):
    """A handle on the run, given to a stage or sink whose constructor has a parameter `control`.

    All methods may be called from any thread and return at once.
    """

    def stop(self, reason: str = "signal") -> None:
        """End the run soon: no more frames are captured, those under way are finished."""

    def pause(self, paused: bool) -> None:
        """Pause or resume capturing. A recording waits; a live source's frames are dropped."""

    @property
    def paused(self) -> bool:
        """Whether capturing is paused."""

    @property
    def hurried(self) -> bool:
        """Whether the run was asked to end before its source did: slow readers are no longer waited for."""

    def step(self) -> None:
        """While paused, let one frame through."""

    def retake_reference(self) -> None:
        """Take the next frames as a new reference."""

    def snapshot(self) -> Mapping[str, Any]:
        """The run's statistics so far, as in the statistics file."""

    @property
    def source(self) -> Source | None:
        """The source stage's instance, once it is built."""

    @property
    def pipeline(self) -> Pipeline:
        """What is run."""

    def recorder(self) -> Recorder | None:
        """The first sink that can be told to record, or None."""
