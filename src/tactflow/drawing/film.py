"""A video file, written frame by frame and checked at the end: FFmpeg reports no failed write."""

from __future__ import annotations

import logging
import os
import shutil
import statistics
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.engine.errors import StageError
from tactflow.outputs import FREE_SPACE, open_output, refuse_interference

log = logging.getLogger("tactflow")

CODECS = {".avi": "MJPG", ".mkv": "mp4v", ".mp4": "mp4v", ".m4v": "mp4v", ".mov": "mp4v"}
FRAMES_TO_MEASURE_RATE = 12
"""Frames held back at the start to measure their rate. Chosen by hand."""
MIN_FREE_BYTES = 16 << 20
"""Free space at which the disk counts as full, bytes: pending frames and the index still fit. By hand."""


class Film:
    """A video file that is being written.

    Pictures with an odd side are padded by a copy of the last row or column, which the encoder would
    otherwise cut off.

    Every method raises StageError if the file exists or cannot be written, or OpenCV cannot encode it.

    Parameters
    ----------
    path : the file; its extension chooses the codec.
    fps : frames per second; None: the rate of the first frames.
    overwrite : replace an existing file.

    Attributes
    ----------
    frames : written so far.
    """

    def __init__(self, path: Path, *, fps: float | None = None, overwrite: bool = False) -> None:
        self.frames = 0
        self._path = path
        self._fps = fps
        self._held: list[tuple[float, NDArray[np.uint8]]] = []
        self._writer: cv2.VideoWriter | None = None
        self._size: tuple[int, int] | None = None
        self._begun = False
        # OpenCV opens the file again; this one holds the lock.
        self._file = open_output(path, overwrite=overwrite)
        self._ours = os.fstat(self._file.fileno())
        self._codec = CODECS[path.suffix.lower()]

    def begin(self) -> None:
        """Empty a file that is replaced. Called once, or by the first `add`."""
        if not self._begun:
            self._begun = True
            self._file.truncate(0)

    def add(self, t: float, picture: NDArray[np.uint8]) -> None:
        """Add one frame. t : its time, s. picture : (H, W, 3) uint8 BGR.

        Also refuses a picture of another size, and ends the film when the disk is nearly full.
        """
        self.begin()
        size = (picture.shape[1], picture.shape[0])
        self._size = self._size or size
        if size != self._size:
            raise StageError(
                f"{self._path}: a video has one size, {self._size[0]} x {self._size[1]}, but this frame is "
                f"{size[0]} x {size[1]}"
            )
        if self._writer is not None:
            self._write(self._writer, picture)
            return
        self._held.append((t, picture))
        if self._fps is not None or len(self._held) >= FRAMES_TO_MEASURE_RATE:
            self._start(*size)

    def close(self) -> None:
        """Finish the file, and check that all frames are in it; without any, it is removed.

        Without `begin`, a file that would have been replaced stays.
        """
        try:
            if self._held and self._size is not None:
                self._start(*self._size)
        finally:
            writer, self._writer = self._writer, None
            if writer is not None:
                writer.release()
            self._file.close()
        if writer is not None:
            refuse_interference(self._path, self._ours, f"its {self.frames} frames are not in it")
            problem = film_problem(self._path, self.frames)
            if problem is not None:
                raise StageError(f"{self._path}: {problem}; is the disk full, or the size of files limited?")
        elif self.frames == 0 and (self._begun or self._ours.st_size == 0):
            self._path.unlink(missing_ok=True)

    def _start(self, width: int, height: int) -> None:
        rate = self._fps or _rate([t for t, _ in self._held])
        # If a pipe has taken its place, FFmpeg would wait for ever for a reader.
        refuse_interference(self._path, self._ours, "nothing was written")
        writer = cv2.VideoWriter(
            str(self._path),
            cv2.CAP_FFMPEG,
            cv2.VideoWriter.fourcc(*self._codec),
            rate,
            (width + width % 2, height + height % 2),
        )
        if not writer.isOpened():
            raise StageError(f"{self._path}: this OpenCV cannot encode {self._path.suffix}; try .avi or .mkv")
        self._writer = writer
        log.info("%s: %d x %d, %g fps, %s", self._path, width, height, rate, self._codec)
        held, self._held = self._held, []
        for _, picture in held:
            self._write(writer, picture)

    def _write(self, writer: cv2.VideoWriter, picture: NDArray[np.uint8]) -> None:
        if shutil.disk_usage(self._path.parent).free < MIN_FREE_BYTES:
            self._writer = None
            writer.release()
            problem = film_problem(self._path, self.frames) if self.frames else None
            kept = problem or f"the {self.frames} frames written before can be played"
            raise StageError(f"{self._path}: the disk is full; {kept}; {FREE_SPACE}")
        height, width = picture.shape[:2]
        writer.write(cv2.copyMakeBorder(picture, 0, height % 2, 0, width % 2, cv2.BORDER_REPLICATE))
        self.frames += 1


def film_problem(path: Path, frames: int) -> str | None:
    """Why a film cannot be read to its last frame, or None.

    frames : expected number. A truncated file may still claim all of them, so the last one is read.
    """
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    try:
        if not capture.isOpened():
            return "it cannot be played, as its end could not be written"
        claimed = capture.get(cv2.CAP_PROP_FRAME_COUNT)
        capture.set(cv2.CAP_PROP_POS_FRAMES, frames - 1)
        there = capture.get(cv2.CAP_PROP_POS_FRAMES) == frames - 1 and capture.grab()
        if claimed == frames and there:
            return None
        return f"it ends before its {frames} frames, as its end could not be written"
    finally:
        capture.release()


def _rate(times: list[float]) -> float:
    """Frames per second, from the median step between times, s; 30 where there is none."""
    steps = [later - earlier for earlier, later in pairwise(times) if later > earlier]
    return min(max(1.0 / statistics.median(steps), 0.01), 1000.0) if steps else 30.0
