"""The socket over which other programs control a run: a JSON object in, a JSON object out.

    {"do": "pause"}  ->  {"ok": true, "message": "paused", "state": {"sensor": "main", "paused": true, ...}}

It lives in a thread of its own that the run never waits for, and answers at most some hundred times a second.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping
from typing import Any

import orjson
import zmq

from tactflow.engine.errors import StageError
from tactflow.network.bound_socket import BoundSocket, FloodError
from tactflow.network.commands import Commands, RefusedError

log = logging.getLogger("tactflow")

POLL_MS = 200
"""How often the thread looks whether it shall end, and at the connections, ms. Chosen by hand."""
REST = 0.005
"""Time between two answers, so that a flood of commands takes no processor from the run, s. Chosen by
hand."""
LINGER = 0.2
"""Time to deliver the last answer at the end of a run, s. Chosen by hand."""
LONGEST_QUOTE = 40
"""Letters of an unknown command that its answer repeats."""

Answer = dict[str, Any]


class _Socket(BoundSocket):
    """A ROUTER socket. (REP, which does the same with fewer words, waits inside `recv` for the end of what is
    no request at all.)"""

    hint = (
        "another run takes commands there, or another program. End it, or choose another address "
        "(--set sinks.zmq.control=tcp://127.0.0.1:5558); several sensors need one each, such as "
        "ipc:///tmp/tactflow-{sensor}"
    )

    def __init__(self, endpoint: str, keys: str | None) -> None:
        super().__init__(zmq.ROUTER, endpoint, {}, keys)


class ControlSocket:
    """Takes commands for a run until it is closed.

    Parameters
    ----------
    endpoint : address to bind. keys : as of `BoundSocket`. sensor : whose run it is. commands : of the run.

    Raises
    ------
    StageError
        If the address is taken or cannot be bound, or the keys are wrong.

    Attributes
    ----------
    endpoint : the real address, where a port was to be chosen.
    """

    def __init__(self, endpoint: str, keys: str | None, sensor: str, commands: Commands) -> None:
        self._sensor = sensor
        self._commands = commands
        self._by_name: Mapping[str, Callable[[], Answer]] = {
            "ping": lambda: {"message": "here"},
            "stats": lambda: {"message": "statistics so far", "stats": self._commands.snapshot()},
            "take_reference": self._take_reference,
            "pause": lambda: self._pause(True),
            "resume": lambda: self._pause(False),
            "record_start": self._record_start,
            "record_stop": self._record_stop,
        }
        self._closing = threading.Event()
        self._bound = _Socket(endpoint, keys)
        self.endpoint = self._bound.endpoint
        self._thread = threading.Thread(target=self._serve, name="tactflow-control", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Answer no more, and free the address."""
        self._closing.set()
        self._thread.join()
        self._bound.close(LINGER)

    def _serve(self) -> None:
        """Body of the thread."""
        while not self._closing.is_set():
            try:
                self._bound.refuse_crowd()
                socket = self._bound.socket
                if socket.poll(POLL_MS):
                    self._reply(socket, socket.recv_multipart(zmq.NOBLOCK))
                    self._closing.wait(REST)
            except zmq.Again:
                # What had come has been taken back as its connection ended.
                continue
            except FloodError as flood:
                endpoint = self._bound.endpoint
                try:
                    self._bound.renew()
                except StageError as error:
                    log.warning("zmq: %s on %s; no commands are taken any more: %s", flood, endpoint, error)
                    return
                log.warning("zmq: %s on %s; all who send commands were disconnected", flood, endpoint)

    def _reply(self, socket: zmq.Socket[bytes], parts: list[bytes]) -> None:
        """Answer what a REQ socket sends: where it comes from, nothing, one part. Drop everything else."""
        if b"" in parts:
            end = parts.index(b"") + 1
            # Whoever has left meanwhile, or does not read, gets none: ROUTER never waits.
            socket.send_multipart([*parts[:end], self._answer(parts[end:])])

    def _answer(self, request: list[bytes]) -> bytes:
        """What a request is answered, whatever it is."""
        try:
            answer = {"ok": True, **self._done(request)}
        except (RefusedError, StageError) as error:
            answer = {"ok": False, "message": str(error)}
        except Exception as error:
            log.warning("zmq: a command failed: %s: %s", type(error).__name__, error)
            answer = {"ok": False, "message": f"{type(error).__name__}: {error}"}
        answer["state"] = {"sensor": self._sensor, **self._commands.state()}
        return orjson.dumps(answer, option=orjson.OPT_NON_STR_KEYS | orjson.OPT_SERIALIZE_NUMPY)

    def _done(self, request: list[bytes]) -> Answer:
        try:
            (body,) = request
            wish = orjson.loads(body)
            name = wish["do"]
        except (ValueError, TypeError, KeyError):
            raise RefusedError('required one JSON object such as {"do": "ping"}') from None
        if not isinstance(name, str) or name not in self._by_name:
            there = ", ".join(self._by_name)
            raise RefusedError(f"there is no command {str(name)[:LONGEST_QUOTE]!r}; there are {there}")
        return self._by_name[name]()

    def _take_reference(self) -> Answer:
        self._commands.take_reference()
        return {"message": "the next frame is taken as the reference"}

    def _pause(self, paused: bool) -> Answer:
        self._commands.pause(paused)
        return {"message": "paused" if paused else "running"}

    def _record_start(self) -> Answer:
        refusal = self._commands.refusal("record")
        if refusal is not None:
            raise RefusedError(f"{refusal}; --set 'sinks.record={{trigger: button}}' adds one")
        already = self._commands.state()["recording"]
        recorder = self._commands.record(True)
        verb = "is recording already" if already else "recording"
        return {"message": f"{verb} to {recorder.description}", "path": recorder.description}

    def _record_stop(self) -> Answer:
        was = self._commands.state()["recording"]
        recorder = self._commands.record(False)
        if not was:
            return {"message": "nothing was being recorded"}
        return {"message": f"recorded to {recorder.description}", "path": recorder.description}
