"""Video: annotated frames as a file to watch."""

from __future__ import annotations

import logging
import os
import shutil
import statistics
import tempfile
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from tactflow.engine.contract import Output, Sink, StageParams
from tactflow.engine.errors import StageError
from tactflow.engine.frame import Tick
from tactflow.ports import Picture
from tactflow.system.files import claim_path, expanded, is_device, make_folder, next_name, taken_away

log = logging.getLogger("tactflow")

CODECS = {".avi": "MJPG", ".mkv": "mp4v", ".mp4": "mp4v", ".m4v": "mp4v", ".mov": "mp4v"}
LOSSLESS_CODECS = {".avi": ("HFYU", "FFV1"), ".mkv": ("HFYU", "FFV1")}
FRAMES_TO_MEASURE_RATE = 12
"""Frames held back at the start, because their rate is not known before. Chosen by hand."""
MIN_FREE_BYTES = 16 << 20
"""Free space, bytes, at which the disk counts as full: what is under way and the index still fit. By hand."""


class Video(Sink):
    """Writes annotated frames to a video file; its extension chooses the codec.

    The file plays at the pace at which the frames were captured: without `fps`, the rate is the median of
    the first frames' time differences. Players show frames at a constant rate, so frames that a live run
    dropped shorten the film. Pictures with an odd side get one more row or column, a copy of the last:
    otherwise the encoder would cut it off.
    """

    threaded = True

    class Params(StageParams):
        """Where to write, and how."""

        path: str = Field(
            "annotated.avi",
            description="file: .avi (MJPG), .mkv, .mp4, .m4v, .mov (MPEG-4); relative to the current "
            "directory. An .avi survives a killed process, an .mp4 does not",
        )
        lossless: bool = Field(
            False, description="keep every bit (HFYU, else FFV1; .avi or .mkv): about a third of the raw size"
        )
        fps: float | None = Field(
            None, gt=0, le=1000, description="rate of the file, frames per second; default: as captured"
        )
        overwrite: bool = Field(False, description="replace an existing file")

        @model_validator(mode="after")
        def _known_extension(self) -> Video.Params:
            known = LOSSLESS_CODECS if self.lossless else CODECS
            suffix = Path(self.path).suffix.lower()
            if suffix not in known:
                kind = "a lossless video" if self.lossless else "a video"
                raise ValueError(
                    f"required a path that ends in {', '.join(known)} for {kind}, got {self.path!r}"
                )
            return self

    def __init__(self, params: Params) -> None:
        """Prepare; nothing is opened yet."""
        super().__init__(params)
        self._path = expanded(params.path)
        self.description = str(self._path)
        self._codec = ""
        self._held: list[tuple[float, Picture]] = []
        self._writer: cv2.VideoWriter | None = None
        self._size: tuple[int, int] | None = None
        self._ours: os.stat_result | None = None
        self._claim: int | None = None
        self._frames = 0

    @classmethod
    def outputs(cls, params: Video.Params) -> Sequence[Output]:
        """The file."""
        return (Output(expanded(params.path), "file", "path", refuses_existing=not params.overwrite),)

    @classmethod
    def on_restart(cls, params: Video.Params) -> Video.Params:
        """It goes on in another file, `annotated-001.avi`, beside the one that it has begun."""
        return params.changed(path=str(next_name(expanded(params.path))), overwrite=False)

    def open(self) -> None:
        """Choose the codec and create the folder; the file itself follows with the first frames.

        Raises
        ------
        StageError
            If the file exists, is a pipe or device, its folder cannot be written, or this OpenCV cannot
            encode it: a lossless codec is tried on a small picture and must give back every bit.
        """
        self._refuse_what_is_there()
        try:
            make_folder(self._path.parent)
            with tempfile.TemporaryDirectory(dir=self._path.parent, prefix=".tactflow-") as folder:
                self._codec = self._choose_codec(Path(folder) / f"probe{self._path.suffix.lower()}")
        except OSError as error:
            raise StageError(f"{self._path}: cannot be written: {error.strerror or error}") from error

    def _choose_codec(self, probe: Path) -> str:
        suffix = probe.suffix
        for codec in LOSSLESS_CODECS[suffix] if self.params.lossless else (CODECS[suffix],):
            if _codec_works(probe, codec, exact=self.params.lossless):
                return codec
        kind = "losslessly" if self.params.lossless else "at all"
        raise StageError(f"{self._path}: this OpenCV cannot encode {suffix} {kind}; try .avi or .mkv")

    def counters(self) -> dict[str, int]:
        """frames : written so far."""
        return {"frames": self._frames}

    def write(self, tick: Tick, annotated: Picture) -> None:
        """Add one frame.

        Raises
        ------
        StageError
            If the picture changes its size, or the disk is nearly full. The film then ends with the frame
            before.
        """
        size = (annotated.shape[1], annotated.shape[0])
        if self._size is not None and size != self._size:
            raise StageError(
                f"{self._path}: a video has one size, {self._size[0]} x {self._size[1]}, but this frame is "
                f"{size[0]} x {size[1]}"
            )
        self._size = size
        if self._writer is None:
            self._held.append((tick.frame.t, annotated))
            if self.params.fps is not None or len(self._held) >= FRAMES_TO_MEASURE_RATE:
                self._start()
        else:
            self._add(annotated)

    def close(self) -> None:
        """Finish the file.

        Raises
        ------
        StageError
            If not all frames are in it: the disk, or a limit on the size of files, ended it early, or another
            program has taken it away.
        """
        try:
            if self._held:
                self._start()
        finally:
            if self._writer is not None:
                self._writer.release()
                self._writer = None
            if self._claim is not None:
                os.close(self._claim)
                self._claim = None
        if self._ours is not None:
            self._check_file(self._ours)

    def _refuse_what_is_there(self) -> None:
        # FFmpeg would wait for the reader of a pipe for ever.
        if is_device(str(self._path)):
            raise StageError(f"{self._path}: required a file, not a pipe or device; give another path")
        if self._path.exists() and not self.params.overwrite:
            raise StageError(f"{self._path}: this file exists; set overwrite: true or give another path")

    def _refuse_full_disk(self) -> None:
        """End the film while its end still fits."""
        if shutil.disk_usage(self._path.parent).free >= MIN_FREE_BYTES:
            return
        writer, self._writer, self._ours = self._writer, None, None
        problem = None
        if writer is not None:
            writer.release()
            problem = film_problem(self._path, self._frames)
        kept = problem or f"the {self._frames} frames written before can be played"
        raise StageError(f"{self._path}: the disk is full; {kept}")

    def _check_file(self, ours: os.stat_result) -> None:
        """The encoder tells nobody that a write failed: look at the file."""
        what = taken_away(self._path, ours)
        if what is not None:
            raise StageError(
                f"{self._path}: was {what} by another program while the run wrote to it; its {self._frames} "
                "frames are not in it"
            )
        problem = film_problem(self._path, self._frames)
        if problem is not None:
            raise StageError(f"{self._path}: {problem}; is the disk full, or the size of files limited?")

    def _start(self) -> None:
        assert self._size is not None
        rate = self.params.fps or _rate([t for t, _ in self._held])
        width, height = (side + side % 2 for side in self._size)
        code = cv2.VideoWriter.fourcc(*self._codec)
        held, self._held = self._held, []
        self._refuse_what_is_there()
        self._refuse_full_disk()
        try:
            self._path.touch()
            self._claim = claim_path(self._path)
        except OSError as error:
            raise StageError(f"{self._path}: cannot be written: {error.strerror or error}") from error
        self._writer = cv2.VideoWriter(str(self._path), cv2.CAP_FFMPEG, code, rate, (width, height))
        if not self._writer.isOpened():
            raise StageError(f"{self._path}: cannot be written; may this folder be written to?")
        self._ours = self._path.stat()
        log.info("%s: %d x %d, %g fps, %s", self._path, width, height, rate, self._codec)
        for _, picture in held:
            self._add(picture)

    def _add(self, picture: Picture) -> None:
        assert self._writer is not None
        self._refuse_full_disk()
        self._writer.write(_padded(picture))
        self._frames += 1


