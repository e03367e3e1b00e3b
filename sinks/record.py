"""Record: lossless frames and their results in an MCAP file, which is also a source."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pydantic import Field, model_validator

from tactflow.drawing.jpeg import encode_jpeg
from tactflow.engine.contract import Recorder
from tactflow.engine.control import Control
from tactflow.engine.errors import StageError
from tactflow.engine.rate import TIME_TOLERANCE_S, RateLimit
from tactflow.message.result import Result, encode_message
from tactflow.outputs import OutputParams, OutputSink
from tactflow.recording import missing_packages
from tactflow.recording.course import Watcher
from tactflow.recording.verdict import Recorded, examine_recording, extent, verdict_of
from tactflow.system.files import expanded, next_name
from tactflow.vision.change import shows_gel

if TYPE_CHECKING:
    from tactflow.recording.writer import Entry, RecordingWriter

log = logging.getLogger("tactflow")

BACKLOG_FRAMES_PER_FRAME = 4
"""Frames of the ring written per new frame, so that saving them does not delay the run."""


class Record(OutputSink, Recorder):
    """Records from the start, on command, or during contacts.

    With `ring`, the last seconds are kept in memory, compressed, and become the beginning of the file. A
    recording always includes the reference frames of its frames.

    A recording from the start is written to `path`, all others to numbered files, `press-001.mcap`, which
    never replace a file. With `rotate_after`, a long recording continues in further numbered files, each of
    which can be played by itself.

    >>> import tactflow
    >>> settings = {"sinks": {"record": {"path": "a.mcap"}}}
    >>> result = tactflow.run("markerless", source="sim:unmarked", settings=settings, max_frames=3)
    >>> tactflow.run("markerless", source="a.mcap", settings={"sinks": {}}).stats["frames"]
    3
    """

    takes_references = True
    queue_capacity = 32

    class Params(OutputParams):
        """Destination, and start of a recording."""

        path: str = Field(
            "recording.mcap", pattern=r"\.mcap$", description="file, relative to the current directory"
        )
        trigger: Literal["start", "button", "contact"] | None = Field(
            None,
            description="starts a recording: start of the run, button of the view, or each contact; "
            "null: the button if there is a ring, else the start",
        )
        ring: float | None = Field(
            None, gt=0, le=3600, description="seconds kept in memory, with which a recording begins"
        )
        memory: int = Field(
            2048, ge=16, description="limit of the ring, MB (30 s of 800 x 600 at 60 Hz take 1300)"
        )
        after: float = Field(1.0, ge=0, description="seconds recorded after a contact has ended")
        rotate_after: float | None = Field(
            None, gt=0, description="time after which another numbered file begins, s"
        )
        preview: float = Field(10.0, ge=0, le=240, description="rate of JPEG previews, Hz; 0: none")
        quality: int = Field(80, ge=1, le=100, description="of the previews; higher is sharper and larger")

        @model_validator(mode="after")
        def _ring_needs_a_moment(self) -> Record.Params:
            if self.ring is not None and self.trigger == "start":
                raise ValueError("ring keeps the time before a trigger: set trigger to button or contact")
            return self

        @property
        def begins(self) -> Literal["start", "button", "contact"]:
            """The trigger, with the default resolved."""
            return self.trigger or ("start" if self.ring is None else "button")

        @property
        def refuses_existing(self) -> bool:
            """Whether an existing file is an error; numbered files never replace one."""
            return self.begins == "start" and not self.overwrite

        def needed_inputs(self) -> Mapping[str, str]:
            """The trigger `contact` requires the port `contact`."""
            return {"contact": "trigger"} if self.trigger == "contact" else {}

    def __init__(self, params: Params, sensor: str = "main", control: Control | None = None) -> None:
        """Prepare; nothing is written yet.

        sensor : names the channels of the file. control : the run, whose settings are attached; or None.
        """
        super().__init__(params)
        self._sensor = sensor
        self._control = control
        self._counts = {"frames": 0, "files": 0, "bytes": 0}
        self._previews = RateLimit(params.preview) if params.preview else None
        self._lock = threading.RLock()
        self._file: RecordingWriter | None = None
        self._ends: int | None = None
        self._backlog: deque[Entry] = deque()
        self._references: list[Entry] = []
        self._ring: deque[Entry] = deque()
        self._ring_bytes = 0
        self._warned = False
        self._touching = False
        self._watcher = Watcher()
        self._recorded = Recorded()

    def open(self) -> None:
        """Create the file, if recording starts with the run.

        Raises StageError if the file exists and `overwrite` is not set, another run is writing to it, it
        cannot be written, or a package is missing.
        """
        problem = missing_packages()
        if problem is not None:
            raise StageError(problem)
        if self.params.begins == "start":
            self._open_file(expanded(self.params.path), self.params.overwrite)

    def begin(self) -> None:
        """Empty the file, if it is replaced, and write what precedes the frames."""
        if self._file is not None:
            self._file.begin()

    @property
    def recording(self) -> bool:
        """Whether a file is being written. With a ring, this ends by itself."""
        return self._file is not None

    def start_recording(self) -> None:
        """Start a numbered file. With a ring, save the ring and finish. Does nothing if recording.

        Raises StageError if it cannot be written.
        """
        with self._lock:
            if self.recording:
                return
            self._open_next()
            self._backlog = deque(self._ring)
            self._ends = self._backlog[-1].time if self._backlog else None
            # While the run is paused, no frame would trigger the writing of the ring.
            if self._backlog and self._control is not None and self._control.paused:
                self.stop_recording()

    def stop_recording(self) -> None:
        """Finish the file, including pending frames. Does nothing if not recording.

        Raises StageError if it cannot be written.
        """
        with self._lock:
            while self._is_due():
                self._write_entry(self._backlog.popleft())
            self._finish()

    def wants(self) -> bool:
        """Whether frames are written or kept in memory."""
        return self.recording or self.params.ring is not None or self.params.trigger == "contact"

    def counters(self) -> dict[str, int]:
        """frames, files : written so far. bytes : of finished files. ring_frames, ring_bytes : in memory."""
        return self._counts | {"ring_frames": len(self._ring), "ring_bytes": self._ring_bytes}

    def write(self, result: Result) -> None:
        """Record one frame, or keep it in memory.

        Raises StageError if it cannot be written. The file then ends with the previous frame, and plays.
        """
        with self._lock:
            if not self.wants() and not result.frame.reference:
                return
            entry = self._entry(result)
            if self.params.trigger == "contact":
                self._follow(result.contact is not None, entry.time)
            if self.recording:
                self._backlog.append(entry)
            for _ in range(BACKLOG_FRAMES_PER_FRAME):
                if self._is_due():
                    self._write_entry(self._backlog.popleft())
            if self._backlog and not self._is_due():
                self._finish()
            self._keep(entry)

    def close(self) -> None:
        """Write pending frames, and finish the file."""
        self.stop_recording()

    def _entry(self, result: Result) -> Entry:
        from tactflow.recording.frames import encode_frame, nanoseconds
        from tactflow.recording.schemas import encode_annotations, encode_picture
        from tactflow.recording.writer import Entry

        frame = result.frame
        time = nanoseconds(frame.t)
        data = {"frames": encode_frame(frame)}
        glance = None
        # A reference image that is not part of the source has no results.
        if frame.seq >= 0:
            empty = frame.damaged and not shows_gel(frame.image)
            glance = self._watcher.look(
                frame.image,
                frame.t,
                frame.seq,
                reference=frame.reference,
                empty=empty,
                damaged=frame.damaged and not empty,
            )
            data["results"] = encode_message(result, detail=True)
            if self._previews is not None and self._previews.due(frame.t):
                image = frame.image if result.image is None else result.image
                jpeg = encode_jpeg(image, self.params.quality)
                data["image"] = encode_picture(jpeg, self._sensor, time)
                data["annotations"] = encode_annotations(result, time)
        return Entry(time, frame.seq, frame.reference, frame.epoch, data, glance)

    def _follow(self, touching: bool, time: int) -> None:
        """Start a file when a contact begins; it ends some time after the contact."""
        if touching and not self._touching:
            self.start_recording()
        if touching:
            self._ends = time + round((self.params.after + TIME_TOLERANCE_S) * 1e9)
        self._touching = touching

    def _is_due(self) -> bool:
        """Whether the next entry of the backlog belongs to the file."""
        return bool(self._backlog) and (self._ends is None or self._backlog[0].time <= self._ends)

    def _keep(self, entry: Entry) -> None:
        """Keep the entry in the ring, and references while frames of their epoch may follow."""
        ring = self._ring
        if self.params.ring is not None:
            ring.append(entry)
            self._ring_bytes += _size(entry)
            while ring[0].time < entry.time - round(self.params.ring * 1e9):
                self._ring_bytes -= _size(ring.popleft())
            while self._ring_bytes > self.params.memory * 1_000_000:
                self._ring_bytes -= _size(ring.popleft())
                if not self._warned:
                    self._warned = True
                    log.warning(
                        "record: the ring holds only %.1f s, as memory is limited to %d MB; raise memory",
                        (entry.time - ring[0].time) / 1e9 if ring else 0,
                        self.params.memory,
                    )
        if entry.reference:
            self._references.append(entry)
        oldest = min(waiting[0].epoch for waiting in (ring, self._backlog, [entry]) if waiting)
        self._references = [reference for reference in self._references if reference.epoch >= oldest]

    def _open_file(self, path: Path, overwrite: bool = False) -> RecordingWriter:
        from tactflow.recording.provenance import facts, kept_files
        from tactflow.recording.writer import RecordingWriter

        self._file = RecordingWriter(
            path,
            self._sensor,
            facts=facts(self._sensor, self._control),
            files=kept_files(self._control),
            overwrite=overwrite,
        )
        self.description = str(path)
        return self._file

    def _open_next(self) -> RecordingWriter:
        file = self._open_file(next_name(expanded(self.params.path)))
        log.info("record: %s", file.path)
        return file

    def _write_entry(self, entry: Entry) -> None:
        """Write one entry, to a further file if the current one is full."""
        file = self._file
        assert file is not None
        try:
            if file.frames and self._is_full(file, entry):
                # `recording` must stay True meanwhile, so that the run does not skip the next frame.
                self._finish_file(file)
                file = self._open_next()
            if file.frames == 0:
                for reference in self._references:
                    if reference.epoch == entry.epoch and reference.seq < entry.seq:
                        # At the beginning of the time line, without their earlier results.
                        file.write(replace(reference, data={"frames": reference.data["frames"]}), entry.time)
            file.write(entry)
        except BaseException:
            self._file = None
            self._backlog.clear()
            raise
        self._counts["frames"] += 1
        if entry.glance is not None:
            self._recorded.course.add(entry.glance)

    def _is_full(self, file: RecordingWriter, entry: Entry) -> bool:
        after = self.params.rotate_after
        return after is not None and entry.time - file.begins >= after * 1e9

    def _finish(self) -> None:
        file, self._file = self._file, None
        self._backlog.clear()
        self._ends = None
        if file is not None:
            self._finish_file(file)
            self._judge(file.path)

    def _judge(self, path: Path) -> None:
        """Give the verdict on a recording that is finished, and begin anew."""
        recorded, self._recorded = self._recorded, Recorded()
        self.verdict = str(verdict_of(examine_recording(recorded), extent(recorded)))
        if self.params.begins != "start":
            log.info("record: %s is %s", path, self.verdict)

    def _finish_file(self, file: RecordingWriter) -> None:
        file.finish()
        self._counts["files"] += 1
        self._counts["bytes"] += file.bytes


def _size(entry: Entry) -> int:
    """Approximate memory, bytes, with 200 for the object and its fields."""
    return sum(map(len, entry.data.values())) + 200
