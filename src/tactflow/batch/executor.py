"""The seam between a batch and what it runs on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from tactflow.batch.task import Outcome, Status, Task
from tactflow.system.clock import SYSTEM


@dataclass(frozen=True, slots=True)
class Headway:
    """How far a worker is. task : None while it has none. total : frames, None if unknown."""

    worker: str
    task: Task | None
    frames: int = 0
    total: int | None = None


class Executor(Protocol):
    """Works on tasks, several at a time. Every task that is submitted comes back as one outcome.

    description : for people. window : tasks that keep it busy.
    """

    description: str

    @property
    def window(self) -> int: ...

    def submit(self, task: Task) -> None:
        """Begin a task as soon as a worker is free.

        Raises
        ------
        StageError : the executor is gone.
        """
        ...

    def finished(self, timeout: float) -> Sequence[Outcome]:
        """What has ended since the last call; waits up to `timeout` seconds for something.

        Raises
        ------
        StageError : the executor is gone; what it had is lost, and may be done again.
        """
        ...

    def headway(self) -> Sequence[Headway]:
        """What each worker is doing, as far as it is known."""
        ...

    def close(self, *, kill: bool) -> None:
        """End the workers. kill : at once, whatever they are doing."""
        ...


def died(task: Task, status: Status, why: str) -> Outcome:
    """The outcome of a task that no worker has told about."""
    return Outcome(
        task.recording.source,
        task.recording.name,
        status,
        error=why,
        pipeline=task.pipeline.digest,
        started=SYSTEM.unix(),
    )
