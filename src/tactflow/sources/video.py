"""Video files, decoded by OpenCV, or by PyAV where OpenCV has no decoder."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.engine.errors import SourceError
from tactflow.sources.base import (
    DEFAULT_FPS,
    CaptureReader,
    FrameReader,
    check_pixel_count,
    damaged,
    log,
)
from tactflow.system.extras import missing
from tactflow.vision.arrays import ColorImage

MAX_FPS = 1e4
"""Maximum rate of a video file, frames per second; larger ones are ignored. Chosen by hand."""
PLAYLIST_MAGICS = (b"#EXTM3U", b"ffconcat")
"""First bytes of playlists, whose files FFmpeg would open."""
UNDECODED_CODECS = {"AV01": "AV1"}
"""Four characters of a codec -> its name, where OpenCV's wheels have no decoder without a graphics card."""
MAX_TAIL_GAPS = 1.5
"""Longest time from the last frame to the stated end of a complete video, in its longest gaps between frames:
the last frame lasts for one, and half of one is for rounding, so that a single lost frame is reported."""
PTS = getattr(cv2, "CAP_PROP_PTS", -1)
"""Property with the time of a frame in the file, in frames; OpenCV before 4.11 has none."""

Stamped = tuple[NDArray[Any], float, float]
"""A picture, its time stamp, and its time in the file, which may begin later than at 0; s, 0 if unknown."""


def open_video(path: Path, fps: float | None = None) -> FrameReader:
    """Open a video with OpenCV, or with PyAV if OpenCV cannot decode it.

    fps : frames per second if the file does not state it. Raises SourceError.
    """
    refuse_playlist(path)
    try:
        return VideoFile(path, fps)
    except SourceError:
        if missing("videos", "video", ["av"]) is None:
            # If PyAV fails too, the error above describes the file better.
            with suppress(Exception):
                return PyAvVideo(path, fps)
        raise


def refuse_playlist(path: Path) -> None:
    """Raise SourceError for an empty file and for a playlist: a video must not open other files."""
    try:
        with path.open("rb") as file:
            head = file.read(64)
    except OSError as error:
        raise damaged(str(path), error) from error
    if not head:
        raise SourceError(f"{path}: the file is empty")
    if head.lstrip(b"\xef\xbb\xbf \r\n").startswith(PLAYLIST_MAGICS):
        raise SourceError(f"{path}: a list of other files, not a video; name one of them")


class VideoFile(CaptureReader):
    """A video file, read by OpenCV's FFmpeg; arguments as for `open_video`.

    The time of a frame is its time stamp in the file, from 0 at the first frame; if stamps are missing or do
    not increase, the duration of a frame is added.
    """

    def __init__(self, path: Path, fps: float | None = None) -> None:
        failure = (
            f"{path}: neither a video that OpenCV can open, nor an image, nor a .npy array; "
            "an .mp4 or .avi that was not closed properly cannot be opened either"
        )
        super().__init__(str(path), failure, str(path), cv2.CAP_FFMPEG)
        stated = self._property(cv2.CAP_PROP_FPS)
        self.fps = stated if 0 < stated < MAX_FPS else fps or DEFAULT_FPS
        # Of containers that state only the duration, such as Matroska, this is an estimate.
        self.total = max(int(self._property(cv2.CAP_PROP_FRAME_COUNT)), 0) or None
        self._read_first(_no_frame(path, int(self._property(cv2.CAP_PROP_FOURCC))))
        self.description = f"{path}, {self._size_text} at {self.fps:g} fps"

    def _frames(self) -> Iterator[tuple[NDArray[Any], float]]:
        return _timed(self._pictures(), self)

    def _pictures(self) -> Iterator[Stamped]:
        while (image := self._grab()) is not None:
            stamp = self._property(cv2.CAP_PROP_POS_MSEC) / 1000.0
            yield image, stamp, max(stamp, self._property(PTS) / (self.fps or DEFAULT_FPS))


