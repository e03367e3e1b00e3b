"""Recordings: image folders and globs, .npy arrays, video files."""

from __future__ import annotations

import glob
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.engine.errors import SourceError
from tactflow.engine.frame import MOST_PIXELS
from tactflow.sources.base import (
    BgrImage,
    Normaliser,
    find_path,
    frame_size,
    log,
    quiet_opencv,
    refuse_too_large,
)
from tactflow.system.files import expanded

IMAGE_SUFFIXES = frozenset(
    [".bmp", ".jp2", ".jpeg", ".jpg", ".pbm", ".pgm", ".png", ".pnm", ".ppm", ".tif", ".tiff", ".webp"]
)
"""Kinds of files that are taken for images."""
DEFAULT_FPS = 30.0
"""Rate of images, arrays and videos that do not know their own, frames per second. Chosen by hand."""
LARGEST_FPS = 1e4
"""A video file that claims a higher rate, frames per second, does not know its own. Chosen by hand."""

ARCHIVE = r"got b'PK\x03\x04"
"""What numpy says about a .npz file, which begins as every ZIP file does."""

PLAYLISTS = (b"#EXTM3U", b"ffconcat")
"""How lists of other files begin that FFmpeg would open in place of a video."""
PNG = b"\x89PNG\r\n\x1a\n"
"""How a PNG file begins."""
CHUNK_FRAME = 12
"""Bytes of a PNG chunk around its data: the length, the kind, the checksum."""


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Sorting key for which cal-2 comes before cal-10, and upper case does not matter.

    >>> sorted(["cal-10.png", "cal-2.png", "CAL-1.png"], key=natural_key)
    ['CAL-1.png', 'cal-2.png', 'cal-10.png']
    """
    return [
        (0, int(part), part) if part.isdecimal() else (1, 0, part.casefold())
        for part in re.split(r"(\d+)", name)
        if part
    ]


def read_image(path: Path) -> NDArray[Any]:
    """Decode an image file as it is stored, without changing depth or channels.

    Returns
    -------
    image : (H, W) or (H, W, C), any depth.

    Raises
    ------
    SourceError
        If the file cannot be read, is not an image, or is cut off. OpenCV fills the missing part of a
        truncated JPEG with gray and says nothing to the caller, so its end is looked for here.
    """
    try:
        if not path.is_file() and path.exists():
            raise SourceError(f"{path}: required a file, not a folder or a device")
        data = path.read_bytes()
    except OSError as error:
        raise SourceError(f"{path}: cannot be read: {error.strerror or error}") from error
    return decode_image(data, str(path))


def decode_image(data: bytes, name: str) -> NDArray[Any]:
    """Decode the bytes of an image file; `name` is what messages call it. As `read_image`."""
    if not data:
        raise SourceError(f"{name}: the image is empty")
    if _cut_off(data):
        raise SourceError(f"{name}: the image is cut off ({len(data)} bytes); copy it again or remove it")
    image: NDArray[Any] | None
    try:
        with quiet_opencv():
            image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        if "MAX_IMAGE" in str(error):
            raise SourceError(
                f"{name}: has more than {MOST_PIXELS} pixels; if that is right, set the environment variable "
                "OPENCV_IO_MAX_IMAGE_PIXELS"
            ) from None
        image = None
    if image is None:
        raise SourceError(f"{name}: not an image that OpenCV can read, or a damaged one")
    return image


def load_image(spec: str, directory: Path | None = None) -> BgrImage:
    """Find and decode one image file: (H, W, 3) uint8 BGR. Raises as `find_path` and `read_image` do."""
    path = find_path(spec, directory)
    return Normaliser(str(path))(read_image(path))


def _cut_off(data: bytes) -> bool:
    if data.startswith(b"\xff\xd8\xff"):
        # Behind the last start-of-scan marker there must be an end-of-image marker. Neither can occur
        # inside compressed data, and an embedded thumbnail brings both.
        return data.rfind(b"\xff\xd9") < data.rfind(b"\xff\xda")
    return data.startswith(PNG) and not _has_whole_chunks(data)


def _has_whole_chunks(png: bytes) -> bool:
    """Whether all chunks of a PNG are as long as they say: OpenCV takes the memory before it reads them."""
    at = len(PNG)
    while at + CHUNK_FRAME <= len(png):
        at += CHUNK_FRAME + int.from_bytes(png[at : at + 4], "big")
        # The last one is empty: its kind stands eight bytes before its end.
        if at <= len(png) and png[at - 8 : at - 4] == b"IEND":
            return True
    return False


class ImageFiles:
    """A recording made of one image file per frame.

    Parameters
    ----------
    files : in the order they are played.
    description : one line for people.
    fps : frames per second; the time of frame i is i / fps.

    Attributes
    ----------
    first : name of the first file, without its folder.
    """

    live = False

    def __init__(self, files: Sequence[Path], description: str, fps: float | None = None) -> None:
        self.fps: float | None = fps or DEFAULT_FPS
        self.total: int | None = len(files)
        self._rate = fps or DEFAULT_FPS
        self._files = files
        self._index = 0
        self._normalise = Normaliser(description)
        self._first: BgrImage | None = self._load(0)
        self.size = self._normalise.size
        self.description = f"{description}, {len(files)} images"
        self.first = files[0].name
        _warn_of_pages(files[0])

    def _load(self, index: int) -> BgrImage:
        path = self._files[index]
        return self._normalise(read_image(path), str(path))

    def read(self) -> tuple[BgrImage, float] | None:
        """The next image and its time; see `FrameReader.read`."""
        index = self._index
        if index >= len(self._files):
            return None
        self._index += 1
        if self._first is not None:
            image, self._first = self._first, None
        else:
            image = self._load(index)
        return image, index / self._rate

    def close(self) -> None:
        """Read no more."""
        self._index = len(self._files)
        self._first = None


def _warn_of_pages(path: Path) -> None:
    """Say that only the first picture of a TIFF is read: some programs write a whole recording into one."""
    if path.suffix.lower() not in (".tif", ".tiff"):
        return
    with quiet_opencv():
        pages = cv2.imcount(str(path))
    if pages > 1:
        log.warning(
            "%s: holds %d pictures, of which only the first is read; save each as a file of its own",
            path,
            pages,
        )


def open_folder(folder: Path, fps: float | None = None) -> ImageFiles:
    """All images of a folder, in natural order; hidden files and other kinds of files are left out."""
    try:
        entries = sorted(folder.iterdir(), key=lambda entry: natural_key(entry.name))
    except OSError as error:
        raise SourceError(f"{folder}: cannot be read: {error.strerror or error}") from error
    files = [
        entry
        for entry in entries
        if entry.suffix.lower() in IMAGE_SUFFIXES and not entry.name.startswith(".") and entry.is_file()
    ]
    if not files:
        raise SourceError(f"{folder}: no images in this folder{_what_is_there(entries)}")
    return ImageFiles(files, str(folder), fps)


def _what_is_there(entries: Sequence[Path]) -> str:
    if not entries:
        return "; it is empty"
    names = ", ".join(entry.name + ("/" if entry.is_dir() else "") for entry in entries[:5])
    more = f" and {len(entries) - 5} more" if len(entries) > 5 else ""
    hint = "; name one of its folders" if any(entry.is_dir() for entry in entries) else ""
    return f"; it holds {names}{more}{hint}"


def open_glob(pattern: str, directory: Path | None = None, fps: float | None = None) -> ImageFiles:
    """All files that match a pattern (`*`, `?`, `[...]`, `**`), in natural order.

    The pattern is relative to the current directory, or to `directory` if nothing matches there.
    """
    wanted = expanded(pattern)
    for base in (Path(), directory):
        files = [] if base is None else [path for path in matching(base / wanted) if path.is_file()]
        if files:
            return ImageFiles(files, pattern, fps)
    raise SourceError(f"{pattern}: no file matches this pattern; on a command line, quote it")


def matching(pattern: Path) -> list[Path]:
    """What matches a pattern, in natural order, but what is hidden.

    `**` follows no links: they may lead in circles.
    """
    parts = pattern.parts
    fixed = next((index for index, part in enumerate(parts) if glob.has_magic(part)), len(parts))
    folder = Path(*parts[:fixed])
    found = [
        path
        for path in folder.glob(str(Path(*parts[fixed:])))
        if not any(part.startswith(".") for part in path.relative_to(folder).parts)
    ]
    return sorted(found, key=lambda path: natural_key(str(path)))


class ArrayFile:
    """A .npy file: uint8, N x H x W x 3 BGR or N x H x W gray; read frame by frame, never loaded whole.

    Frames are not mapped into memory: where another program cuts the file during the run, that would end the
    process at the next look at one. To read one costs one copy of it and half of another.

    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder, "press.npy")
    ...     np.save(path, np.zeros((5, 48, 64), np.uint8))
    ...     reader = ArrayFile(path, fps=10)
    ...     first, second = reader.read(), reader.read()
    >>> second[0].shape, second[1]
    ((48, 64, 3), 0.1)

    Parameters
    ----------
    path : the file.
    fps : frames per second; the time of frame i is i / fps.
    """

    live = False

    def __init__(self, path: Path, fps: float | None = None) -> None:
        frames = _map_array(path)
        self.fps: float | None = fps or DEFAULT_FPS
        self._rate = fps or DEFAULT_FPS
        self._index = 0
        count, height, width = frames.shape[:3]
        refuse_too_large(str(path), width, height)
        found = (_read_frames if frames.flags.c_contiguous else _gathered_frames)(path, frames)
        as_wanted = frames.dtype == np.uint8 and frames.shape[3:] == (3,)
        self._frames: Iterator[BgrImage] = found if as_wanted else map(Normaliser(str(path)), found)
        self.total: int | None = count
        self.size: tuple[int, int] | None = (width, height)
        self.description = f"{path}, {count} frames"

    def read(self) -> tuple[BgrImage, float] | None:
        """The next frame and its time; see `FrameReader.read`."""
        image = next(self._frames, None)
        if image is None:
            return None
        index = self._index
        self._index += 1
        return image, index / self._rate

    def close(self) -> None:
        """Read no more."""
        self._frames = iter(())


def _read_frames(path: Path, array: np.memmap[Any, Any]) -> Iterator[NDArray[Any]]:
    """One frame after the other of an array in a file.

    Raises SourceError if the file has become shorter, or cannot be read.
    """
    with path.open("rb") as file:
        file.seek(array.offset)
        for index in range(len(array)):
            frame = np.empty(array.shape[1:], array.dtype)
            try:
                whole = file.readinto(frame.data) == frame.nbytes
            except OSError as error:
                raise SourceError(f"{path}: cannot be read: {error.strerror or error}") from error
            if not whole:
                raise SourceError(f"{path}: was cut off during the run, within frame {index}")
            yield frame


def _gathered_frames(path: Path, array: np.memmap[Any, Any]) -> Iterator[NDArray[Any]]:
    """The same for Fortran order, in which the bytes of a frame lie all over the file.

    Such a file is mapped all the same: cut while a frame is being copied, it still ends the process.
    """
    whole = array.offset + array.nbytes
    for index, frame in enumerate(np.asarray(array)):
        if path.stat().st_size < whole:
            raise SourceError(f"{path}: was cut off during the run, within frame {index}")
        yield np.ascontiguousarray(frame)


def _map_array(path: Path) -> np.memmap[Any, Any]:
    wanted = "required a uint8 array of N x H x W x 3 (BGR) or N x H x W (gray)"
    try:
        # Not np.load, which would also take archives and pickles.
        array = np.lib.format.open_memmap(path, mode="r")
    except OSError as error:
        raise SourceError(f"{path}: cannot be read: {error.strerror or error}") from error
    except Exception as error:
        # The header is read as Python source is: what is wrong with it raises whatever a parser can.
        if ARCHIVE in str(error):
            raise SourceError(f"{path}: a .npz archive; save its array with np.save; {wanted}") from error
        if "mmap length" in str(error) or "file size" in str(error):
            raise SourceError(
                f"{path}: the file is cut off: it holds fewer bytes than its header promises; copy it again"
            ) from error
        raise SourceError(f"{path}: not a .npy file, or a damaged one; {wanted}") from error
    got = f"got {array.dtype} of shape {' x '.join(map(str, array.shape)) or '()'}"
    if array.dtype.newbyteorder("=") not in (np.uint8, np.uint16):
        raise SourceError(f"{path}: {wanted}, {got}")
    if array.ndim == 3 and array.shape[2] in (3, 4):
        raise SourceError(f"{path}: {wanted}, {got}; a single image? Save it as array[None]")
    if array.ndim not in (3, 4) or (array.ndim == 4 and array.shape[3] not in (1, 3, 4)) or 0 in array.shape:
        raise SourceError(f"{path}: {wanted}, {got}")
    return array


def refuse_playlist(path: Path) -> None:
    """Refuse an empty file, and a list of other files: what is handed on as a video shall not open others."""
    try:
        with path.open("rb") as file:
            begins = file.read(64)
    except OSError as error:
        raise SourceError(f"{path}: cannot be read: {error.strerror or error}") from error
    if not begins:
        raise SourceError(f"{path}: the file is empty")
    if begins.lstrip(b"\xef\xbb\xbf \r\n").startswith(PLAYLISTS):
        raise SourceError(f"{path}: a list of other files, not a video; name one of them")


class VideoFile:
    """A video file, read by OpenCV's FFmpeg.

    A frame's time is the file's own time stamp, from 0 at the first frame; where stamps are missing or do not
    grow, one frame's duration is added instead.

    Parameters
    ----------
    path : the file.
    fps : frames per second if the file does not say.
    """

    live = False

    def __init__(self, path: Path, fps: float | None = None) -> None:
        refuse_playlist(path)
        with quiet_opencv():
            self._capture: cv2.VideoCapture | None = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
        if not self._capture.isOpened():
            raise SourceError(
                f"{path}: neither a video that OpenCV can open, nor an image, nor a .npy array; "
                "an .mp4 or .avi that was not closed properly cannot be opened either"
            )
        self.size: tuple[int, int] | None = frame_size(self._capture, str(path))
        said = self._capture.get(cv2.CAP_PROP_FPS)
        self._rate = said if 0 < said < LARGEST_FPS else fps or DEFAULT_FPS
        self.fps: float | None = self._rate
        count = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))
        self.total: int | None = count if count > 0 else None
        self._path = path
        self._normalise = Normaliser(str(path))
        self._index = 0
        self._first_stamp = 0.0
        self._t = 0.0
        self.description = f"{path}, {self.size[0]} x {self.size[1]} at {self._rate:g} fps"

    def read(self) -> tuple[BgrImage, float] | None:
        """The next frame and its time; see `FrameReader.read`."""
        if self._capture is None:
            return None
        with quiet_opencv():
            there, image = self._capture.read()
        if not there:
            self._end()
            return None
        stamp = self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1000.0
        if self._index == 0:
            self._first_stamp = stamp
        else:
            since_first = stamp - self._first_stamp
            self._t = since_first if since_first > self._t else self._t + 1.0 / self._rate
        self._index += 1
        return self._normalise(image), self._t

    def _end(self) -> None:
        if self._index == 0:
            raise SourceError(f"{self._path}: the video holds no frame that can be decoded; is it damaged?")
        if self.total is not None and self._index < self.total:
            log.warning(
                "%s: ended after %d of %d frames; the file may be damaged",
                self._path,
                self._index,
                self.total,
            )
        self.close()

    def close(self) -> None:
        """Close the file."""
        if self._capture is not None:
            self._capture.release()
            self._capture = None


def open_recording(
    spec: str, directory: Path | None = None, fps: float | None = None
) -> ImageFiles | ArrayFile | VideoFile:
    """Open a file, folder or glob by what it is.

    Raises
    ------
    SourceError
        If it is not there, or not a recording.
    """
    if glob.has_magic(spec) and not expanded(spec).exists():
        return open_glob(spec, directory, fps)
    path = find_path(spec, directory)
    if path.is_dir():
        return open_folder(path, fps)
    suffix = path.suffix.lower()
    if suffix in (".npy", ".npz"):
        return ArrayFile(path, fps)
    if suffix in IMAGE_SUFFIXES:
        return ImageFiles([path], str(path), fps)
    return VideoFile(path, fps)
