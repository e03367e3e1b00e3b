"""Records the frames of a run: to files that follow each other, and the last seconds to memory."""

from __future__ import annotations

import logging
import threading
from collections import deque
from dataclasses import KW_ONLY, dataclass, replace
from pathlib import Path
from typing import Literal

from tactflow.drawing.jpeg import encode_jpeg
from tactflow.engine.control import Control
from tactflow.engine.rate import SLACK, RateLimit
from tactflow.message.result import Result, encode_message
from tactflow.recording.frames import encode_frame, nanoseconds
from tactflow.recording.schemas import encode_annotations, encode_picture
from tactflow.recording.writer import Entry, RecordingWriter
from tactflow.system.files import next_name

log = logging.getLogger("tactflow")

BACKLOG_SHARE = 4
"""Frames from memory that are written per new frame, so that saving them never holds up the run."""


@dataclass(eq=False)
class FrameRecorder:
    """Records frames to one file or several, from any of three triggers. From any thread.

    A file begins with the references that its first frame is compared with, so that it can be played by
    itself. Files but the first carry a number, `press-001.mcap`, and never replace another.

    path : the file; later, the one that was opened last. sensor : names the channels.
    control : the run, which the file describes; or None.
    trigger : "start" and "button" wait for `start`; "contact" records each contact to its own file.
    ring : the last seconds that are kept in memory and become the beginning of the file; None: none.
    memory : limit for these, MB. after : time that is recorded after a contact, s.
    rotate_size, rotate_after : begin another file after so many MB or seconds; None: never.
    preview : rate of the JPEG pictures, Hz; 0: none. quality : of these, 1 to 100.
    """

    path: Path
    sensor: str = "main"
    control: Control | None = None
    _: KW_ONLY
    trigger: Literal["start", "button", "contact"] = "start"
    ring: float | None = None
    memory: int = 2048
    after: float = 1.0
    rotate_size: int | None = None
    rotate_after: float | None = None
    preview: float = 10.0
    quality: int = 80

    def __post_init__(self) -> None:
        self._name = self.path
        self._counts = {"frames": 0, "files": 0, "bytes": 0}
        self._previews = RateLimit(self.preview) if self.preview else None
        self._lock = threading.RLock()
        self._file: RecordingWriter | None = None
        self._ends: int | None = None
        self._backlog: deque[Entry] = deque()
        self._references: list[Entry] = []
        self._ring: deque[Entry] = deque()
        self._ring_bytes = 0
        self._warned = False
        self._touching = False

    @property
    def recording(self) -> bool:
        """Whether a file is being written."""
        return self._file is not None

    @property
    def wants(self) -> bool:
        """Whether frames are written or kept."""
        return self.recording or self.ring is not None or self.trigger == "contact"

    def counters(self) -> dict[str, int]:
        """frames, files : written so far. bytes : of the finished files. ring_frames, ring_bytes : kept."""
        return self._counts | {"ring_frames": len(self._ring), "ring_bytes": self._ring_bytes}

    def start(self, *, numbered: bool = True, overwrite: bool = False) -> None:
        """Begin a file with what the ring holds, which then is all of it. Nothing while recording.

        numbered : begin a new, numbered file; else that of the name itself. Raises StageError if it cannot be
        written, or exists and `overwrite` is not set.
        """
        with self._lock:
            if self.recording:
                return
            self._open(next_name(self._name) if numbered else self._name, overwrite)
            if numbered:
                log.info("record: %s", self.path)
            self._backlog = deque(self._ring)
            self._ends = self._backlog[-1].time if self._backlog else None
            # While the run is paused, no frame comes that would take the ring along.
            if self._backlog and self.control is not None and self.control.paused:
                self.stop()

    def stop(self) -> None:
        """Finish the file, with all that belongs to it. Nothing while not recording. Raises StageError."""
        with self._lock:
            while self._is_due():
                self._write(self._backlog.popleft())
            self._finish()

    def add(self, result: Result) -> None:
        """Record one frame, or keep it for later.

        Raises StageError if it cannot be written. The file then ends with the frame before and can be played.
        """
        with self._lock:
            if not self.wants and not result.frame.reference:
                return
            entry = self._entry(result)
            if self.trigger == "contact":
                self._follow(result.contact is not None, result.frame.t)
            if self.recording:
                self._backlog.append(entry)
            for _ in range(BACKLOG_SHARE):
                if self._is_due():
                    self._write(self._backlog.popleft())
            if self._backlog and not self._is_due():
                self._finish()
            self._keep(entry)

    def _entry(self, result: Result) -> Entry:
        frame = result.frame
        time = nanoseconds(frame.t)
        data = {"frames": encode_frame(frame)}
        # A reference image that is not part of the source has no results.
        if frame.seq >= 0:
            data["results"] = encode_message(result, detail=True)
            if self._previews is not None and self._previews.due(frame.t):
                jpeg = encode_jpeg(frame.image if result.image is None else result.image, self.quality)
                data["image"] = encode_picture(jpeg, self.sensor, time)
                data["annotations"] = encode_annotations(result, time)
        return Entry(time, frame.seq, frame.reference, frame.epoch, data)

    def _follow(self, touching: bool, t: float) -> None:
        """Begin a file when a contact begins; it ends some time after the contact."""
        if touching and not self._touching:
            self.start()
        if touching:
            self._ends = nanoseconds(t + self.after + SLACK)
        self._touching = touching

    def _is_due(self) -> bool:
        """Whether the next entry of the backlog belongs to the file."""
        return bool(self._backlog) and (self._ends is None or self._backlog[0].time <= self._ends)

    def _keep(self, entry: Entry) -> None:
        """Remember the entry in the ring, and references for as long as frames of their epoch may follow."""
        ring = self._ring
        if self.ring is not None:
            ring.append(entry)
            self._ring_bytes += _size(entry)
            while ring[0].time < entry.time - round(self.ring * 1e9):
                self._ring_bytes -= _size(ring.popleft())
            while self._ring_bytes > self.memory * 1_000_000:
                self._ring_bytes -= _size(ring.popleft())
                if not self._warned:
                    self._warned = True
                    log.warning(
                        "record: the ring holds only %.1f s, as memory is limited to %d MB; raise memory",
                        (entry.time - ring[0].time) / 1e9 if ring else 0,
                        self.memory,
                    )
        if entry.reference:
            self._references.append(entry)
        oldest = min(waiting[0].epoch for waiting in (ring, self._backlog, [entry]) if waiting)
        self._references = [reference for reference in self._references if reference.epoch >= oldest]

    def _open(self, path: Path, overwrite: bool = False) -> RecordingWriter:
        self._file = RecordingWriter(path, self.sensor, self.control, overwrite=overwrite)
        self.path = path
        return self._file

    def _write(self, entry: Entry) -> None:
        """Write one entry, where the file is large or long enough to a further one."""
        file = self._file
        assert file is not None
        try:
            if file.frames and self._is_full(file, entry):
                # `recording` stays True meanwhile, or the run would leave out the next frame.
                self._finish_file(file)
                file = self._open(next_name(self._name))
                log.info("record: %s", self.path)
            if file.frames == 0:
                for reference in self._references:
                    if reference.epoch == entry.epoch and reference.seq < entry.seq:
                        # At the beginning of the file's time line, without results of that time.
                        file.write(replace(reference, data={"frames": reference.data["frames"]}), entry.time)
            file.write(entry)
        except BaseException:
            self._file = None
            self._backlog.clear()
            raise
        self._counts["frames"] += 1

    def _is_full(self, file: RecordingWriter, entry: Entry) -> bool:
        size, after = self.rotate_size, self.rotate_after
        return (size is not None and file.bytes >= size * 1_000_000) or (
            after is not None and entry.time - file.begins >= after * 1e9
        )

    def _finish(self) -> None:
        file, self._file = self._file, None
        self._backlog.clear()
        self._ends = None
        if file is not None:
            self._finish_file(file)

    def _finish_file(self, file: RecordingWriter) -> None:
        file.finish()
        self._counts["files"] += 1
        self._counts["bytes"] += file.bytes


def _size(entry: Entry) -> int:
    """Approximate memory, bytes, with 200 for the object and its fields."""
    return sum(map(len, entry.data.values())) + 200
