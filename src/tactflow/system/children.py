"""Python processes that tactflow starts. None of them imports modules from the current folder."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Collection, Iterator
from contextlib import contextmanager


def python_command(*arguments: str) -> list[str]:
    """The command line of a Python child, for `subprocess`.

    Without `-P`, Python would look for every module in the current folder first: a `random.py` that lies
    there would run.

    >>> python_command("-m", "tactflow", "check")[1:]
    ['-P', '-m', 'tactflow', 'check']
    """
    return [sys.executable, "-P", *arguments]


@contextmanager
def starting_children(blocked: Collection[int] = ()) -> Iterator[None]:
    """Let multiprocessing, or Dask, start its processes in this block.

    blocked : signals that never reach them. Ctrl-C on a terminal reaches every process there; the process of
        the command line decides what ends. In this thread they arrive after the block.
    """
    before = os.environ.get("PYTHONSAFEPATH")
    # The environment variable for -P: multiprocessing composes the command line itself.
    os.environ["PYTHONSAFEPATH"] = "1"
    try:
        with _signals_blocked(blocked):
            yield
    finally:
        if before is None:
            del os.environ["PYTHONSAFEPATH"]
        else:
            os.environ["PYTHONSAFEPATH"] = before


@contextmanager
def _signals_blocked(numbers: Collection[int]) -> Iterator[None]:
    if sys.platform == "win32" or not numbers:
        yield
        return
    from multiprocessing import resource_tracker

    before = signal.pthread_sigmask(signal.SIG_BLOCK, numbers)
    try:
        # Python starts this process with the first child, and then unblocks SIGINT and SIGTERM.
        resource_tracker.ensure_running()
        signal.pthread_sigmask(signal.SIG_BLOCK, numbers)
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