def film_problem(path: Path, frames: int) -> str | None:
    """What keeps a film from being read to its last frame, or None.

    frames : how many there are to be. A file that was cut off may still claim all of them.
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
    steps = [later - earlier for earlier, later in pairwise(times) if later > earlier]
    return min(max(1.0 / statistics.median(steps), 0.01), 1000.0) if steps else 30.0


def _padded(picture: Picture) -> NDArray[np.uint8]:
    height, width = picture.shape[:2]
    if height % 2 == 0 and width % 2 == 0:
        return picture
    return np.asarray(
        cv2.copyMakeBorder(picture, 0, height % 2, 0, width % 2, cv2.BORDER_REPLICATE), np.uint8
    )


def _codec_works(path: Path, codec: str, *, exact: bool) -> bool:
    """Write two frames and read them again; with `exact` they must come back as they were."""
    # Noise has detail in every channel: a codec that stores colour at half the resolution is found out.
    frames = np.random.default_rng(0).integers(0, 256, (2, 48, 64, 3), np.uint8)
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*codec), 30.0, (64, 48))
    if not writer.isOpened():
        return False
    for frame in frames:
        writer.write(frame)
    writer.release()
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    try:
        back = [capture.read() for _ in frames]
    finally:
        capture.release()
    if not all(there for there, _ in back):
        return False
    return not exact or all(np.array_equal(a, b) for a, (_, b) in zip(frames, back, strict=True))
