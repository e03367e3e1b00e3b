"""Commands to a run from outside: from its live page, and from programs over ZeroMQ."""

from __future__ import annotations

from typing import Any

from tactflow.engine.contract import Source
from tactflow.engine.control import Control

Answer = dict[str, Any]
"""`message`, what was done, in words; of recordings also `path`."""


class RefusedError(Exception):
    """The command does not exist, or is not possible now; says why."""


class Commands:
    """Carries out commands to a run, or says why not. From any thread.

    control : handle on the run; None: nothing is possible.

    Every command raises RefusedError where `refusal` gives a reason.
    """

    def __init__(self, control: Control | None) -> None:
        self._control = control

    def refusal(self, name: str) -> str | None:
        """Why a command is not possible now, or None.

        name : pause, step, reference, record or stop.
        """
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

    def pause(self, paused: bool) -> Answer:
        """Hold capturing, or go on."""
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
        """Begin or finish a recording.

        It touches the disk, so it may take a while. Raises StageError if the file cannot be written.
        """
        recorder = self._admitted("record").recorder()
        assert recorder is not None
        was_recording = recorder.recording
        if on:
            recorder.start_recording()
            text = "is recording already" if was_recording else "recording"
        else:
            recorder.stop_recording()
            text = "recorded"
            if not was_recording:
                return {"message": "nothing was being recorded"}
        return {"message": f"{text} to {recorder.description}", "path": recorder.description}

    def stop(self) -> None:
        """End the run."""
        self._admitted("stop").stop()

    def state(self) -> dict[str, Any]:
        """paused, recording : bool. source : its state in words, None before it is opened."""
        if self._control is None:
            return {"paused": False, "recording": False, "source": None}
        source, recorder = self._control.source, self._control.recorder()
        return {
            "paused": self._control.paused,
            "recording": recorder is not None and recorder.recording,
            "source": None if source is None else source.state,
        }

    def snapshot(self) -> dict[str, Any]:
        """The statistics so far; empty where there are none yet."""
        try:
            return {} if self._control is None else dict(self._control.snapshot())
        except RuntimeError:
            # The run is still opening its sinks, and its tables grew while they were read.
            return {}

    def _admitted(self, name: str) -> Control:
        """The run, if it can carry out a command now; else raises RefusedError."""
        refusal = self.refusal(name)
        if refusal is not None:
            raise RefusedError(refusal)
        assert self._control is not None
        return self._control
