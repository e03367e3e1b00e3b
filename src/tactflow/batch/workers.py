"""What a batch runs on: processes of this machine, or the workers of a Dask cluster."""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import threading
import warnings
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from importlib import import_module
from typing import Any, Protocol

from tactflow.batch.store import Outcome
from tactflow.batch.work import Task, work
from tactflow.engine.errors import ConfigError, StageError
from tactflow.system.children import starting_children
from tactflow.system.extras import missing
from tactflow.system.signals import ENDING

CONNECT_SECONDS = 10.0
"""How long a scheduler may take to answer, s. Chosen by hand."""
AHEAD = 2
"""Tasks for each thread of a Dask worker: the one under way, and the next, so that it never waits."""
SCHEDULER_GONE = "the Dask scheduler is gone; call again when it is back: what is done stays done"
ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"
)
"""Environment of a worker: there are as many workers as processors, so each library gets one thread."""


class Workers(Protocol):
    """Run tasks. description : for people. slots : tasks that keep all workers busy."""

    description: str

    @property
    def slots(self) -> int: ...

    def submit(self, task: Task) -> Future[Outcome]:
        """Begin a task as soon as a worker is free.

        The future raises BrokenProcessPool if its worker died, perhaps through another task, and
        CancelledError if the scheduler is gone. Raises StageError if it is gone now.
        """
        ...

    def close(self, *, kill: bool) -> None:
        """End the workers. kill : at once, whatever they are doing."""
        ...


class LocalProcesses:
    """Processes on this machine. count : how many."""

    def __init__(self, count: int) -> None:
        self.description = f"{count} {'process' if count == 1 else 'processes'}"
        self.slots = count
        os.environ.update(ONE_THREAD)
        self._pool = self._new_pool()

    def _new_pool(self) -> ProcessPoolExecutor:
        # Not fork: this process has threads, and OpenCV may hold locks.
        context = multiprocessing.get_context("spawn")
        return ProcessPoolExecutor(self.slots, context, initializer=_begin)

    def submit(self, task: Task) -> Future[Outcome]:
        """See `Workers.submit`."""
        # Not SIGTERM, by which the pool itself ends its processes.
        with starting_children([number for number in ENDING if number != signal.SIGTERM]):
            try:
                return self._pool.submit(work, task)
            except BrokenProcessPool:
                self._pool = self._new_pool()
                return self._pool.submit(work, task)

    def close(self, *, kill: bool) -> None:
        """See `Workers.close`."""
        if kill:
            for process in multiprocessing.active_children():
                process.kill()
        self._pool.shutdown(cancel_futures=True)


def _begin() -> None:
    """In a new worker: leave Ctrl-C to the parent, and end with it, as the work would be done again."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()

    def watch() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


class DaskCluster:
    """Workers of a Dask cluster, which see the recordings, the pipeline and `--out` under the same paths.

    The scheduler gives the tasks of a worker that dies to others. address : of it, "tcp://host:8786".

    Raises
    ------
    ConfigError : Dask is missing, or no scheduler of the same version answers.
    """

    def __init__(self, address: str) -> None:
        if problem := missing("Dask clusters", "dask", ["distributed"]):
            raise ConfigError(problem)
        self._client = _connect(address)
        self._executor = self._client.get_executor(pure=False)
        self.description = f"the Dask cluster at {address}, {len(self._client.nthreads())} workers so far"

    @property
    def slots(self) -> int:
        """More as the cluster grows; without a worker, wait for the first one."""
        threads: int = sum(self._client.nthreads().values())
        return max(1, AHEAD * threads)

    def submit(self, task: Task) -> Future[Outcome]:
        """See `Workers.submit`."""
        if self._client.status not in ("running", "connecting"):
            raise StageError(SCHEDULER_GONE)
        future: Future[Outcome] = self._executor.submit(work, task)
        return future

    def close(self, *, kill: bool) -> None:
        """See `Workers.close`."""
        if kill and self._client.status == "running":
            self._executor.shutdown(wait=False)
        # A slow goodbye takes nothing from what is done.
        with suppress(TimeoutError):
            self._client.close(timeout=CONNECT_SECONDS)


def _connect(address: str) -> Any:
    """A client of a scheduler and workers of our version of Dask."""
    # Imported here: it takes a second.
    distributed = import_module("distributed")
    # Errors that it would log with tracebacks are reported here in words.
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Mismatched versions")
            client = distributed.Client(address, timeout=CONNECT_SECONDS, set_as_default=False)
    except (OSError, ValueError, ImportError, TypeError) as error:
        raise ConfigError(
            f"--scheduler {address}: no Dask scheduler answers ({error}); is it the address that "
            "`dask scheduler` shows, tcp://HOST:8786, of the same version of Dask?"
        ) from None
    found = client.get_versions()
    here, *others = (
        str(host["packages"]["distributed"])
        for host in (found["client"], found["scheduler"], *found["workers"].values())
    )
    if set(others) - {here}:
        client.close()
        there = ", ".join(sorted(set(others) - {here}))
        raise ConfigError(
            f"--scheduler {address}: has distributed {there}, here is {here}; install the same version on "
            "all machines"
        )
    return client
