"""Control of a run by its stages and sinks."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

from tactflow.engine.contract import Recorder, Source
from tactflow.engine.graph import Pipeline


class Control(Protocol):
    """A handle on the run, for a stage or sink whose constructor has a parameter `control`.

    All methods are thread-safe and return immediately.
    """

    def stop(self, reason: str = "signal") -> None:
        """End the run: capture no more frames, and finish pending ones."""

    def pause(self, paused: bool) -> None:
        """Pause or resume capturing. A recording waits; a live source's frames are dropped."""

    @property
    def paused(self) -> bool:
        """Whether capturing is paused."""

    @property
    def hurried(self) -> bool:
        """Whether the run was stopped before the end of its source, so that it no longer waits for slow
        readers."""

    def step(self) -> None:
        """While paused, process one frame."""

    def retake_reference(self) -> None:
        """Take the next frames as a new reference."""

    def snapshot(self) -> Mapping[str, Any]:
        """The statistics so far, as in the statistics file."""

    @property
    def source(self) -> Source | None:
        """The source, once it is constructed."""

    @property
    def pipeline(self) -> Pipeline:
        """The pipeline of the run."""

    def recorder(self) -> Recorder | None:
        """The first sink that can record, or None."""
