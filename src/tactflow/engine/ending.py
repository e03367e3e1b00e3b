"""How a run ends: the request to stop, its reason, and the first error."""

from __future__ import annotations

import logging
import threading
import traceback
from collections.abc import Callable

from tactflow.engine.errors import TactflowError

logger = logging.getLogger("tactflow")


class Ending:
    """The end of a run. All methods are thread-safe and return immediately.

    Parameters
    ----------
    on_stop : called after each request to stop, to wake what waits.

    Attributes
    ----------
    stopping : set once the run is to stop, or the source has ended.
    reason : as `end` in the statistics file; None before.
    error : the first error, or None.
    hurried : whether the run was stopped before the end of its source, so that it no longer waits for slow
        readers.
    """

    def __init__(self, on_stop: Callable[[], None]) -> None:
        self._on_stop = on_stop
        self._lock = threading.Lock()
        self.stopping = threading.Event()
        self.reason: str | None = None
        self.error: TactflowError | None = None
        self.hurried = False

    def stop(self, reason: str) -> None:
        """Capture no more frames, and finish pending ones."""
        with self._lock:
            self.reason = self.reason or reason
            self.hurried = self.hurried or reason != "max_frames"
        self.stopping.set()
        self._on_stop()

    def fail(self, error: TactflowError, cause: BaseException | None = None) -> None:
        """Stop because of an error; the first one is reported."""
        if cause is not None:
            error.__cause__ = cause
            logger.debug("%s", "".join(traceback.format_exception(cause)))
        with self._lock:
            if self.error is None:
                self.error = error
                self.reason = f"error: {str(error).splitlines()[0]}"
        self.stop(f"error: {error}")

    def finish(self) -> None:
        """The source has ended."""
        with self._lock:
            self.reason = self.reason or "eos"
        self.stopping.set()
