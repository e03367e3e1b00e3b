"""Recordings, pipelines and executors for tests of a batch."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tactflow.batch.executor import Executor, Headway
from tactflow.batch.folder import Folder, Ledger
from tactflow.batch.recordings import Recording, find_recordings
from tactflow.batch.run import Plan, Result, Stopping, make_plan, resolved, run_batch
from tactflow.batch.split import Splitting
from tactflow.batch.task import Format, Outcome, PipelineRequest, Task
from tactflow.batch.work import work
from tests.clock import PATIENCE

PIPELINE = """
stages:
  capture: {source: "sim:idle", settle: 0}
  preprocess: {rotate: 0, downsample: 1}
  difference: {in: {unmarked: preprocess.image}, method: colour}
  hull: {when: touching}
sinks: {}
"""
"""A pipeline without kernels."""


class InTurn:
    """An `Executor` in this process."""

    description = "this process"
    window = 2

    def __init__(self) -> None:
        self.submitted: list[Task] = []
        self._tasks: list[Task] = []
        self.killed = False

    def submit(self, task: Task) -> None:
        self.submitted.append(task)
        self._tasks.append(task)

    def finished(self, timeout: float) -> Sequence[Outcome]:
        assert timeout > 0
        return [work(self._tasks.pop(0))] if self._tasks else []

    def headway(self) -> Sequence[Headway]:
        return [Headway("here", self._tasks[0] if self._tasks else None)]

    def close(self, *, kill: bool) -> None:
        self.killed = kill


def tasks(folder: Path, *names: str) -> list[Task]:
    """Tasks for a toy in place of a pipeline, which does what their names say."""
    request = PipelineRequest("", (), None)
    return [
        Task(Recording(f"sim:{name}", name), request, "jsonl", str(folder), str(folder)) for name in names
    ]


def outcomes_of(executor: Executor, tasks: Sequence[Task]) -> dict[str, Outcome]:
    """What an executor makes of tasks, by their names; it is closed then."""
    outcomes: dict[str, Outcome] = {}
    try:
        for task in tasks:
            executor.submit(task)
        deadline = time.monotonic() + PATIENCE
        while len(outcomes) < len(tasks):
            assert time.monotonic() < deadline
            outcomes |= {outcome.name: outcome for outcome in executor.finished(1.0)}
    finally:
        executor.close(kill=True)
    return outcomes


def recording(path: Path, *, brightness: int = 200, frames: int = 6) -> Path:
    """A .npy recording in which a bright square touches from the third frame on."""
    pictures = np.full((frames, 48, 64, 3), 60, np.uint8)
    pictures[2:, 16:32, 20:40] = brightness
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, pictures)
    return path


class Batch:
    """A folder of recordings, a pipeline and `--out`, to call again and again."""

    def __init__(self, folder: Path, pipeline: str = PIPELINE) -> None:
        self.recordings = folder / "recordings"
        self.recordings.mkdir()
        self.file = folder / "pipeline.yaml"
        self.file.write_text(pipeline)
        self.folder = Folder(folder / "out")
        self.format: Format = "jsonl"
        self.plan: Plan
        self.executor: InTurn

    def __call__(
        self,
        *overrides: str,
        verify: bool = False,
        fail_fast: bool = False,
        stop_after: int | None = None,
        split: float = 0.0,
    ) -> Result:
        """One call; after `stop_after` outcomes a signal comes."""
        request = resolved(self.file, overrides, None, self.format, split)
        self.executor = InTurn()
        stopping = Stopping()
        seen: list[Outcome] = []

        def told(outcome: Outcome) -> None:
            seen.append(outcome)
            stopping.signals = int(stop_after is not None and len(seen) >= stop_after)

        with self.folder.claimed("1-of-1") as scratch, Ledger(self.folder, "1-of-1") as ledger:
            words = [str(self.recordings)]
            self.plan = make_plan(self.folder, find_recordings(words), request, verify=verify)
            return run_batch(
                self.plan,
                lambda one: Task(one, request, self.format, str(self.folder.path), str(scratch), verify),
                Splitting(self.executor) if split else self.executor,
                ledger,
                stopping=stopping,
                fail_fast=fail_fast,
                told=told,
            )
