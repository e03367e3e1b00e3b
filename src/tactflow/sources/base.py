"""What every source has in common: the interface, and pixels as the pipeline expects them."""

from __future__ import annotations

import difflib
import logging
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, Protocol, runtime_checkable

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.engine.errors import SourceError
from tactflow.engine.frame import MOST_PIXELS
from tactflow.system.files import expanded, is_device

log = logging.getLogger("tactflow")

SPARSE_PEAK = 4096
"""A 16-bit frame without a value from here on comes from a sensor with 12 bits or fewer, grey levels."""
FEWEST_BITS = 10
"""Sensors whose pixels are stored in 16 bits have at least so many."""

BgrImage = NDArray[np.uint8]


class FrameReader(Protocol):
    """Frames, one after the other.

    live : the frames come when they want to (cameras, streams); a recording waits until it is read.
    fps : frames per second, or None where nothing is known.
    size : (width, height) of the frames, px, or None before the first one.
    total : number of frames, or None where it is unknown or endless.
    description : one line for people.
    """

    live: bool
    fps: float | None
    size: tuple[int, int] | None
    total: int | None
    description: str

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
        ...

    def close(self) -> None:
        """Let go of the file or device. May be called twice."""
        ...


class Stamp(NamedTuple):
    """What a recording remembers of how a frame was taken.

    seq, reference, epoch : as in `Frame`. paced : False for a frame that is shown ahead of its time, because
    those after it are compared with it.
    """

    seq: int
    reference: bool
    epoch: int
    paced: bool = True


@runtime_checkable
class StampedReader(Protocol):
    """A source whose frames went through `capture` once before.

    Capture then decides nothing by itself: seq, references and epochs are the recorded ones.
    """

    def read_stamped(self) -> tuple[BgrImage, float, Stamp] | None:
        """Like `FrameReader.read`, with the frame's stamp."""
        ...


def refuse_too_large(name: str, width: int, height: int) -> None:
    """Refuse pictures of more pixels than a camera has, before memory is taken for them.

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


def refuse_devices(path: Path) -> None:
    """Refuse a pipe or a device, also through a link, and a folder in which one is: reading it may never end.

    Raises
    ------
    SourceError
        If there is one.
    """
    places = [path]
    if path.is_dir():
        places = [Path(place, name) for place, _, names in os.walk(path) for name in names]
    for place in places:
        if is_device(str(place)):
            raise SourceError(f"{place}: is a pipe or a device, not a file")


def frame_size(capture: cv2.VideoCapture, name: str) -> tuple[int, int]:
    """(width, height) that a video or stream states, px; raises as `refuse_too_large`."""
    width = int(capture.get(cv2.CAP_PROP_FRAME_WIDTH))
    height = int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
    refuse_too_large(name, width, height)
    return width, height


class Normaliser:
    """Brings whatever a source delivers to (H, W, 3) uint8 BGR of one constant size.

    Gray, BGRA and 16-bit frames are converted, with one note in the log per kind of conversion.

    >>> bgr = Normaliser("example")(np.full((2, 2), 65535, np.uint16))
    >>> bgr.shape, bgr.dtype, int(bgr.max())
    ((2, 2, 3), dtype('uint8'), 255)

    Parameters
    ----------
    name : what the source is called in notes and errors.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.size: tuple[int, int] | None = None
        self._noted: set[str] = set()

    def __call__(self, image: NDArray[Any], name: str | None = None) -> BgrImage:
        """Convert one frame.

        Parameters
        ----------
        image : (H, W) or (H, W, C) with C in 1, 3, 4; uint8 or uint16.
        name : the file the frame comes from, where it has one of its own.

        Raises
        ------
        SourceError
            If the pixels are of another kind, or the frame is not as large as the ones before it.
        """
        where = name or self.name
        channels = image.shape[2] if image.ndim == 3 else 1
        if image.ndim not in (2, 3) or channels not in (1, 3, 4):
            raise SourceError(f"{where}: required 1, 3 or 4 channels, got an image of shape {image.shape}")
        height, width = image.shape[:2]
        if self.size is None:
            self.size = (width, height)
        elif self.size != (width, height):
            raise SourceError(
                f"{where}: this frame is {width} x {height} pixels, the ones before it are "
                f"{self.size[0]} x {self.size[1]}; a source must keep its size. "
                "Remove the odd frame, or run the two recordings one after the other"
            )
        # A file may have 16-bit pixels in another machine's order of bytes.
        if image.dtype.newbyteorder("=") == np.uint16:
            image = image.astype(np.uint16, copy=False)
            if self._note("16 bit", "16-bit values are scaled to 8 bit (divided by 257)") and image.size:
                peak = int(image.max())
                if 0 < peak < SPARSE_PEAK:
                    log.warning(
                        "%s: no value above %d: a sensor with %d bits in a 16-bit file? It will be dark; "
                        "multiply the values by %d beforehand",
                        where,
                        peak,
                        max(peak.bit_length(), FEWEST_BITS),
                        1 << (16 - max(peak.bit_length(), FEWEST_BITS)),
                    )
            image = cv2.convertScaleAbs(image, alpha=255.0 / 65535.0)
        elif image.dtype != np.uint8:
            raise SourceError(f"{where}: required 8- or 16-bit unsigned pixels, got {image.dtype}")
        if channels == 3:
            return image if image.flags.c_contiguous else np.ascontiguousarray(image)
        if channels == 1:
            self._note("gray", "gray frames are given three equal channels")
            return np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), np.uint8)
        self._note("alpha", "the fourth channel (alpha) is ignored")
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGRA2BGR), np.uint8)

    def _note(self, kind: str, text: str) -> bool:
        if kind in self._noted:
            return False
        self._noted.add(kind)
        log.info("%s: %s", self.name, text)
        return True


