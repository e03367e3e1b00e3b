"""Processes on this machine."""

from __future__ import annotations

import multiprocessing
import os
import signal
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess

from tactflow.batch.executor import Headway
from tactflow.batch.task import Outcome, Report, Task
from tactflow.batch.work import work
from tactflow.engine.errors import StageError
from tactflow.system.children import starting_children
from tactflow.system.signals import ENDING

Work = Callable[[Task, Report], Outcome]

_CONTEXT = multiprocessing.get_context("spawn")
"""Not fork: the process of the command line has threads, and OpenCV in it may hold locks."""
REPORT_EVERY = 0.25
"""Time between two words of a worker on how far it is, s. Chosen by hand."""
MOST_IDLE_DEATHS = 3
"""Workers that die in a row without a recording, after which no more are started. Chosen by hand."""


ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"
)
"""Environment of a worker: as many workers as processors, so one thread for each library."""


class _Worker:
    """A process that works on one task after the other, and what is known of it."""

    def __init__(self, work: Work) -> None:
        self.task: Task | None = None
        self.frames = 0
        self.total: int | None = None
        self.connection, theirs = _CONTEXT.Pipe()
        self.process: BaseProcess = _CONTEXT.Process(target=_serve, args=(theirs, work), daemon=True)
        with starting_children(ENDING):
            self.process.start()
        theirs.close()

    def give(self, task: Task) -> None:
        self.task, self.frames, self.total = task, 0, None
        self.connection.send(task)

    def end(self, *, kill: bool) -> None:
        """End the process: it has nothing to do, or whatever it does is not wanted."""
        self.connection.close()
        if kill:
            self.process.kill()
        self.process.join()


class LocalProcesses:
    """An `Executor` of processes on this machine; one that dies is replaced, and its task given to the next.

    workers : how many. work : what they do, a function of a module.
    """

    def __init__(self, workers: int, work: Work = work) -> None:
        self._work = work
        self._host = socket.gethostname()
        self.description = f"{workers} {'process' if workers == 1 else 'processes'}"
        self._count = workers
        self._waiting: deque[Task] = deque()
        self._workers: list[_Worker] = []
        self._idle_deaths = 0
        os.environ.update(ONE_THREAD)

    @property
    def window(self) -> int:
        """One task for each worker: the next comes as soon as one is done."""
        return self._count

    def submit(self, task: Task) -> None:
        """Give a task to a free worker, or keep it for the next one."""
        self._waiting.append(task)
        self._hand_out()

    def _hand_out(self) -> None:
        free = [worker for worker in self._workers if worker.task is None]
        while self._waiting and (free or len(self._workers) < self._count):
            if not free:
                self._workers.append(_Worker(self._work))
                free.append(self._workers[-1])
            worker, task = free.pop(), self._waiting.popleft()
            try:
                worker.give(task)
            except OSError:
                # It has died; that is noticed below, where its task is given to another one.
                continue

    def finished(self, timeout: float) -> Sequence[Outcome]:
        """See `Executor.finished`."""
        ready = wait([worker.connection for worker in self._workers], timeout)
        outcomes: list[Outcome] = []
        for worker in [worker for worker in self._workers if worker.connection in ready]:
            outcomes += self._listen(worker)
        self._hand_out()
        return outcomes

    def _listen(self, worker: _Worker) -> Sequence[Outcome]:
        """Take what a worker says."""
        try:
            said = worker.connection.recv()
        except (EOFError, OSError):
            self._bury(worker)
            return []
        if isinstance(said, Outcome):
            worker.task, self._idle_deaths = None, 0
            return [said]
        worker.frames, worker.total = said
        return []

    def _bury(self, worker: _Worker) -> None:
        """A worker has died: let another one try its task, which knows how often that happened."""
        self._workers.remove(worker)
        worker.end(kill=True)
        if worker.task is not None:
            self._waiting.appendleft(worker.task)
            return
        self._idle_deaths += 1
        if self._idle_deaths >= MOST_IDLE_DEATHS:
            raise StageError(
                f"{MOST_IDLE_DEATHS} workers have died before they began (the last with exit code "
                f"{worker.process.exitcode}); is there memory for {self._count}? Try fewer with --workers"
            )

    def headway(self) -> Sequence[Headway]:
        """What each worker is doing."""
        return [Headway(f"{self._host}:{w.process.pid}", w.task, w.frames, w.total) for w in self._workers]

    def close(self, *, kill: bool) -> None:
        """End all workers."""
        for worker in self._workers:
            worker.end(kill=kill or worker.task is not None)
        self._workers.clear()


def _serve(connection: Connection, work: Work) -> None:
    """Body of a worker: tasks come, outcomes go, until the other end is closed."""
    for number in ENDING:
        signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    while True:
        try:
            task: Task = connection.recv()
        except EOFError:
            return
        last = time.monotonic()

        def report(done: int, total: int | None) -> None:
            nonlocal last
            if time.monotonic() - last >= REPORT_EVERY:
                last = time.monotonic()
                connection.send((done, total))

        connection.send(work(task, report))


def _end_with_parent() -> None:
    """End this process when the one that started it is gone: what it does would be done again."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
