"""Child processes of Python, which do not import modules from the current folder."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Collection, Iterator
from contextlib import contextmanager


@contextmanager
def starting_children(blocked: Collection[int] = ()) -> Iterator[None]:
    """Context in which multiprocessing, or Dask, may start processes.

    blocked : signals that the children never receive: Ctrl-C on a terminal reaches every process, but the
        process of the command line decides what ends. This thread receives them after the block.
    """
    before = os.environ.get("PYTHONSAFEPATH")
    # Equivalent to -P, because multiprocessing composes the command line itself.
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
        # Otherwise Python starts it with the first child, and then unblocks SIGINT and SIGTERM.
        resource_tracker.ensure_running()
        signal.pthread_sigmask(signal.SIG_BLOCK, numbers)
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
