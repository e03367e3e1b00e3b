"""A Dask cluster as an executor."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tactflow.batch import cluster
from tactflow.batch.cluster import DaskCluster
from tactflow.batch.task import Outcome, Task
from tactflow.engine.errors import ConfigError, StageError
from tests.batch.doubles import outcomes_of, tasks
from tests.clock import PATIENCE, until

distributed = pytest.importorskip("distributed", reason="needs Dask: pip install 'tactflow[dask]'")
pytestmark = pytest.mark.filterwarnings("ignore")


def toy(task: Task) -> Outcome:
    """Stands in for a pipeline."""
    if task.recording.name == "broken":
        raise ValueError("no such thing")
    return Outcome(task.recording.source, task.recording.name, "done")


def blocked(task: Task) -> Outcome:
    """Tells the signals that do not arrive in this process."""
    numbers = signal.pthread_sigmask(signal.SIG_BLOCK, [])
    names = " ".join(sorted(signal.Signals(number).name for number in numbers))
    return Outcome(task.recording.source, task.recording.name, "failed", error=names)


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever answers, starts or ends may take its time."""
    monkeypatch.setattr(cluster, "CONNECT_SECONDS", PATIENCE)
    # Dask gives its own threads 10 s to end.
    monkeypatch.setattr(distributed.utils.LoopRunner.stop, "__defaults__", (PATIENCE,))


@pytest.fixture
def scheduler() -> Iterator[Any]:
    """A cluster in this process."""
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None, silence_logs=50
    ) as made:
        yield made


def test_every_task_comes_back_also_one_whose_work_raises(scheduler: Any, tmp_path: Path) -> None:
    executor = DaskCluster(scheduler.scheduler_address, work=toy)
    assert executor.window == 2
    outcomes = outcomes_of(executor, tasks(tmp_path, "a", "broken", "b"))
    assert {name: outcome.status for name, outcome in outcomes.items()} == {
        **{"a": "done", "b": "done", "broken": "failed"}
    }
    assert outcomes["broken"].error == "on a worker: ValueError: no such thing"


@pytest.mark.skipif(sys.platform == "win32", reason="no signal reaches another process there")
def test_what_a_terminal_sends_to_all_its_processes_does_not_arrive_in_workers_that_are_started_here(
    tmp_path: Path,
) -> None:
    outcomes = outcomes_of(DaskCluster("local", work=blocked), tasks(tmp_path, "a"))
    assert outcomes["a"].error == "SIGHUP SIGINT"


def test_nobody_who_answers_is_a_mistake_of_the_command_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "CONNECT_SECONDS", 0.3)
    with pytest.raises(ConfigError, match="nobody answers who understands"):
        DaskCluster("tcp://127.0.0.1:9")
    with pytest.raises(ConfigError, match="nobody answers who understands"):
        DaskCluster("no address")


def test_a_cluster_of_other_versions_is_refused_before_anything_is_begun(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Client:
        def __init__(self, *_: object, **__: object) -> None:
            self.closed = False

        def get_versions(self) -> dict[str, Any]:
            here, old = ({"packages": {"distributed": version}} for version in ("2026.8.0", "2024.1.0"))
            return {"client": here, "scheduler": here, "workers": {"tcp://a:1": here, "tcp://b:1": old}}

        def close(self) -> None:
            self.closed = True

    monkeypatch.setattr(cluster, "_distributed", lambda: SimpleNamespace(Client=Client))
    with pytest.raises(ConfigError, match=r"has distributed 2024\.1\.0, here is 2026\.8\.0"):
        DaskCluster("tcp://127.0.0.1:8786")


def test_a_goodbye_that_takes_too_long_is_no_failure(
    scheduler: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    executor = DaskCluster(scheduler.scheduler_address, work=toy)
    close = executor._client.close

    def slow(timeout: float) -> None:
        close(timeout)
        raise TimeoutError(f"timed out after {timeout} s.")

    monkeypatch.setattr(executor._client, "close", slow)
    assert outcomes_of(executor, tasks(tmp_path, "a"))["a"].status == "done"


def test_a_scheduler_that_goes_is_said(scheduler: Any, tmp_path: Path) -> None:
    executor = DaskCluster(scheduler.scheduler_address, work=toy)
    # How long it is sought once it has gone, s.
    executor._client._timeout = 0.5

    def until_it_is_noticed() -> None:
        for task in tasks(tmp_path, "a"):
            executor.submit(task)
        until(lambda: executor.finished(0.5) and None)

    try:
        scheduler.close()
        with pytest.raises(StageError, match="is gone, with 1 recordings under way"):
            until_it_is_noticed()
    finally:
        executor.close(kill=True)
