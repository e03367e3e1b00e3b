"""Client for the commands of a running tactflow (`sinks.zmq.control`).

With plain ZeroMQ, a REQ socket sends a JSON object such as `{"do": "pause"}` and receives one.
"""

from __future__ import annotations

import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import orjson
import zmq

from tactflow.network.subscriber import Connection

DEFAULT_ENDPOINT = "tcp://127.0.0.1:5557"
"""Default address of `tactflow control`."""
Answer = dict[str, Any]


class RemoteControl(Connection):
    """Controls a run in another process; a context manager. Use it in one thread at a time.

    Each method waits for the reply of the run and returns it: `message`, what was done; `state` with
    `sensor`, `paused`, `recording`, `source`; `path` for recordings; `stats` for statistics.

    Parameters
    ----------
    endpoint : address for commands of the run.
    timeout : longest wait for a reply, s.
    keys : the subscriber's folder made by `tactflow keys new`, if the run requires keys.

    Raises
    ------
    ValueError : from the constructor: the endpoint is not an address, or the folder has no valid keys.
    TimeoutError : from every method: no reply; whether the command was executed is unknown.
    PermissionError : from every method: the run rejects our keys, or requires some.
    RuntimeError : from every method: the run refuses the command, for the reason given.

    Examples
    --------
    >>> with RemoteControl("tcp://127.0.0.1:5557", timeout=0.1) as run:
    ...     try:
    ...         print(run.take_reference()["message"])
    ...     except TimeoutError as error:
    ...         print(error)
    no answer from tcp://127.0.0.1:5557 within 0.1 s; does tactflow run, with sinks.zmq.control=tcp://127.0.0.1:5557?
    """

    def __init__(
        self, endpoint: str = DEFAULT_ENDPOINT, timeout: float = 5.0, keys: str | Path | None = None
    ) -> None:
        self.timeout = timeout
        # After a timeout another command may be sent; a late reply is not taken for the reply to that one.
        super().__init__(zmq.REQ, endpoint, {zmq.REQ_RELAXED: 1, zmq.REQ_CORRELATE: 1}, keys)

    def ping(self) -> Answer:
        """Check that the run replies."""
        return self.ask("ping")

    def stats(self) -> Answer:
        """The statistics so far, under `stats`, as in the statistics file."""
        return self.ask("stats")

    def take_reference(self) -> Answer:
        """Take the next frame as the reference of the untouched gel."""
        return self.ask("take_reference")

    def pause(self) -> Answer:
        """Pause capturing: a recording waits, frames of a live source are dropped."""
        return self.ask("pause")

    def resume(self) -> Answer:
        """Resume capturing."""
        return self.ask("resume")

    def record_start(self) -> Answer:
        """Start a recording; `path` is its file. The pipeline must have a sink `record`."""
        return self.ask("record_start")

    def record_stop(self) -> Answer:
        """Finish the recording, if any."""
        return self.ask("record_stop")

    def ask(self, command: str) -> Answer:
        """Send a command by its name, and wait for the reply."""
        # After a rejection, there is no connection to send it over.
        with suppress(zmq.Again):
            self._socket.send(orjson.dumps({"do": command}), zmq.NOBLOCK)
        end = time.monotonic() + self.timeout
        while self._wait(end):
            # A late reply to an earlier command wakes the poll, and is dropped by the socket.
            with suppress(zmq.Again):
                return self._checked(self._socket.recv(zmq.NOBLOCK))
        keys_hint = ", and are these its keys" if self._has_keys else ""
        raise TimeoutError(
            f"no answer from {self.endpoint} within {self.timeout:g} s; does tactflow run, with "
            f"sinks.zmq.control={self.endpoint}{keys_hint}?"
        )

    def _checked(self, received: bytes) -> Answer:
        try:
            answer: Answer = orjson.loads(received)
            is_done, message, _ = answer["ok"], str(answer["message"]), answer["state"]["sensor"]
        except (ValueError, TypeError, KeyError):
            raise RuntimeError(f"{self.endpoint} does not answer as tactflow does") from None
        if not is_done:
            raise RuntimeError(message)
        return answer
