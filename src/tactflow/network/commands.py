"""What may be asked of a run from outside: by its page, and by programs over ZeroMQ."""

from __future__ import annotations

from typing import Any

from tactflow.engine.contract import Recorder, Source
from tactflow.engine.control import Control


class RefusedError(Exception):
    """There is no such command, or it is not possible now; says why."""


class Commands:
    """Does what is asked of a run, or says why not. From any thread.

    control : handle on the run; None: nothing is possible.
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
        if name == "step":
            if source is not None and source.live:
                return "a live source cannot be stepped"
            return None if control.paused else "pause first"
        if name == "reference" and (source is None or type(source).retake is Source.retake):
            return "this source cannot take a new reference"
        if name == "record" and control.recorder() is None:
            return "no record sink in this pipeline"
        return None

    def pause(self, paused: bool) -> None:
        """Hold capturing, or go on."""
        self._possible("pause").pause(paused)

    def step(self) -> None:
        """While paused, let one frame through."""
        self._possible("step").step()

    def take_reference(self) -> None:
        """Take the next frames as a new reference."""
        self._possible("reference").retake_reference()

    def record(self, on: bool) -> Recorder:
        """Begin or finish a recording; the sink that does.

        It touches the disk, so it may take a while. Raises StageError if the file cannot be written.
        """
        recorder = self._possible("record").recorder()
        assert recorder is not None
        if on:
            recorder.start_recording()
        else:
            recorder.stop_recording()
        return recorder

    def stop(self) -> None:
        """End the run."""
        self._possible("stop").stop()

    def state(self) -> dict[str, Any]:
        """paused, recording : bool. source : in words, None where there is none yet."""
        control = self._control
        source = None if control is None else control.source
        recorder = None if control is None else control.recorder()
        return {
            "paused": control is not None and control.paused,
            "recording": recorder is not None and recorder.recording,
            "source": None if source is None else source.state,
        }

    def snapshot(self) -> dict[str, Any]:
        """The statistics so far; empty where there are none yet."""
        if self._control is None:
            return {}
        try:
            return dict(self._control.snapshot())
        except RuntimeError:
            # The run is still opening its sinks: its tables grew while they were read. The next one is whole.
            return {}

    def _possible(self, name: str) -> Control:
        """The run, if a command is possible now.

        Raises
        ------
        RefusedError : it is not.
        """
        refusal = self.refusal(name)
        if refusal is not None:
            raise RefusedError(refusal)
        assert self._control is not None
        return self._control