@contextmanager
def quiet_opencv() -> Iterator[None]:
    """Keep OpenCV's and FFmpeg's own messages off standard error: ours say the same more clearly."""
    # FFmpeg reads this once, when OpenCV opens the first file with it.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    _silence.begin()
    try:
        yield
    finally:
        _silence.end()


SILENT = 0
"""OpenCV's log level at which it says nothing."""


def _set_log_level(level: int) -> int:
    """Set OpenCV's log level; returns the one before. OpenCV 5 keeps the function elsewhere than 4."""
    change = getattr(cv2, "setLogLevel", None) or cv2.utils.logging.setLogLevel
    return int(change(level))


class _Silence:
    """OpenCV's one log level, silent while any thread wants it silent."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._wanted = 0
        self._level = 0

    def begin(self) -> None:
        with self._lock:
            if self._wanted == 0:
                self._level = _set_log_level(SILENT)
            self._wanted += 1

    def end(self) -> None:
        with self._lock:
            self._wanted -= 1
            if self._wanted == 0:
                _set_log_level(self._level)


_silence = _Silence()


def find_path(spec: str, directory: Path | None) -> Path:
    """Where a path of a command line or a pipeline file points to.

    Parameters
    ----------
    spec : absolute, or relative to the current directory or else to `directory`; `~` is expanded.
    directory : the pipeline file's folder, or None.

    Raises
    ------
    SourceError
        If nothing is there; names files whose names are close. If it is a pipe or a device: to open one may
        wait for ever, and no signal ends that.
    """
    path = expanded(spec)
    candidates = [path]
    if directory is not None and not path.is_absolute():
        candidates.append(directory / path)
    for candidate in candidates:
        if candidate.exists():
            if is_device(str(candidate)):
                raise SourceError(f"{spec}: is a pipe or a device, not a file")
            return candidate
    raise SourceError(f"{spec}: no such file or folder{_near(candidates)}")


def _near(candidates: list[Path]) -> str:
    for path in candidates:
        folder, wanted = path.parent, path.name
        # Climb to the first folder that exists, so that a typo in the middle of a path is found too.
        while not folder.is_dir() and folder.parent != folder:
            folder, wanted = folder.parent, folder.name
        if not folder.is_dir():
            continue
        try:
            names = sorted(entry.name for entry in folder.iterdir())
        except OSError:
            continue
        close = difflib.get_close_matches(wanted, names, n=3, cutoff=0.6)
        if close:
            return "; did you mean " + " or ".join(str(folder / name) for name in close) + "?"
    return f" (looked in {', '.join(dict.fromkeys(str(path.parent.absolute()) for path in candidates))})"