class PyAvVideo(FrameReader):
    """A video file, read by PyAV; arguments and times as for `VideoFile`."""

    parser_errors = (Exception,)

    def __init__(self, path: Path, fps: float | None = None) -> None:
        super().__init__(str(path))
        self._path = path
        with _opened(path) as file:
            (stream, *_) = file.streams.video
            stated = float(stream.average_rate or 0)
            self.fps = stated if 0 < stated < MAX_FPS else fps or DEFAULT_FPS
            seconds = (file.duration or 0) / 1e6
        self.total = stream.frames or round(seconds * self.fps) or None
        self._read_first()
        width, height = self.size or (0, 0)
        self.description = f"{path}, {width} x {height} at {self.fps:g} fps"

    def _frames(self) -> Iterator[tuple[NDArray[Any], float]]:
        pictures = decode(self._path, self.name)
        return _timed(((image, stamp, stamp) for image, stamp in pictures), self)


def decode(path: Path, name: str, begin: float = 0.0) -> Iterator[tuple[ColorImage, float]]:
    """Decode a video with PyAV: (H, W, 3) uint8 BGR, and their times in the file, s; 0 if unknown.

    begin : time from which on pictures are yielded, s. name : for messages. Raises SourceError for too large
    pictures, and exceptions of PyAV for damaged data.
    """
    with _opened(path) as file:
        (stream, *_) = file.streams.video
        check_pixel_count(name, stream.width, stream.height)
        if begin > 0:
            # Seeks to the key frame before; the pictures from there on are decoded.
            file.seek(int(begin / (stream.time_base or 1)), stream=stream)
        for frame in file.decode(stream):
            if frame.time is None or frame.time >= begin:
                image = np.asarray(frame.to_ndarray(format="bgr24"), np.uint8)
                yield np.rot90(image, frame.rotation // 90), frame.time or 0.0


def _opened(path: Path) -> Any:
    """The file, opened by PyAV; nothing that it refers to can be."""
    import av

    return av.open(f"file:{path}", options={"protocol_whitelist": "file"})


def _no_frame(path: Path, fourcc: int) -> str:
    """Message for a video without a frame that OpenCV can decode. fourcc : its codec."""
    name = fourcc.to_bytes(4, "little", signed=fourcc < 0).decode("latin-1").upper()
    problem = missing(f"{UNDECODED_CODECS.get(name)} videos", "video", ["av"])
    if name in UNDECODED_CODECS and problem is not None:
        return f"{problem}; or convert it: ffmpeg -i {path.name} -c:v libx264 -crf 10 {path.stem}-h264.mp4"
    codec = f" ({name})" if name.isalnum() else ""
    return f"the video{codec} holds no frame that can be decoded; is it damaged?"


def _timed(pictures: Iterator[Stamped], video: FrameReader) -> Iterator[tuple[NDArray[Any], float]]:
    """The pictures and their times from 0 at the first; warns if the video ends before its stated end.

    Then `lacking` of the video is the number of frames until there, at its mean rate.
    """
    usual = 1.0 / (video.fps or DEFAULT_FPS)
    count, t, end, longest, first_stamp = 0, 0.0, 0.0, usual, 0.0
    for image, stamp, place in pictures:
        if count == 0:
            first_stamp = stamp
        else:
            before, t = t, stamp - first_stamp if stamp - first_stamp > t else t + usual
            longest = max(longest, t - before)
        count, end = count + 1, max(t, place)
        yield image, t
    # The stated count may be an estimate from rate and duration, but not that duration.
    if video.total is not None and 0 < count < video.total:
        lost = video.total * usual - end
        if lost > MAX_TAIL_GAPS * longest:
            video.lacking = round(lost / usual) - 1
            text = "%s: ended after %d frames, %.3g s before its stated end; the file may be damaged"
            log.warning(text, video.name, count, lost)
