"""Control of a run in another process, where its ZeroMQ sink takes commands (`sinks.zmq.control`).

Nothing here needs OpenCV or the rest of tactflow: over plain ZeroMQ, a REQ socket sends one JSON object,
`{"do": "pause"}`, and receives one.
"""

from __future__ import annotations

import math
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import orjson
import zmq

from tactflow.network.connection import Connection

DEFAULT_ENDPOINT = "tcp://127.0.0.1:5557"
"""Where `tactflow control` looks for a run that takes commands."""
LONGEST_ANSWER = 1 << 20
"""Longest answer, bytes; statistics have some ten thousand. Chosen by hand."""
Answer = dict[str, Any]


class RemoteControl(Connection):
    """Controls a run in another process; a context manager. Belongs to one thread at a time.

    Each method waits for the answer of the run and returns it: `message`, what was done, in words; `state`
    with `sensor`, `paused`, `recording`, `source`; `path` for recordings; `stats` for statistics.

    Parameters
    ----------
    endpoint : address at which the run takes commands. timeout : how long to wait for an answer, s.
    keys : the subscriber's folder made by `tactflow keys new`, where the run requires keys.

    Raises
    ------
    ValueError : from the constructor: the endpoint is not an address, the folder has no valid keys, the
        timeout is not positive.
    TimeoutError : from every method: no answer came; it is not known whether the command was carried out.
    PermissionError : from every method: the run does not admit us: it requires keys, or other ones.
    RuntimeError : from every method: the run says that it is not possible, and why.

    Examples
    --------
    >>> with RemoteControl("tcp://127.0.0.1:5557", timeout=0.1) as run:
    ...     try:
    ...         print(run.take_reference()["message"])
    ...     except TimeoutError as error:
    ...         print(error)
    no answer from tcp://127.0.0.1:5557 within 0.1 s; is tactflow running with sinks.zmq.control set to it?
    """

    def __init__(
        self, endpoint: str = DEFAULT_ENDPOINT, timeout: float = 5.0, keys: str | Path | None = None
    ) -> None:
        if not 0 < timeout < math.inf:
            raise ValueError(f"timeout: required a number of seconds above 0, got {timeout}")
        self.timeout = timeout
        # After a timeout another command may be sent; a late answer is not taken for the answer to that.
        options: dict[int, int | bytes] = {zmq.REQ_RELAXED: 1, zmq.REQ_CORRELATE: 1}
        super().__init__(zmq.REQ, endpoint, options | {zmq.MAXMSGSIZE: LONGEST_ANSWER}, keys)

    def ping(self) -> Answer:
        """Whether the run is there."""
        return self.ask("ping")

    def stats(self) -> Answer:
        """Its statistics so far, under `stats`, as in the statistics file."""
        return self.ask("stats")

    def take_reference(self) -> Answer:
        """Have the next frame taken as the reference: how the gel looks untouched."""
        return self.ask("take_reference")

    def pause(self) -> Answer:
        """Hold capturing: a recording waits, frames of a live source are dropped."""
        return self.ask("pause")

    def resume(self) -> Answer:
        """Go on."""
        return self.ask("resume")

    def record_start(self) -> Answer:
        """Begin a recording; `path` is its file. The pipeline must have a sink `record`."""
        return self.ask("record_start")

    def record_stop(self) -> Answer:
        """Finish the recording, if there is one."""
        return self.ask("record_stop")

    def ask(self, command: str) -> Answer:
        """Send a command by its name, and wait for the answer."""
        # Where we have been refused already, there is nobody to send it to.
        with suppress(zmq.Again):
            self._socket.send(orjson.dumps({"do": command}), zmq.NOBLOCK)
        end = time.monotonic() + self.timeout
        while self._wait(end):
            # A late answer to an earlier command wakes us, and is dropped by the socket.
            with suppress(zmq.Again):
                return self._checked(self._socket.recv(zmq.NOBLOCK))
        keys_hint = ", and are these its keys" if self._has_keys else ""
        raise TimeoutError(
            f"no answer from {self.endpoint} within {self.timeout:g} s; is tactflow running with "
            f"sinks.zmq.control set to it{keys_hint}?"
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
