"""Processes on this machine: one that dies is replaced, and nothing of its work is lost."""

from __future__ import annotations

import os
import signal
import subprocess
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


def test_no_signal_arrives_in_a_worker_that_starts() -> None:
    # What Python starts with the first process lets them arrive again.
    program = """
import signal
from multiprocessing import resource_tracker
from tactflow.batch.local import signals_held
from tactflow.signals import ENDING
with signals_held(ENDING):
    resource_tracker.ensure_running()
    print(set(ENDING) <= signal.pthread_sigmask(signal.SIG_BLOCK, []))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "True\n"


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs /proc")
def test_a_terminal_that_is_closed_does_not_end_what_python_starts_with_the_first_process() -> None:
    program = """
import re, signal
from multiprocessing import resource_tracker
from pathlib import Path
from tactflow.batch.local import signals_held
from tactflow.signals import ENDING
with signals_held(ENDING):
    resource_tracker.ensure_running()
status = Path(f"/proc/{resource_tracker._resource_tracker._pid}/status").read_text()
blocked = int(re.search("SigBlk:\\t(.*)", status)[1], 16)
print(bool(blocked >> (signal.SIGHUP - 1) & 1))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "True\n"
