"""Decide which recordings to process, submit them to workers, and handle failures and signals."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path

from tactflow.engine.errors import StageError
from tactflow.outputs import cannot_write
from tactflow.tools.batch.recordings import Recording
from tactflow.tools.batch.store import Outcome, Store
from tactflow.tools.batch.work import Request, Task
from tactflow.tools.batch.workers import SCHEDULER_GONE, Workers

POLL_SECONDS = 0.2
"""Interval at which signals are checked, s: too short for people to notice."""
MAX_WORKER_DEATHS = 3
"""Recordings in a row that may kill their worker; more suggest that no worker can run here."""


@dataclass(frozen=True, slots=True)
class Plan:
    """What a call has to do.

    Attributes
    ----------
    done : source -> outcome of an earlier call.
    left : recordings to process.
    changed : number of these that are done for another input, pipeline or version; the others are new or
        failed.
    """

    done: Mapping[str, Outcome]
    left: Sequence[Recording]
    changed: int

    def __str__(self) -> str:
        total = len(self.done) + len(self.left)
        parts = [f"{total} recording{'' if total == 1 else 's'}"]
        if self.done:
            parts.append(f"{len(self.done)} done before")
        if self.changed:
            parts.append(f"{self.changed} outdated (input, pipeline or version changed)")
        if self.done or self.changed:
            parts.append(f"{len(self.left) - self.changed} new or failed before")
        return ", ".join(parts)


def make_plan(store: Store, recordings: Iterable[Recording], request: Request) -> Plan:
    """Split recordings into those with a current result and those left to process."""
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

    Attributes
    ----------
    outcomes : by source.
    undone : number of recordings not started or aborted.
    ended : reason for an early end, or None.
    """

    outcomes: dict[str, Outcome]
    undone: int = 0
    ended: str | None = None

    @property
    def failed(self) -> list[Outcome]:
        """Outcomes of the recordings that failed."""
        return [outcome for outcome in self.outcomes.values() if outcome.status != "done"]


@dataclass
class Batch:
    """One call of a batch.

    Attributes
    ----------
    signals : returns the number of stop signals received.
    on_outcome : called with each outcome.
    """

    store: Store
    scratch: Path
    request: Request
    workers: Workers
    signals: Callable[[], int]
    on_outcome: Callable[[Outcome], None] = lambda _: None

    def run(self, plan: Plan) -> Result:
        """Process the recordings that a plan has left.

        The first signal stops new recordings, the second aborts the running ones. A full disk or lost workers
        end the batch; finished results are kept.
        """
        result = Result(dict(plan.done))
        self._waiting = deque(plan.left)
        self._running: dict[Future[Outcome], Recording] = {}
        # Recordings that were running when a worker died: each is retried alone.
        self._suspects: deque[Recording] = deque()
        self._deaths = 0
        try:
            while self._waiting or self._suspects or self._running:
                if self.signals() == 0 and result.ended is None:
                    self._begin_more()
                if not self._running or self.signals() > 1:
                    break
                for future in wait(self._running, POLL_SECONDS, FIRST_COMPLETED).done:
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
                recording, "killed its worker twice; is memory short, or the file damaged?"
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
            raise cannot_write(self.store.records, error) from error

    def _reason_to_end(self, outcome: Outcome) -> str | None:
        """Reason to start no more recordings after this outcome, or None."""
        if outcome.disk_full:
            return "the disk is full; free some space, then run again: finished recordings are kept"
        if self._deaths == MAX_WORKER_DEATHS:
            return f"{MAX_WORKER_DEATHS} recordings in a row killed their workers; try fewer --workers"
        return None
