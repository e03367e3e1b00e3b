"""The socket for commands to a run: one JSON object per request, one per reply. It has its own thread.

{"do": "pause"}  ->  {"ok": true, "message": "paused", "state": {"sensor": "main", "paused": true, ...}}
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress

import orjson
import zmq

from tactflow.engine.errors import StageError
from tactflow.network.bound_socket import BoundSocket
from tactflow.network.commands import Answer, Commands, RefusedError

log = logging.getLogger("tactflow")

POLL_MS = 200
"""Poll interval of the thread, ms. Chosen by hand."""
LINGER = 0.2
"""Time to deliver the last answer at the end of a run, s. Chosen by hand."""
LONGEST_QUOTE = 40
"""Characters of an unknown command that the reply repeats at most."""
_HINT = (
    "another run takes commands there, or another program. End it, or choose another address "
    "(--set sinks.zmq.control=tcp://127.0.0.1:5558); several sensors need one each, such as "
    "ipc:///tmp/tactflow-{sensor}"
)


class ControlSocket:
    """Serves commands for a run until it is closed.

    endpoint, keys, Raises : as for `BoundSocket`. sensor : name in replies. commands : executes them. The
    attribute `endpoint` is the bound address.
    """

    def __init__(self, endpoint: str, keys: str | None, sensor: str, commands: Commands) -> None:
        self._sensor = sensor
        self._commands = commands
        self._by_name: Mapping[str, Callable[[], Answer]] = {
            "ping": lambda: {"message": "here"},
            "stats": lambda: {"message": "statistics so far", "stats": commands.snapshot()},
            "take_reference": commands.take_reference,
            "pause": lambda: commands.pause(True),
            "resume": lambda: commands.pause(False),
            "record_start": lambda: commands.record(True),
            "record_stop": lambda: commands.record(False),
        }
        self._closing = threading.Event()
        # A REP socket would stop replying once a client leaves in the middle of a request.
        self._bound = BoundSocket(zmq.ROUTER, endpoint, _HINT, {}, keys)
        self.endpoint = self._bound.endpoint
        self._thread = threading.Thread(target=self._serve, name="tactflow-control", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop serving, and free the address."""
        self._closing.set()
        self._thread.join()
        self._bound.close(LINGER)

    def _serve(self) -> None:
        socket = self._bound.socket
        while not self._closing.is_set():
            # A client that leaves can wake the poll without a message to receive.
            with suppress(zmq.Again):
                if socket.poll(POLL_MS):
                    parts = socket.recv_multipart(zmq.NOBLOCK)
                    # A REQ socket sends a return path, an empty part and the request. Drop anything else.
                    if b"" in parts:
                        end = parts.index(b"") + 1
                        socket.send_multipart([*parts[:end], self._answer(parts[end:])])

    def _answer(self, request: list[bytes]) -> bytes:
        try:
            return self._encoded({"ok": True, **self._carry_out(request)})
        except (RefusedError, StageError) as error:
            message = str(error)
        except Exception as error:
            message = f"{type(error).__name__}: {error}"
            log.warning("zmq: a command failed: %s", message)
        return self._encoded({"ok": False, "message": message})

    def _encoded(self, answer: Answer) -> bytes:
        answer = answer | {"state": {"sensor": self._sensor, **self._commands.state()}}
        return orjson.dumps(answer, option=orjson.OPT_NON_STR_KEYS | orjson.OPT_SERIALIZE_NUMPY)

    def _carry_out(self, request: list[bytes]) -> Answer:
        try:
            (body,) = request
            name = str(orjson.loads(body)["do"])
        except (ValueError, TypeError, KeyError):
            raise RefusedError('required one JSON object such as {"do": "ping"}') from None
        if name not in self._by_name:
            known = ", ".join(self._by_name)
            raise RefusedError(f"there is no command {name[:LONGEST_QUOTE]!r}; there are {known}")
        return self._by_name[name]()
