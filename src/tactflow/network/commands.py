"""Commands to a run, from its live page and, over ZeroMQ, from other programs.

Over ZeroMQ, each request is a JSON object, and so is each reply:

{"do": "pause"}  ->  {"ok": true, "message": "paused", "state": {"sensor": "main", "paused": true, ...}}
"""

from __future__ import annotations

import logging
import threading
from contextlib import suppress
from typing import Any

import orjson
import zmq

from tactflow.engine.contract import Source
from tactflow.engine.control import Control
from tactflow.engine.errors import StageError
from tactflow.network.publisher import BoundSocket

log = logging.getLogger("tactflow")

POLL_MS = 200
"""Poll interval of the thread, ms. Chosen by hand."""
LINGER_SECONDS = 0.2
"""Time to deliver the last answer at the end of a run, s. Chosen by hand."""
REQUESTS = {
    "take_reference": ("reference", True),
    "pause": ("pause", True),
    "resume": ("pause", False),
    "record_start": ("record", True),
    "record_stop": ("record", False),
}
"""Name of a request over ZeroMQ -> the command and its value. There are also `ping` and `stats`."""
_HINT = (
    "another run takes commands there, or another program. End it, or choose another address "
    "(--set sinks.zmq.control=tcp://127.0.0.1:5558); several sensors need one each, such as "
    "ipc:///tmp/tactflow-{sensor}"
)

Answer = dict[str, Any]
"""`message`: what was done; for recordings also `path`."""


class RefusedError(Exception):
    """The command does not exist or is not possible now, for the reason given."""


class Commands:
    """Executes commands on a run, from any thread.

    Parameters
    ----------
    control : handle on the run; None refuses every command.
    """

    NAMES = ("pause", "step", "reference", "record", "stop")
    """Pause or resume; let one frame through while paused; take the next frames as a new reference; start or
    finish a recording; end the run."""

    def __init__(self, control: Control | None) -> None:
        self._control = control

    def refusal(self, name: str) -> str | None:
        """Why a command is not possible now, or None."""
        control = self._control
        if control is None:
            return "the run cannot be controlled"
        source = control.source
        if name == "step" and source is not None and source.live:
            return "a live source cannot be stepped"
        if name == "step" and not control.paused:
            return "pause first"
        if name == "reference" and (source is None or type(source).retake is Source.retake):
            return "this source cannot take a new reference"
        if name == "record" and control.recorder() is None:
            return "no record sink in this pipeline; --set 'sinks.record={trigger: button}' adds one"
        return None

    def execute(self, name: str, on: bool = True) -> Answer:
        """Execute a command of `NAMES`. on : False resumes a paused run, or finishes a recording.

        Raises RefusedError if `refusal` gives a reason, StageError if the recording cannot be written.
        """
        refusal, control = self.refusal(name), self._control
        if control is None or refusal is not None:
            raise RefusedError(refusal)
        if name == "record":
            return self._record(control, on)
        if name == "pause":
            control.pause(on)
            return {"message": "paused" if on else "running"}
        {"step": control.step, "reference": control.retake_reference, "stop": control.stop}[name]()
        return {"message": "the next frame is taken as the reference"} if name == "reference" else {}

    def _record(self, control: Control, on: bool) -> Answer:
        recorder = control.recorder()
        assert recorder is not None
        was_recording = recorder.recording
        (recorder.start_recording if on else recorder.stop_recording)()
        if not on and not was_recording:
            return {"message": "nothing was being recorded"}
        done = ("is recording already" if was_recording else "recording") if on else "recorded"
        return {"message": f"{done} to {recorder.description}", "path": recorder.description}

    def state(self) -> dict[str, Any]:
        """paused, recording : bool. source : state of the source in words, None before it is opened."""
        if self._control is None:
            return {"paused": False, "recording": False, "source": None}
        source, recorder = self._control.source, self._control.recorder()
        return {
            "paused": self._control.paused,
            "recording": recorder is not None and recorder.recording,
            "source": None if source is None else source.state,
        }

    def snapshot(self) -> dict[str, Any]:
        """The statistics so far."""
        return {} if self._control is None else dict(self._control.snapshot())


class ControlSocket(BoundSocket):
    """Serves the commands of a run over ZeroMQ, in a thread of its own, until it is closed.

    endpoint, keys, Raises : as for `BoundSocket`.

    Parameters
    ----------
    sensor : name in replies.
    control : handle on the run.
    """

    def __init__(self, endpoint: str, keys: str | None, sensor: str, control: Control | None) -> None:
        self._sensor = sensor
        self._commands = Commands(control)
        self._closing = threading.Event()
        # A REP socket would stop replying once a client leaves in the middle of a request.
        super().__init__(zmq.ROUTER, endpoint, _HINT, {}, keys)
        self._thread = threading.Thread(target=self._serve, name="tactflow-control", daemon=True)
        self._thread.start()

    def close(self, linger: float = LINGER_SECONDS) -> None:
        """Stop serving, and free the address."""
        self._closing.set()
        self._thread.join()
        super().close(linger)

    def _serve(self) -> None:
        while not self._closing.is_set():
            # A client that leaves can wake the poll without a message to receive.
            with suppress(zmq.Again):
                if self.socket.poll(POLL_MS):
                    parts = self.socket.recv_multipart(zmq.NOBLOCK)
                    # A REQ socket sends a return path, an empty part and the request. Drop anything else.
                    if b"" in parts:
                        end = parts.index(b"") + 1
                        self.socket.send_multipart([*parts[:end], self._reply(parts[end:])])

    def _reply(self, request: list[bytes]) -> bytes:
        try:
            return self._encoded({"ok": True, **self._answer(request)})
        except (RefusedError, StageError) as error:
            message = str(error)
        except Exception as error:
            message = f"{type(error).__name__}: {error}"
            log.warning("zmq: a command failed: %s", message)
        return self._encoded({"ok": False, "message": message})

    def _encoded(self, answer: Answer) -> bytes:
        answer = answer | {"state": {"sensor": self._sensor, **self._commands.state()}}
        return orjson.dumps(answer, option=orjson.OPT_NON_STR_KEYS | orjson.OPT_SERIALIZE_NUMPY)

    def _answer(self, request: list[bytes]) -> Answer:
        try:
            (body,) = request
            name = str(orjson.loads(body)["do"])
        except (ValueError, TypeError, KeyError):
            raise RefusedError('required one JSON object such as {"do": "ping"}') from None
        if name == "ping":
            return {"message": "here"}
        if name == "stats":
            return {"message": "statistics so far", "stats": self._commands.snapshot()}
        if name not in REQUESTS:
            known = ", ".join(("ping", "stats", *REQUESTS))
            raise RefusedError(f"there is no command {name[:40]!r}; there are {known}")
        return self._commands.execute(*REQUESTS[name])
