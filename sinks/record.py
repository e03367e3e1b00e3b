"""Record: every accepted frame without loss, and its results, in an MCAP file that can be played again."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Literal

from pydantic import Field, model_validator

from tactflow.drawing.jpeg import encode_jpeg
from tactflow.engine.contract import Output, Recorder, StageParams
from tactflow.engine.control import Control
from tactflow.engine.errors import StageError
from tactflow.engine.rate import SLACK, RateLimit
from tactflow.message.result import Result, encode_message
from tactflow.recording import missing_packages
from tactflow.system.files import expanded, next_name
from tactflow.system.provenance import arrays, facts, texts

if TYPE_CHECKING:
    from tactflow.recording.frames import FrameCoder
    from tactflow.recording.series import FileSeries
    from tactflow.recording.writer import About, Entry

log = logging.getLogger("tactflow")

BACKLOG_SHARE = 4
"""Frames from memory that are written per new frame, so that saving them never holds up the run."""


class Record(Recorder):
    """Records to a file from the start, when told to, or when something touches the gel.

    With `ring`, the last seconds are kept in memory, compressed, and become the beginning of the file. A
    recording always holds the reference frames that its frames are compared with.

    A recording from the start goes to `path` itself and all others to `path` with a number, `press-001.mcap`;
    those never replace a file. With `rotate_size` or `rotate_after`, a long recording goes on in further
    numbered files, each of which can be played by itself. `start_recording` and `stop_recording` may be
    called from any thread.
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
        self._trigger = params.trigger or ("start" if params.ring is None else "button")
        self._sensor = sensor
        self._control = control
        self._lock = threading.RLock()
        self._coder: FrameCoder | None = None
        self._files: FileSeries | None = None
        self._ends = False
        self._backlog: deque[Entry] = deque()
        self._references: list[Entry] = []
        self._ring: deque[Entry] = deque()
        self._ring_bytes = 0
        self._warned = False
        self._touching = False
        self._touched = 0.0
        self._previews = RateLimit(params.preview) if params.preview else None

    @classmethod
    def outputs(cls, params: Record.Params) -> Sequence[Output]:
        """The file, or the one whose name the numbered files carry."""
        return (Output(expanded(params.path), "file", "path", refuses_existing=_refuses(params)),)

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
        from tactflow.recording.frames import FrameCoder
        from tactflow.recording.series import FileSeries

        p = self.params
        self._coder = FrameCoder()
        self._files = FileSeries(
            expanded(p.path), self._about, rotate_size=p.rotate_size, rotate_after=p.rotate_after
        )
        if self._trigger == "start":
            self._begin(numbered=False)

    @property
    def recording(self) -> bool:
        """Whether a file is being written. In ring mode it ends by itself."""
        return self._files is not None and self._files.is_open

    def start_recording(self) -> None:
        """Begin a new file with a number of its own; with a ring, save what it holds. Nothing if recording.

        Raises
        ------
        StageError
            If it cannot be written.
        """
        with self._lock:
            if not self.recording and self._coder is not None:
                self._begin(numbered=True)
                self._ends = self.params.ring is not None
                # While the run is paused no frame comes along that would take the ring with it.
                if self._ends and self._control is not None and self._control.paused:
                    self.stop_recording()

    def stop_recording(self) -> None:
        """Finish the file, with all that belongs to it. Nothing if not recording.

        Raises
        ------
        StageError
            If it cannot be written.
        """
        with self._lock:
            if self.recording:
                self._write_backlog(len(self._backlog))
                self._finish()

    def wants(self) -> bool:
        """Whether frames are written or kept."""
        return self.recording or self.params.ring is not None or self._trigger == "contact"

    def counters(self) -> dict[str, int]:
        """frames, files : written so far. bytes : of the finished files. ring_frames, ring_bytes : kept."""
        files = self._files
        counts = {key: 0 if files is None else getattr(files, key) for key in ("frames", "files", "bytes")}
        return counts | {"ring_frames": len(self._ring), "ring_bytes": self._ring_bytes}

    def write(self, result: Result) -> None:
        """Record one frame, or keep it for later.

        Raises
        ------
        StageError
            If it cannot be written. The file then ends with the frame before and can be played.
        """
        with self._lock:
            if not self.wants() and not result.frame.reference:
                return
            entry = self._entry(result)
            if self._trigger == "contact":
                self._follow(result.contact is not None, result.frame.t)
            if self.recording and not self._ends:
                self._backlog.append(entry)
            self._write_backlog(BACKLOG_SHARE)
            if self._ends and not self._backlog:
                self._finish()
            self._keep(entry)

    def close(self) -> None:
        """Write what is left, and finish the file."""
        try:
            self.stop_recording()
        finally:
            self._coder = None
            self._ring.clear()

    def _entry(self, result: Result) -> Entry:
        from tactflow.recording.frames import nanoseconds
        from tactflow.recording.schemas import encode_annotations, encode_picture
        from tactflow.recording.writer import Entry

        assert self._coder is not None
        frame = result.frame
        time = nanoseconds(frame.t)
        message = picture = annotations = None
        # A reference image that is not part of the source has no results of its own.
        if frame.seq >= 0:
            message = encode_message(result, detail=True)
            if self._previews is not None and self._previews.due(frame.t):
                image = frame.image if result.image is None else result.image
                jpeg = encode_jpeg(image, self.params.quality)
                picture = encode_picture(jpeg, self._sensor, time)
                annotations = encode_annotations(result, time)
        pixels = self._coder.encode(frame)
        return Entry(time, frame.seq, frame.reference, frame.epoch, pixels, message, picture, annotations)

    def _follow(self, touching: bool, t: float) -> None:
        """Begin a file when a contact begins, and end it some time after the contact."""
        if touching:
            if not self.recording and not self._touching:
                self._begin(numbered=True)
            elif self._ends:
                # Touched again while the rest is being written: go on with what came meanwhile.
                self._ends = False
                written = self._backlog[-1].time if self._backlog else 0
                self._backlog.extend(entry for entry in self._ring if entry.time > written)
            self._touched = t
        elif self.recording and t - self._touched > self.params.after + SLACK:
            self._ends = True
        self._touching = touching

    def _keep(self, entry: Entry) -> None:
        """Remember the entry in the ring, and references for as long as frames of their epoch may follow."""
        ring, seconds = self._ring, self.params.ring
        if seconds is not None:
            ring.append(entry)
            self._ring_bytes += entry.size
            limit = self.params.memory * 1_000_000
            while ring and ring[0].time < entry.time - seconds * 1e9:
                self._ring_bytes -= ring.popleft().size
            while ring and self._ring_bytes > limit:
                self._ring_bytes -= ring.popleft().size
                self._warn_of_memory(ring[-1].time - ring[0].time if ring else 0)
        if entry.reference:
            self._references.append(entry)
        oldest = ring[0].epoch if ring else entry.epoch
        self._references = [reference for reference in self._references if reference.epoch >= oldest]

    def _warn_of_memory(self, nanoseconds: int) -> None:
        if not self._warned:
            self._warned = True
            log.warning(
                "record: the ring holds only %.1f s, because memory is limited to %d MB; raise memory",
                nanoseconds / 1e9,
                self.params.memory,
            )

    def _begin(self, *, numbered: bool) -> None:
        """Open a file; the references and what the ring holds are to be written first."""
        assert self._files is not None
        first = self._ring[0] if self._ring else None
        references = [
            reference
            for reference in self._references
            if first is None or (reference.epoch == first.epoch and reference.seq < first.seq)
        ]
        if numbered:
            self._files.begin_next(references)
        else:
            self._files.begin(references, overwrite=self.params.overwrite)
        self.description = str(self._files.path)
        self._ends = False
        self._backlog = deque(self._ring)

    def _write_backlog(self, most: int) -> None:
        for _ in range(min(most, len(self._backlog))):
            assert self._files is not None
            try:
                self._files.write(self._backlog.popleft())
            except StageError:
                self._backlog.clear()
                raise
            self.description = str(self._files.path)

    def _finish(self) -> None:
        assert self._files is not None
        self._ends = False
        self._files.finish()

    def _about(self) -> About:
        from tactflow.recording.writer import About

        return About(
            self._sensor, facts(self._sensor, self._control), texts(self._control), arrays(self._control)
        )


def _refuses(params: Record.Params) -> bool:
    """Whether a file that is there already ends the run: only that of a recording from the start."""
    at_start = params.trigger == "start" or (params.trigger is None and params.ring is None)
    return at_start and not params.overwrite
