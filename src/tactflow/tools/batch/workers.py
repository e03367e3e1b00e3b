"""Workers of a batch: local processes, or those of a Dask cluster."""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import threading
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from importlib import import_module
from typing import Any, Protocol

from tactflow.engine.errors import ConfigError, StageError
from tactflow.system.children import starting_children
from tactflow.system.extras import missing
from tactflow.system.signals import ENDING_SIGNALS
from tactflow.tools.batch.store import Outcome
from tactflow.tools.batch.work import Task, work

CONNECT_SECONDS = 10.0
"""Timeout for the scheduler's answer, s. Chosen by hand."""
TASKS_PER_THREAD = 2
"""Tasks per thread of a Dask worker: the current one and the next, so that it never idles."""
SCHEDULER_GONE = "lost the Dask scheduler; run again when it is back: finished recordings are kept"
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""Environment of a worker: with a worker per processor, each library gets one thread."""


class Workers(Protocol):
    """Run tasks.

    Attributes
    ----------
    description : for log messages.
    """

    description: str

    @property
    def slots(self) -> int:
        """Number of tasks that keeps all workers busy."""

    def submit(self, task: Task) -> Future[Outcome]:
        """Start a task as soon as a worker is free.

        The future raises BrokenProcessPool if its worker died, possibly because of another task, and
        CancelledError if the scheduler is lost. Raises StageError if it is lost already.
        """

    def close(self, *, kill: bool) -> None:
        """Stop the workers; with `kill` immediately, aborting running tasks."""


class LocalProcesses:
    """Processes on this machine.

    Parameters
    ----------
    count : number of processes.
    """

    def __init__(self, count: int) -> None:
        self.description = f"{count} {'process' if count == 1 else 'processes'}"
        self.slots = count
        os.environ.update(ONE_THREAD)
        self._pool = self._new_pool()

    def _new_pool(self) -> ProcessPoolExecutor:
        # Not fork: this process has threads, and OpenCV may hold locks.
        context = multiprocessing.get_context("spawn")
        # The queues of a pool start multiprocessing's resource tracker.
        with starting_children():
            return ProcessPoolExecutor(self.slots, context, initializer=_begin)

    def submit(self, task: Task) -> Future[Outcome]:
        """See `Workers.submit`."""
        # Not SIGTERM, with which the pool terminates its processes.
        with starting_children([number for number in ENDING_SIGNALS if number != signal.SIGTERM]):
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
    """Initialise a worker: ignore Ctrl-C, which the parent handles, and exit when the parent exits."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()

    def watch() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


class DaskCluster:
    """Workers of a Dask cluster, which must see recordings, pipeline and `--out` under the same paths.

    The scheduler reassigns the tasks of a worker that dies. address : of the scheduler, "tcp://host:8786".

    Raises
    ------
    ConfigError : Dask is missing, or no scheduler answers.
    """

    def __init__(self, address: str) -> None:
        if problem := missing("Dask clusters", "dask", ["distributed"]):
            raise ConfigError(problem)
        self._client = _connect(address)
        self._executor = self._client.get_executor(pure=False)
        self.description = f"the Dask cluster at {address}, {len(self._client.nthreads())} workers so far"

    @property
    def slots(self) -> int:
        """Grows with the cluster; at least one, to wait for the first worker."""
        threads: int = sum(self._client.nthreads().values())
        return max(1, TASKS_PER_THREAD * threads)

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
        # All results are saved, so a timeout is harmless.
        with suppress(TimeoutError):
            self._client.close(timeout=CONNECT_SECONDS)


def _connect(address: str) -> Any:
    """Connect to a scheduler. Dask warns if its machines have other versions."""
    # Imported here because it takes a second.
    distributed = import_module("distributed")
    # Errors are reported below, without tracebacks.
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)
    try:
        return distributed.Client(address, timeout=CONNECT_SECONDS, set_as_default=False)
    except (OSError, ValueError, ImportError, TypeError) as error:
        raise ConfigError(
            f"--scheduler {address}: no Dask scheduler answers ({error}); is it the address that "
            "`dask scheduler` shows, tcp://HOST:8786, of the same version of Dask?"
        ) from None
