"""Processes on this machine: one that dies is replaced, and nothing of its work is lost."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

import pytest

from tactflow.batch.local import LocalProcesses
from tactflow.batch.task import Outcome, Report, Task
from tactflow.batch.work import DEADLY, attempt
from tests.batch.doubles import outcomes_of, tasks

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="kills processes by signals")


def toy(task: Task, report: Report) -> Outcome:
    """Stands in for a pipeline: does what the name of the recording says."""
    report(1, 2)
    name, done = task.recording.name, Outcome(task.recording.source, task.recording.name, "done")
    with attempt(task) as attempts:
        if attempts > DEADLY:
            return Outcome(task.recording.source, name, "set aside", attempts=attempts)
        if name == "deadly" or (name == "unlucky" and attempts == 1):
            os.kill(os.getpid(), signal.SIGKILL)
    return done


def test_a_killed_worker_is_replaced_and_what_kills_two_is_set_aside(tmp_path: Path) -> None:
    executor = LocalProcesses(2, work=toy)
    outcomes = outcomes_of(executor, tasks(tmp_path, "a", "deadly", "unlucky", "b"))
    assert {name: outcome.status for name, outcome in outcomes.items()} == {
        **{"a": "done", "b": "done", "unlucky": "done", "deadly": "set aside"}
    }
    assert not list(tmp_path.iterdir())
