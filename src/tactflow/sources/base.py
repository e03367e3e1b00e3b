"""What all sources have in common: frames one after the other, of one size, as BGR pixels."""

from __future__ import annotations

import logging
import os
from collections import deque
from collections.abc import Iterator
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.engine.errors import SourceError
from tactflow.engine.frame import MOST_PIXELS

log = logging.getLogger("tactflow")

# OpenCV's and FFmpeg's own messages do not belong on standard error: ours say the same more clearly. FFmpeg
# reads its level once, when OpenCV opens the first file with it; OpenCV 5 keeps its own elsewhere than 4.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
if "OPENCV_LOG_LEVEL" not in os.environ:
    (getattr(cv2, "setLogLevel", None) or cv2.utils.logging.setLogLevel)(0)

SPARSE_PEAK = 4096
"""A 16-bit frame without a value from here on comes from a sensor with 12 bits or fewer, grey levels."""
FEWEST_BITS = 10
"""Sensors whose pixels are stored in 16 bits have at least so many."""

BgrImage = NDArray[np.uint8]


class FrameReader:
    """Frames, one after the other.

    Each kind of source is a subclass that yields its pictures from `_frames`, in whatever pixels they are
    stored; `read` converts them and checks their size.

    live : frames arrive at the camera's pace; a recording waits until it is read.
    fps : frames per second, or None if unknown.
    size : (width, height) of the frames, px, or None before the first one.
    total : number of frames, or None if unknown or endless.
    description : one line for people.

    name : what messages call the source.
    """

    live = False
    fps: float | None = None
    size: tuple[int, int] | None = None
    total: int | None = None
    description = ""
    parser_errors: tuple[type[Exception], ...] = (OSError,)
    """What `_frames` may raise on damaged data; it reaches the caller as a SourceError."""

    def __init__(self, name: str) -> None:
        self.name = name
        self._normalise = Normaliser(name)
        self._iterator: Iterator[tuple[Any, ...]] | None = None
        self._peeked: deque[tuple[Any, ...]] = deque()
        self._error: SourceError | None = None

    def _frames(self) -> Iterator[tuple[Any, ...]]:
        """Yield every picture, as `Normaliser` takes them, and its time, s; ends at the last one."""
        raise NotImplementedError

    def read(self) -> tuple[BgrImage, float] | None:
        """The next frame and its time, or None at the end.

        Returns
        -------
        image : (H, W, 3) uint8 BGR; the caller must not write to it.
        t : s; from the start for a recording, Unix time for a live source.

        Raises
        ------
        SourceError
            If the next frame cannot be read.
        """
        item = self._read()
        return None if item is None else (item[0], item[1])

    def peek(self) -> tuple[BgrImage, float] | None:
        """The next frame that was neither read nor peeked at; `read` still returns it in its turn.

        None at the end, and where reading fails: `read` then raises in its turn.
        """
        try:
            item = None if self._error is not None else self._next()
        except SourceError as error:
            self._error = error
            return None
        if item is None:
            return None
        self._peeked.append(item)
        return item[0], item[1]

    def close(self) -> None:
        """Release the file or device; `read` then returns None. May be called twice."""
        self._iterator, self._error = iter(()), None
        self._peeked.clear()

    def _read_first(self, empty: str = "there is no picture in it") -> None:
        """Read the first frame ahead, so that `size` is known. Raises SourceError if there is none."""
        if self.peek() is None:
            error = self._error or SourceError(f"{self.name}: {empty}")
            self.close()
            raise error

    def _read(self) -> tuple[Any, ...] | None:
        if self._peeked:
            return self._peeked.popleft()
        if self._error is not None:
            raise self._error
        return self._next()

    def _next(self) -> tuple[Any, ...] | None:
        if self._iterator is None:
            self._iterator = self._frames()
        try:
            item = next(self._iterator, None)
        except SourceError:
            raise
        except self.parser_errors as error:
            raise damaged(self.name, error) from error
        if item is None:
            return None
        image = self._normalise(item[0])
        self.size = self._normalise.size
        return image, *item[1:]


class Stamp(NamedTuple):
    """What a recording remembers of how a frame was taken.

    seq, reference, epoch : as in `Frame`. paced : False for a frame that is shown ahead of its time, because
    those after it are compared with it.
    """

    seq: int
    reference: bool
    epoch: int
    paced: bool = True


class StampedReader(FrameReader):
    """A source whose frames went through `capture` once before; `_frames` also yields a `Stamp`.

    Capture then decides nothing by itself: seq, references and epochs are the recorded ones.
    """

    def read_stamped(self) -> tuple[BgrImage, float, Stamp] | None:
        """Like `read`, with the frame's stamp."""
        item = self._read()
        return None if item is None else (item[0], item[1], item[2])


