"""Commands to a run, from its live page and from programs over ZeroMQ."""

from __future__ import annotations

from typing import Any

from tactflow.engine.contract import Source
from tactflow.engine.control import Control

Answer = dict[str, Any]
"""`message`: what was done; for recordings also `path`."""


class RefusedError(Exception):
    """The command does not exist or is not possible now, for the reason given."""


class Commands:
    """Executes commands on a run, from any thread. Raises RefusedError if `refusal` gives a reason.

    control : handle on the run; None refuses every command.
    """

    def __init__(self, control: Control | None) -> None:
        self._control = control

    def refusal(self, name: str) -> str | None:
        """Why pause, step, reference, record or stop is not possible now, or None."""
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

    def _admitted(self, name: str) -> Control:
        refusal = self.refusal(name)
        if self._control is None or refusal is not None:
            raise RefusedError(refusal)
        return self._control

    def pause(self, paused: bool) -> Answer:
        """Pause or resume capturing."""
        self._admitted("pause").pause(paused)
        return {"message": "paused" if paused else "running"}

    def step(self) -> None:
        """While paused, let one frame through."""
        self._admitted("step").step()

    def take_reference(self) -> Answer:
        """Take the next frames as a new reference."""
        self._admitted("reference").retake_reference()
        return {"message": "the next frame is taken as the reference"}

    def record(self, on: bool) -> Answer:
        """Start or finish a recording. Raises StageError if it cannot be written."""
        recorder = self._admitted("record").recorder()
        assert recorder is not None
        was_recording = recorder.recording
        (recorder.start_recording if on else recorder.stop_recording)()
        if not on and not was_recording:
            return {"message": "nothing was being recorded"}
        done = ("is recording already" if was_recording else "recording") if on else "recorded"
        return {"message": f"{done} to {recorder.description}", "path": recorder.description}

    def stop(self) -> None:
        """End the run."""
        self._admitted("stop").stop()

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
