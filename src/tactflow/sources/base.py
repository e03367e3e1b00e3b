"""Base of all sources: frames in sequence, of one size, as BGR pixels."""

from __future__ import annotations

import itertools
import logging
import os
from collections.abc import Iterator
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.engine.errors import SourceError
from tactflow.engine.frame import MAX_PIXELS
from tactflow.system.extras import missing
from tactflow.vision.arrays import ColorImage

log = logging.getLogger("tactflow")

# Silence OpenCV and FFmpeg, because our messages are clearer. FFmpeg reads its level when OpenCV opens
# the first file with it; OpenCV 5 has the function in another module than OpenCV 4.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
if "OPENCV_LOG_LEVEL" not in os.environ:
    (getattr(cv2, "setLogLevel", None) or cv2.utils.logging.setLogLevel)(0)

DEFAULT_FPS = 30.0
"""Rate of images, arrays and videos without one, frames per second. Chosen by hand."""
TWELVE_BIT_LEVELS = 4096
"""A 16-bit frame with only smaller values is from a sensor with 12 bits or fewer, grey levels."""
MIN_SIDE_PX = 2
"""Minimum number of rows and columns, px, because stages halve the picture."""


class Arrival(NamedTuple):
    """A frame of a source.

    Attributes
    ----------
    image, t : as from `FrameReader.read`.
    seq, reference, epoch : as in `Frame`; for a live source, seq also counts frames that were never read.
    paced : False for a reference that is delivered ahead of its time.
    captured : monotonic time (`time.perf_counter`) of its arrival, s; 0 for a recording.
    damaged : as in `Frame`.
    """

    image: ColorImage
    t: float
    seq: int
    reference: bool = False
    epoch: int = 0
    paced: bool = True
    captured: float = 0.0
    damaged: bool = False


class FrameReader:
    """A sequence of frames.

    A subclass yields its pictures from `_frames`, with any type of pixels; `read` converts them and checks
    their size.

    Parameters
    ----------
    name : for messages.

    Attributes
    ----------
    live : whether frames arrive at the camera's pace; a recording waits until it is read.
    fps : frames per second, or None if unknown.
    size : (width, height) of the frames, px, or None before the first one.
    total : number of frames, or None if unknown or endless.
    description : one line for messages.
    state : of a live source: `running`, `waiting since ...` or `reconnecting since ...`.
    missed : frames of a live source that a newer one replaced before they were read.
    begins : Unix time of t = 0, s; None if unknown.
    remark : what is wrong with a file that can be read all the same, or "".
    lacking : frames that the file states but does not have; known at its end.
    stamped : whether the frames already passed through `capture`, which then uses their seq, reference,
        epoch and paced, as in `Arrival`, unchanged; `_frames` yields these too.
    """

    live = False
    fps: float | None = None
    size: tuple[int, int] | None = None
    total: int | None = None
    description = ""
    state = "running"
    missed = 0
    begins: float | None = None
    remark = ""
    lacking = 0
    stamped = False
    parser_errors: tuple[type[Exception], ...] = (OSError,)
    """Exceptions of `_frames` on damaged data, which are converted to SourceError."""

    def __init__(self, name: str) -> None:
        self.name = name
        self._picture = ""
        """Name of the next picture of `_frames` in messages; if empty, its index."""
        self._arrivals: Iterator[Arrival] = self._converted()

    def _frames(self) -> Iterator[tuple[Any, ...]]:
        """Yield all pictures, as accepted by `to_bgr`, and their times, s."""
        raise NotImplementedError

    def read(self) -> tuple[ColorImage, float] | None:
        """The next frame and its time, or None at the end.

        Returns
        -------
        image : (H, W, 3) uint8 BGR; must not be modified.
        t : s; from the start for a recording, Unix time for a live source.

        Raises
        ------
        SourceError
            If the next frame cannot be read.
        """
        arrival = self.read_arrival()
        return None if arrival is None else (arrival.image, arrival.t)

    def read_arrival(self) -> Arrival | None:
        """Like `read`, with the metadata for `capture`."""
        return next(self._arrivals, None)

    def peek(self) -> tuple[ColorImage, float] | None:
        """The next frame, without consuming it; None at the end. Raises as `read`."""
        arrival = self.read_arrival()
        if arrival is None:
            return None
        self._arrivals = itertools.chain([arrival], self._arrivals)
        return arrival.image, arrival.t

    def stop(self) -> None:
        """End a read that waits for a live source. Thread-safe."""

    def close(self) -> None:
        """Release the file or device; `read` then returns None. Idempotent."""
        self._arrivals = iter(())

    def _read_first(self, empty: str = "there is no picture in it") -> None:
        """Read the first frame ahead to determine `size`. Raises SourceError if there is none."""
        try:
            if self.peek() is None:
                raise SourceError(f"{self.name}: {empty}")
        except SourceError:
            self.close()
            raise

    def _converted(self) -> Iterator[Arrival]:
        """The frames of `_frames`, with pictures in BGR and of one size."""
        first = None
        try:
            for index, (image, t, *stamp) in enumerate(self._frames()):
                place = self._picture or f"{self.name}, frame {index}"
                bgr = to_bgr(image, place, note=first is None)
                size = (bgr.shape[1], bgr.shape[0])
                if first is None:
                    check_pixel_count(place, *size)
                    if min(size) < MIN_SIDE_PX:
                        raise SourceError(
                            f"{place}: its pictures are {size[0]} x {size[1]}; required {MIN_SIDE_PX} x "
                            f"{MIN_SIDE_PX} pixels or more"
                        )
                    self.size = first = size
                if size != first:
                    raise SourceError(
                        f"{place}: this frame is {size[0]} x {size[1]} pixels, the ones before it are "
                        f"{first[0]} x {first[1]}; a source must keep its size. "
                        "Remove the odd frame, or run the two recordings one after the other"
                    )
                yield Arrival(bgr, t, *(stamp or [index]))
        except SourceError:
            raise
        except self.parser_errors as error:
            raise damaged(self.name, error) from error


