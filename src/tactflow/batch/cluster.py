"""Workers of a Dask cluster, on as many machines as it has."""

from __future__ import annotations

import logging
import queue
import signal
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from importlib import import_module
from typing import Any

from tactflow.batch.executor import Headway, died
from tactflow.batch.task import Outcome, Task
from tactflow.batch.work import work
from tactflow.engine.errors import ConfigError, StageError
from tactflow.system.children import starting_children
from tactflow.system.extras import missing
from tactflow.system.signals import ENDING

CONNECT_SECONDS = 10.0
"""How long a scheduler may take to answer, s. Chosen by hand."""
COUNT_EVERY = 5.0
"""Time between two looks how many workers there are, s. Chosen by hand: clusters grow in minutes."""
AHEAD = 2
"""Tasks for each thread of a worker: one that it works on, and the next. Chosen by hand: more would begin
after Ctrl-C, fewer would let it wait for the way to the scheduler and back."""


class DaskCluster:
    """An `Executor` of the workers of a Dask cluster.

    All of them must see the recordings, the pipeline and `--out` under the same paths, and have the same
    tactflow. A worker that dies is the scheduler's business, which gives its tasks to others.

    address : of a scheduler, "tcp://host:8786"; "local" starts a scheduler and workers on this machine.
    workers : how many, for "local". work : what they do, a function of a module.

    Raises
    ------
    ConfigError : Dask is missing here, or nobody answers who understands.
    """

    def __init__(self, address: str, workers: int = 1, work: Callable[[Task], Outcome] = work) -> None:
        problem = missing("Dask clusters", "dask", ["distributed"])
        if problem is not None:
            raise ConfigError(problem)
        self._work = work
        self._ended: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._tasks: dict[str, tuple[Any, Task]] = {}
        self._cluster = _local_cluster(workers) if address == "local" else None
        self._address = address if self._cluster is None else self._cluster.scheduler_address
        self._client = _connect(self._address)
        self._threads, self._counted = 0, 0.0
        self.description = (
            f"the Dask cluster at {self._address}, {len(self._client.nthreads())} workers so far"
        )

    @property
    def window(self) -> int:
        """As many as keep every thread of every worker busy."""
        now = time.monotonic()
        if not self._counted or now - self._counted > COUNT_EVERY:
            self._counted = now
            self._threads = sum(self._client.nthreads().values())
        # Without a worker one waits for the first to come.
        return max(1, AHEAD * self._threads)

    def submit(self, task: Task) -> None:
        """See `Executor.submit`."""
        if not self._is_there:
            raise self._gone()
        future = self._client.submit(self._work, task, pure=False)
        self._tasks[future.key] = future, task
        future.add_done_callback(self._ended.put)

    def finished(self, timeout: float) -> Sequence[Outcome]:
        """See `Executor.finished`."""
        outcomes: list[Outcome] = []
        try:
            while True:
                outcomes.append(self._outcome(self._ended.get(timeout=0 if outcomes else timeout)))
        except queue.Empty:
            pass
        if not outcomes and not self._is_there:
            raise self._gone()
        return outcomes

    def _outcome(self, future: Any) -> Outcome:
        """What became of the task of a future that has ended."""
        if future.status in ("cancelled", "lost"):
            raise self._gone()
        _, task = self._tasks.pop(future.key)
        error = future.exception()
        if error is None:
            outcome: Outcome = future.result()
            return outcome
        if isinstance(error, _distributed().KilledWorker):
            return died(task, "set aside", "the scheduler has given it up, as its workers died")
        return died(task, "failed", f"on a worker: {type(error).__name__}: {error}")

    @property
    def _is_there(self) -> bool:
        """Whether the client still has a scheduler, or tries to find it again."""
        return self._client.status in ("running", "connecting")

    def _gone(self) -> StageError:
        return StageError(
            f"the scheduler at {self._address} is gone, with {len(self._tasks)} recordings under way; "
            "call again when it is back: what is done stays done"
        )

    def headway(self) -> Sequence[Headway]:
        """Nothing: how far a worker is, the scheduler does not know."""
        return ()

    def close(self, *, kill: bool) -> None:
        """Let go of the cluster; end it if it was started here."""
        if kill and self._is_there:
            self._client.cancel([future for future, _ in self._tasks.values()], force=True)
        # A goodbye that takes too long takes nothing from what is done.
        with suppress(TimeoutError):
            self._client.close(timeout=CONNECT_SECONDS)
        if self._cluster is not None:
            with suppress(TimeoutError):
                self._cluster.close()


def _distributed() -> Any:
    """The package, imported where it is used: it takes a second."""
    package = import_module("distributed")
    # What it would show, with tracebacks, is told here in words.
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)
    return package


def _local_cluster(workers: int) -> Any:
    package = _distributed()
    # Dask itself ends its processes with SIGTERM.
    with starting_children([number for number in ENDING if number != signal.SIGTERM]):
        return package.LocalCluster(
            n_workers=workers, threads_per_worker=1, dashboard_address=None, silence_logs=logging.ERROR
        )


def _connect(address: str) -> Any:
    """A client of the scheduler that is sure to understand it."""
    try:
        with warnings.catch_warnings():
            # What differs is looked at below.
            warnings.filterwarnings("ignore", "Mismatched versions")
            client = _distributed().Client(address, timeout=CONNECT_SECONDS, set_as_default=False)
    except (OSError, ValueError, ImportError, TypeError) as error:
        raise ConfigError(
            f"--scheduler {address}: nobody answers who understands ({error}); is it the address that "
            "`dask scheduler` shows, tcp://HOST:8786, of the same version of Dask?"
        ) from None
    known = client.get_versions()
    here = _dask_version(known["client"])
    there = {_dask_version(one) for one in (known["scheduler"], *known["workers"].values())} - {here}
    if there:
        client.close()
        raise ConfigError(
            f"--scheduler {address}: has distributed {', '.join(sorted(there))}, here is {here}; install the "
            "same version on all machines"
        )
    return client


def _dask_version(known: Mapping[str, Any]) -> str:
    """Version of the package that talks to others; what computes, each worker checks for itself."""
    return str(known["packages"]["distributed"])
