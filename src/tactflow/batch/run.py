"""Hands the work out, writes down what became of it, and stops well."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from tactflow.batch.digests import fingerprint, result_key, versions
from tactflow.batch.executor import Executor
from tactflow.batch.folder import Folder, Ledger
from tactflow.batch.recordings import Recording
from tactflow.batch.task import Format, Outcome, PipelineRequest, Task
from tactflow.batch.work import pipeline_for
from tactflow.engine.errors import StageError

LOOK_EVERY = 0.2
"""Time between two looks at workers and signals, s. Chosen by hand."""


@dataclass(frozen=True, slots=True)
class Plan:
    """What is to be done and what is done already.

    done : recordings whose result is there, with its outcome. left : the others. changed : how many of these
    had a result of another input, pipeline or version; the rest of them are new or had failed.
    """

    done: Mapping[str, Outcome]
    left: Sequence[Recording]
    changed: int

    @property
    def words(self) -> str:
        """For people."""
        total = len(self.done) + len(self.left)
        parts = [f"{total} recording{'' if total == 1 else 's'}"]
        if self.done:
            parts.append(f"{len(self.done)} done before")
        if self.changed:
            parts.append(f"{self.changed} done of another input, pipeline or version")
        if self.done or self.changed:
            parts.append(f"{len(self.left) - self.changed} new or failed before")
        return ", ".join(parts)


def resolved(
    file: Path, overrides: Sequence[str], sensor: str | None, format_: Format, split: float = 0.0
) -> PipelineRequest:
    """A pipeline as workers are asked for it, checked.

    split : length of the parts that recordings are cut into, s; 0 for none.

    Raises
    ------
    ConfigError : the file is wrong.
    """
    request = PipelineRequest(os.path.abspath(file), tuple(overrides), sensor, split)
    _, digest = pipeline_for(request, format_)
    return replace(request, digest=digest, versions=tuple(versions().items()))


def make_plan(
    folder: Folder, recordings: Iterable[Recording], request: PipelineRequest, *, verify: bool = False
) -> Plan:
    """Compare what is asked for with what is there.

    A recording whose size and time are as they were when it was read is not read again, unless `verify`.
    """
    known = {} if verify else folder.known(request.digest)
    done: dict[str, Outcome] = {}
    left: list[Recording] = []
    changed = 0
    for recording in recordings:
        outcome = known.get(recording.source)
        if outcome is not None and _still_holds(folder, recording, outcome, request):
            done[recording.source] = replace(outcome.of(recording), reused=True)
            continue
        left.append(recording)
        changed += outcome is not None and outcome.status == "done"
    return Plan(done, left, changed)


def _still_holds(folder: Folder, recording: Recording, outcome: Outcome, request: PipelineRequest) -> bool:
    if outcome.key != result_key(outcome.input_digest, request.digest):
        return False
    path = recording.path
    try:
        same = path is None or outcome.input == fingerprint(path)
    except OSError:
        return False
    return same and folder.is_whole(outcome)


@dataclass(slots=True)
class Stopping:
    """How the user wants it to end: `signals` counts how often he has asked."""

    signals: int = 0

    def count(self, _number: int, _frame: object) -> None:
        """Handler of the signals that ask to end."""
        self.signals += 1


@dataclass(slots=True)
class Result:
    """How a batch ended.

    outcomes : of every recording that was looked at, by source. undone : recordings that nobody has begun,
    or that were given up. ended : why it ended early, or None.
    """

    outcomes: dict[str, Outcome]
    undone: list[Recording] = field(default_factory=list[Recording])
    ended: str | None = None

    @property
    def failed(self) -> list[Outcome]:
        """Those that failed or were set aside."""
        return [outcome for outcome in self.outcomes.values() if outcome.status != "done"]


def run_batch(
    plan: Plan,
    make_task: Callable[[Recording], Task],
    executor: Executor,
    ledger: Ledger,
    *,
    stopping: Stopping,
    fail_fast: bool = False,
    told: Callable[[Outcome], None] = lambda _: None,
    shown: Callable[[Executor, int], None] = lambda _executor, _left: None,
) -> Result:
    """Work on what a plan has left.

    After one signal no more is begun, after a second what runs is given up. A full disk, or an executor that
    is gone, ends it; what is done stays done.

    told : about each outcome. shown : called several times a second with the number that is left.
    """
    waiting = deque(plan.left)
    under_way: dict[str, Recording] = {}
    result = Result(dict(plan.done))
    try:
        while waiting or under_way:
            if stopping.signals > 1:
                break
            goes_on = not stopping.signals and result.ended is None
            while goes_on and waiting and len(under_way) < executor.window:
                recording = waiting.popleft()
                under_way[recording.source] = recording
                executor.submit(make_task(recording))
            if not under_way:
                break
            for outcome in executor.finished(LOOK_EVERY):
                del under_way[outcome.recording]
                result.outcomes[outcome.recording] = outcome
                result.ended = result.ended or _reason_to_end(outcome, fail_fast)
                ledger.add(outcome)
                told(outcome)
            shown(executor, len(waiting) + len(under_way))
    except StageError as error:
        result.ended = result.ended or str(error)
    finally:
        executor.close(kill=bool(under_way))
    if stopping.signals and (waiting or under_way):
        result.ended = result.ended or "interrupted"
    result.undone = [*under_way.values(), *waiting]
    return result


def _reason_to_end(outcome: Outcome, fail_fast: bool) -> str | None:
    """Why nothing more is begun after this outcome, or None."""
    if outcome.disk_full:
        return "the disk is full; make room and call again: what is done stays done"
    if fail_fast and outcome.status != "done":
        return "--fail-fast: a recording failed"
    return None