class CaptureReader(FrameReader):
    """A source opened by OpenCV: a video, a camera, a stream.

    Parameters
    ----------
    name : for messages.
    failure : error message if it cannot be opened.
    *arguments : of `cv2.VideoCapture`.
    """

    def __init__(self, name: str, failure: str, *arguments: Any) -> None:
        super().__init__(name)
        self._capture: cv2.VideoCapture | None = cv2.VideoCapture(*arguments)
        if not self._capture.isOpened():
            raise SourceError(failure)
        self._update_size()

    def _update_size(self) -> None:
        width, height = map(int, map(self._property, (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)))
        check_pixel_count(self.name, width, height)
        self.size = (width, height)
        self._size_text = f"{width} x {height}"

    def _property(self, number: int) -> float:
        """A property of the source (`cv2.CAP_PROP_...`); 0 if unknown."""
        return 0.0 if self._capture is None else self._capture.get(number)

    def _grab(self) -> NDArray[Any] | None:
        """Decode the next picture; None if there is none."""
        if self._capture is None:
            return None
        arrived, image = self._capture.read()
        return image if arrived else None

    def close(self) -> None:
        """Release the file or device."""
        super().close()
        if self._capture is not None:
            self._capture.release()
            self._capture = None


def to_bgr(image: NDArray[Any], name: str, *, note: bool = True) -> ColorImage:
    """Convert a gray, BGR, BGRA or 16-bit picture to (H, W, 3) uint8 BGR.

    >>> bgr = to_bgr(np.full((2, 2), 65535, np.uint16), "example")
    >>> bgr.shape, bgr.dtype, int(bgr.max())
    ((2, 2, 3), dtype('uint8'), 255)

    image : (H, W) or (H, W, C) with C in 1, 3, 4; uint8 or uint16; others raise SourceError.
    name : of the picture, for messages. note : whether to log conversions.
    """
    channels = image.shape[2] if image.ndim == 3 else 1
    if image.ndim not in (2, 3) or channels not in (1, 3, 4):
        raise SourceError(f"{name}: required 1, 3 or 4 channels, got shape {image.shape}")
    if image.dtype != np.uint8:
        # A file may have 16-bit pixels in the other byte order.
        if image.dtype.newbyteorder("=") != np.uint16:
            raise SourceError(f"{name}: required 8- or 16-bit unsigned pixels, got {image.dtype}")
        image = image.astype(np.uint16, copy=False)
        if note:
            log.info("%s: 16-bit values are scaled to 8 bit (divided by 257)", name)
            if 0 < (peak := int(image.max(initial=0))) < TWELVE_BIT_LEVELS:
                text = "%s: no value above %d: a sensor with fewer bits? It will be dark; scale it to 16 bits"
                log.warning(text, name, peak)
        image = cv2.convertScaleAbs(image, alpha=255.0 / 65535.0)
    if channels == 3:
        return np.ascontiguousarray(image)
    if channels == 4 and note:
        log.info("%s: the fourth channel (alpha) is ignored", name)
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR if channels == 1 else cv2.COLOR_BGRA2BGR))


def check_array(array: Any, name: str) -> None:
    """Raise SourceError unless an array, of NumPy, HDF5 or Zarr, holds frames.

    They are uint8 or uint16, N x H x W or N x H x W x C with C in 1, 3, 4, of `MAX_PIXELS` at most.
    """
    required = "required uint8 or uint16 of N x H x W x 3 (BGR) or N x H x W (gray)"
    got = f"got {array.dtype} of shape {' x '.join(map(str, array.shape)) or '()'}"
    if array.ndim == 3 and array.shape[2] in (3, 4):
        raise SourceError(f"{name}: {required}, {got}; a single picture? Give array[None]")
    if (
        array.dtype.newbyteorder("=") not in (np.uint8, np.uint16)
        or array.ndim not in (3, 4)
        or array.shape[3:] not in ((), (1,), (3,), (4,))
        or 0 in array.shape
    ):
        raise SourceError(f"{name}: {required}, {got}")
    check_pixel_count(name, array.shape[2], array.shape[1])


def check_pixel_count(name: str, width: int, height: int) -> None:
    """Raise SourceError for pictures of more than `MAX_PIXELS`, before memory is allocated for them."""
    if width * height > MAX_PIXELS:
        raise SourceError(
            f"{name}: its pictures are {width} x {height}, more than {MAX_PIXELS} pixels; if that is right, "
            "set the environment variable OPENCV_IO_MAX_IMAGE_PIXELS"
        )


def require(name: object, feature: str, extra: str, *modules: str) -> None:
    """Raise SourceError unless these packages are installed; arguments as for `missing`."""
    problem = missing(feature, extra, modules)
    if problem is not None:
        raise SourceError(f"{name}: {problem}")


def damaged(name: str, error: Exception) -> SourceError:
    """The error for a file that cannot be read, or whose parser failed."""
    if isinstance(error, OSError) and error.strerror:
        return SourceError(f"{name}: cannot be read: {error.strerror}")
    message = str(error).strip().partition("\n")[0]
    return SourceError(f"{name}: is damaged or cut off ({message or type(error).__name__})")
