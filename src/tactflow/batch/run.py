"""Decides what is missing, hands it to workers, and ends well."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path

from tactflow.batch.recordings import Recording
from tactflow.batch.store import Outcome, Store
from tactflow.batch.work import Request, Task
from tactflow.batch.workers import SCHEDULER_GONE, Workers
from tactflow.engine.errors import StageError

LOOK_EVERY = 0.2
"""Time between two looks at signals, s: faster than people notice."""
MOST_DEATHS = 3
"""Recordings in a row that each kill a worker of their own: more likely is that no worker can run here."""


@dataclass(frozen=True, slots=True)
class Plan:
    """done : source -> outcome of an earlier call. left : what is to be done. changed : how many of these had
    been done of another input, pipeline or version; the others are new or had failed."""

    done: Mapping[str, Outcome]
    left: Sequence[Recording]
    changed: int

    def __str__(self) -> str:
        total = len(self.done) + len(self.left)
        parts = [f"{total} recording{'' if total == 1 else 's'}"]
        if self.done:
            parts.append(f"{len(self.done)} done before")
        if self.changed:
            parts.append(f"{self.changed} done of another input, pipeline or version")
        if self.done or self.changed:
            parts.append(f"{len(self.left) - self.changed} new or failed before")
        return ", ".join(parts)


def make_plan(store: Store, recordings: Iterable[Recording], request: Request) -> Plan:
    """Compare what is asked for with what is there."""
    done: dict[str, Outcome] = {}
    left: list[Recording] = []
    changed = 0
    for recording in recordings:
        outcome = store.outcome(recording)
        if outcome is not None and store.is_done(recording, outcome, request.digest):
            done[recording.source] = outcome
        else:
            left.append(recording)
            changed += outcome is not None and outcome.status == "done"
    return Plan(done, left, changed)


@dataclass(slots=True)
class Result:
    """How a batch ended.

    outcomes : of every recording that was looked at, by source. undone : how many were not begun, or given
    up. ended : why it ended early, or None.
    """

    outcomes: dict[str, Outcome]
    undone: int = 0
    ended: str | None = None

    @property
    def failed(self) -> list[Outcome]:
        """Those that failed."""
        return [outcome for outcome in self.outcomes.values() if outcome.status != "done"]


@dataclass
class Batch:
    """One call of a batch.

    signals : tells how often the user has asked to end. fail_fast : begin nothing more after a failure.
    on_outcome : called with each outcome.
    """

    store: Store
    scratch: Path
    request: Request
    workers: Workers
    signals: Callable[[], int]
    fail_fast: bool = False
    on_outcome: Callable[[Outcome], None] = lambda _: None

    def run(self, plan: Plan) -> Result:
        """Work on what a plan has left.

        After one signal no more is begun, after a second what runs is given up. A full disk, or workers that
        are gone, end it; what is done stays done.
        """
        result = Result(dict(plan.done))
        self._waiting = deque(plan.left)
        self._running: dict[Future[Outcome], Recording] = {}
        # Recordings of which one has killed a worker: they are tried again, each alone.
        self._suspects: deque[Recording] = deque()
        self._deaths = 0
        try:
            while self._waiting or self._suspects or self._running:
                if self.signals() == 0 and result.ended is None:
                    self._begin_more()
                if not self._running or self.signals() > 1:
                    break
                for future in wait(self._running, LOOK_EVERY, FIRST_COMPLETED).done:
                    self._finish(future, result)
        except StageError as error:
            result.ended = result.ended or str(error)
        finally:
            self.workers.close(kill=bool(self._running))
        result.undone = len(plan.done) + len(plan.left) - len(result.outcomes)
        if self.signals() and result.undone:
            result.ended = result.ended or "interrupted"
        return result

    def _begin_more(self) -> None:
        if self._suspects:
            if not self._running:
                self._begin(self._suspects[0])
            return
        slots = self.workers.slots
        while self._waiting and len(self._running) < slots:
            self._begin(self._waiting.popleft())

    def _begin(self, recording: Recording) -> None:
        task = Task(recording, self.request, str(self.store.path), str(self.scratch))
        self._running[self.workers.submit(task)] = recording

    def _finish(self, future: Future[Outcome], result: Result) -> None:
        recording = self._running.pop(future)
        alone = bool(self._suspects) and recording == self._suspects[0]
        try:
            outcome = future.result()
            self._deaths = 0
        except BrokenProcessPool:
            if not alone:
                self._suspects.append(recording)
                return
            self._deaths += 1
            outcome = self._failed(
                recording, "it killed its worker twice. Is memory short, or the file harmful?"
            )
        except CancelledError:
            raise StageError(SCHEDULER_GONE) from None
        except Exception as error:
            outcome = self._failed(recording, f"on a worker: {type(error).__name__}: {error}")
        if alone:
            self._suspects.popleft()
        if outcome.status != "done" and not outcome.disk_full:
            self._save(recording, outcome)
        result.outcomes[recording.source] = outcome
        result.ended = result.ended or self._reason_to_end(outcome)
        self.on_outcome(outcome)

    def _failed(self, recording: Recording, error: str) -> Outcome:
        return Outcome(recording.source, recording.name, "failed", error, pipeline=self.request.digest)

    def _save(self, recording: Recording, outcome: Outcome) -> None:
        try:
            self.store.save(recording, outcome)
        except OSError as error:
            raise StageError(f"{self.store.records}: cannot be written: {error.strerror or error}") from error

    def _reason_to_end(self, outcome: Outcome) -> str | None:
        """Why nothing more is begun after this outcome, or None."""
        if outcome.disk_full:
            return "the disk is full; make room and call again: what is done stays done"
        if self._deaths == MOST_DEATHS:
            return f"{MOST_DEATHS} recordings in a row killed their workers; try fewer --workers"
        if self.fail_fast and outcome.status != "done":
            return "--fail-fast: a recording failed"
        return None
