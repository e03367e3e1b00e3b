"""A running pipeline, shared by the cameras that return its outputs."""

from __future__ import annotations

import threading
import time
from contextlib import closing
from typing import ClassVar

from lerobot_camera_tactflow.configuration import TactflowCameraConfig
from tactflow import Result, Sink, stream
from tactflow.ports import Unmarked, Untouched

REQUEST = "lerobot_camera_tactflow"
"""Id of the sink that requests the pictures of `difference`."""
LEAVE_SECONDS = 2.0
"""Longest wait for a run to end, s, as for LeRobot's own cameras; a run that hangs is left to end later."""


class AskForPictures(Sink):
    """Requests both pictures of `difference`, so that they are in every result."""

    def write(self, unmarked: Unmarked | None, untouched: Untouched | None) -> None:
        """Ignore them."""


class SharedRun:
    """The newest result of a pipeline, for several readers.

    Parameters
    ----------
    config : of the first camera.

    Attributes
    ----------
    counter : number of results so far.
    arrived : monotonic time of the last one, s.
    failure : why there will be no more results; empty while the run goes on.
    """

    _running: ClassVar[dict[str, SharedRun]] = {}
    _registry_lock: ClassVar[threading.Lock] = threading.Lock()

    @classmethod
    def join(cls, config: TactflowCameraConfig, reader: object) -> SharedRun:
        """Add a reader to the run of this configuration, which starts with its first reader."""
        with cls._registry_lock:
            run = cls._running.get(config.run_key)
            if run is None or run.failure:
                run = cls._running[config.run_key] = cls(config)
            with run.changed:
                run._seen[reader] = 0 if run._every_frame else run.counter
            return run

    def __init__(self, config: TactflowCameraConfig) -> None:
        self.changed = threading.Condition()
        self.latest: Result | None = None
        self.counter = 0
        self.arrived = 0.0
        self.failure = ""
        self._key = config.run_key
        self._every_frame = not config.realtime
        self._seen: dict[object, int] = {}
        self._stopped = False
        sinks = {REQUEST: {"use": f"{__name__}:{AskForPictures.__name__}"}}
        self._results = stream(
            config.pipeline,
            source=config.source,
            settings={**config.settings, "sinks": sinks},
            realtime=config.realtime,
            images=True,
            sinks=True,
        )
        self._thread = threading.Thread(target=self._work, name=f"tactflow {config.source}", daemon=True)
        self._thread.start()

    def leave(self, reader: object) -> None:
        """Remove a reader; the run ends with its last one."""
        with self._registry_lock:
            with self.changed:
                self._seen.pop(reader, None)
                self._stopped = not self._seen
                self.changed.notify_all()
            if self._stopped and self._running.get(self._key) is self:
                del self._running[self._key]
        if self._stopped:
            self._thread.join(LEAVE_SECONDS)

    def peek(self, timeout_s: float) -> Result | None:
        """Wait for a result, and return the newest without marking it as read; None after the timeout.

        Raises RuntimeError if there will be none.
        """
        with self.changed:
            self.changed.wait_for(lambda: self.latest is not None or self.failure, timeout_s)
            if self.latest is None and self.failure:
                raise RuntimeError(self.failure)
            return self.latest

    def read(self, reader: object, timeout_s: float) -> Result | None:
        """Wait for a result that this reader has not seen, and return the newest; None after the timeout.

        Raises RuntimeError if there will be no more.
        """
        with self.changed:
            self.changed.wait_for(lambda: self.counter > self._seen[reader] or self.failure, timeout_s)
            if self.counter > self._seen[reader]:
                self._seen[reader] = self.counter
                self.changed.notify_all()
                return self.latest
            if self.failure:
                raise RuntimeError(self.failure)
            return None

    def _work(self) -> None:
        failure = "the source has ended"
        try:
            with closing(self._results) as results:
                for result in results:
                    if not self._publish(result):
                        break
        except Exception as error:
            failure = str(error) or type(error).__name__
        with self.changed:
            self.failure = failure
            self.changed.notify_all()

    def _publish(self, result: Result) -> bool:
        """Hand a result to the readers; returns whether to go on."""
        with self.changed:
            self.latest, self.arrived = result, time.monotonic()
            self.counter += 1
            self.changed.notify_all()
            self.changed.wait_for(lambda: self._stopped or not self._every_frame or self._all_have_seen())
            return not self._stopped

    def _all_have_seen(self) -> bool:
        return all(seen == self.counter for seen in self._seen.values())