class CaptureReader(FrameReader):
    """A source that OpenCV opens: a video, a camera, a stream.

    Parameters
    ----------
    name : what messages call it.
    failure : the error message if it cannot be opened.
    arguments : of `cv2.VideoCapture`.
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
        """What OpenCV knows of the source (`cv2.CAP_PROP_...`); 0 if it does not."""
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


class Normaliser:
    """Converts pictures to (H, W, 3) uint8 BGR, and checks that all have the size of the first.

    Gray, BGRA and 16-bit pictures are converted, with one note in the log for each kind of conversion.

    >>> bgr = Normaliser("example")(np.full((2, 2), 65535, np.uint16))
    >>> bgr.shape, bgr.dtype, int(bgr.max())
    ((2, 2, 3), dtype('uint8'), 255)

    Parameters
    ----------
    name : what notes and errors call the source, or the file of the next picture.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.size: tuple[int, int] | None = None
        self._noted: set[str] = set()

    def __call__(self, image: NDArray[Any]) -> BgrImage:
        """Convert one picture.

        Parameters
        ----------
        image : (H, W) or (H, W, C) with C in 1, 3, 4; uint8 or uint16.

        Raises
        ------
        SourceError
            If the pixels are of another kind, or the picture is not as large as the ones before it.
        """
        channels = image.shape[2] if image.ndim == 3 else 1
        if image.ndim not in (2, 3) or channels not in (1, 3, 4):
            raise SourceError(f"{self.name}: required 1, 3 or 4 channels, got shape {image.shape}")
        self._check_size(image.shape[1], image.shape[0])
        if image.dtype != np.uint8:
            image = self._from_16_bits(image)
        if channels == 3:
            return image if image.flags.c_contiguous else np.ascontiguousarray(image)
        if channels == 1:
            return np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), np.uint8)
        self._note("the fourth channel (alpha) is ignored")
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGRA2BGR), np.uint8)

    def _check_size(self, width: int, height: int) -> None:
        if self.size is None:
            check_pixel_count(self.name, width, height)
            self.size = (width, height)
        if self.size != (width, height):
            raise SourceError(
                f"{self.name}: this frame is {width} x {height} pixels, the ones before it are "
                f"{self.size[0]} x {self.size[1]}; a source must keep its size. "
                "Remove the odd frame, or run the two recordings one after the other"
            )

    def _from_16_bits(self, image: NDArray[Any]) -> NDArray[np.uint8]:
        # A file may have 16-bit pixels in the other byte order.
        if image.dtype.newbyteorder("=") != np.uint16:
            raise SourceError(f"{self.name}: required 8- or 16-bit unsigned pixels, got {image.dtype}")
        image = image.astype(np.uint16, copy=False)
        if self._note("16-bit values are scaled to 8 bit (divided by 257)") and image.size:
            peak = int(image.max())
            if 0 < peak < SPARSE_PEAK:
                bits = max(peak.bit_length(), FEWEST_BITS)
                log.warning(
                    "%s: no value above %d: a sensor with %d bits in a 16-bit file? It will be dark; "
                    "multiply the values by %d beforehand",
                    *(self.name, peak, bits, 1 << (16 - bits)),
                )
        return np.asarray(cv2.convertScaleAbs(image, alpha=255.0 / 65535.0), np.uint8)

    def _note(self, text: str) -> bool:
        if text in self._noted:
            return False
        self._noted.add(text)
        log.info("%s: %s", self.name, text)
        return True


def check_pixel_count(name: str, width: int, height: int) -> None:
    """Refuse pictures of more pixels than a camera has, before memory is allocated for them.

    name : the file or address. width, height : as it states them, px.

    Raises
    ------
    SourceError
        If they have more than `MOST_PIXELS`.
    """
    if width * height > MOST_PIXELS:
        raise SourceError(
            f"{name}: its pictures are {width} x {height}, more than {MOST_PIXELS} pixels; if that is right, "
            "set the environment variable OPENCV_IO_MAX_IMAGE_PIXELS"
        )


def damaged(name: str, error: Exception) -> SourceError:
    """The error for a file that cannot be read, or whose parser failed."""
    if isinstance(error, OSError) and error.strerror:
        return SourceError(f"{name}: cannot be read: {error.strerror}")
    message = str(error).strip().partition("\n")[0]
    return SourceError(f"{name}: is damaged or cut off ({message or type(error).__name__})")
