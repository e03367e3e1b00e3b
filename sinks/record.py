"""Record: every accepted frame without loss, and its results, in an MCAP file that can be played again."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Literal

from pydantic import Field, model_validator

from tactflow.engine.contract import Output, Recorder, StageParams
from tactflow.engine.control import Control
from tactflow.engine.errors import StageError
from tactflow.message.result import Result
from tactflow.recording import missing_packages
from tactflow.system.files import expanded, next_name

if TYPE_CHECKING:
    from tactflow.recording.recorder import FrameRecorder


class Record(Recorder):
    """Records to a file from the start, when told to, or when something touches the gel.

    With `ring`, the last seconds are kept in memory, compressed, and become the beginning of the file. A
    recording always holds the reference frames that its frames are compared with.

    A recording from the start goes to `path` itself and all others to `path` with a number, `press-001.mcap`;
    those never replace a file. With `rotate_size` or `rotate_after`, a long recording goes on in further
    numbered files, each of which can be played by itself.
    """

    threaded = True
    takes_references = True
    queue_capacity = 32

    class Params(StageParams):
        """Where to record to, and what begins a recording."""

        path: str = Field(
            "recording.mcap", pattern=r"\.mcap$", description="file, relative to the current directory"
        )
        overwrite: bool = Field(False, description="replace an existing file")
        trigger: Literal["start", "button", "contact"] | None = Field(
            None,
            description="what begins a recording: the start of the run, the button of the view, or a contact "
            "(each contact its own file); null: the button if there is a ring, else the start",
        )
        ring: float | None = Field(
            None,
            gt=0,
            le=3600,
            description="keep so many last seconds in memory, s; the button saves them, and a contact's "
            "recording begins with them",
        )
        memory: int = Field(
            2048,
            ge=16,
            description="most that the ring may take, MB (30 s of 800 x 600 at 60 Hz take 1300); what does "
            "not fit is left out, with a warning",
        )
        after: float = Field(1.0, ge=0, description="a contact's recording ends so long after the contact, s")
        rotate_size: int | None = Field(
            None, ge=1, description="go on in another, numbered file when this one has so many MB"
        )
        rotate_after: float | None = Field(
            None, gt=0, description="go on in another, numbered file when this one is so long, s"
        )
        preview: float = Field(
            10.0, ge=0, le=240, description="rate of the JPEG pictures for people, Hz; 0 leaves them out"
        )
        quality: int = Field(80, ge=1, le=100, description="of those; higher is sharper and larger")

        @model_validator(mode="after")
        def _ring_needs_a_moment(self) -> Record.Params:
            if self.ring is not None and self.trigger == "start":
                raise ValueError("ring keeps what came before a trigger: set trigger to button or contact")
            return self

        @property
        def begins(self) -> Literal["start", "button", "contact"]:
            """The trigger that is meant."""
            return self.trigger or ("start" if self.ring is None else "button")

        def needed_inputs(self) -> Mapping[str, str]:
            """A contact must be seen to begin a recording."""
            return {"contact": "trigger"} if self.trigger == "contact" else {}

    def __init__(self, params: Params, sensor: str = "main", control: Control | None = None) -> None:
        """Prepare; nothing is written yet.

        Parameters
        ----------
        sensor : names the channels of the file.
        control : handle on the run, for the settings that are written beside the frames.
        """
        super().__init__(params)
        self.description = params.path
        self._sensor = sensor
        self._control = control
        self._recorder: FrameRecorder | None = None

    @classmethod
    def outputs(cls, params: Record.Params) -> Sequence[Output]:
        """The file, or the one whose name the numbered files carry."""
        refuses = params.begins == "start" and not params.overwrite
        return (Output(expanded(params.path), "file", "path", refuses_existing=refuses),)

    @classmethod
    def on_restart(cls, params: Record.Params) -> Record.Params:
        """It goes on in another file, beside the one that it has begun."""
        return params.changed(path=str(next_name(expanded(params.path))), overwrite=False)

    def open(self) -> None:
        """Begin the file, if recording starts with the run.

        Raises
        ------
        StageError
            If the file exists and `overwrite` is not set, it cannot be written, or a package is missing.
        """
        problem = missing_packages()
        if problem is not None:
            raise StageError(problem)
        from tactflow.recording.recorder import FrameRecorder

        p = self.params
        options = p.model_dump(exclude={"path", "overwrite", "trigger"})
        path = expanded(p.path)
        self._recorder = FrameRecorder(path, self._sensor, self._control, trigger=p.begins, **options)
        if p.begins == "start":
            self._recorder.start(numbered=False, overwrite=p.overwrite)

    @property
    def recording(self) -> bool:
        """Whether a file is being written. In ring mode it ends by itself."""
        return self._recorder is not None and self._recorder.recording

    def start_recording(self) -> None:
        """Begin a new file with a number of its own; with a ring, save what it holds. Nothing if recording.

        Raises
        ------
        StageError
            If it cannot be written.
        """
        if self._recorder is not None:
            self._recorder.start()
            self.description = str(self._recorder.path)

    def stop_recording(self) -> None:
        """Finish the file. Nothing if not recording. Raises StageError if it cannot be written."""
        if self._recorder is not None:
            self._recorder.stop()

    def wants(self) -> bool:
        """Whether frames are written or kept."""
        return self._recorder is not None and self._recorder.wants

    def counters(self) -> dict[str, int]:
        """frames, files : written so far. bytes : of the finished files. ring_frames, ring_bytes : kept."""
        return {} if self._recorder is None else self._recorder.counters()

    def write(self, result: Result) -> None:
        """Record one frame, or keep it for later.

        Raises
        ------
        StageError
            If it cannot be written. The file then ends with the frame before and can be played.
        """
        if self._recorder is not None:
            self._recorder.add(result)
            self.description = str(self._recorder.path)

    def close(self) -> None:
        """Write what is left, and finish the file."""
        self.stop_recording()
