"""Recordings: image folders and globs, .npy arrays; other files are opened as videos."""

from __future__ import annotations

import glob
import os
import re
import stat
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.engine.errors import SourceError
from tactflow.engine.frame import MAX_PIXELS
from tactflow.sources.base import DEFAULT_FPS, FrameReader, check_array, damaged, to_bgr
from tactflow.sources.paths import find_path, locate
from tactflow.sources.video import open_video
from tactflow.system.files import expanded
from tactflow.vision.arrays import ColorImage

IMAGE_SUFFIXES = frozenset(
    [".bmp", ".jp2", ".jpeg", ".jpg", ".pbm", ".pgm", ".png", ".pnm", ".ppm", ".tif", ".tiff", ".webp"]
)
"""Suffixes of images."""
VIDEO_SUFFIXES = frozenset([".avi", ".m4v", ".mkv", ".mov", ".mp4", ".mpeg", ".mpg", ".ogv", ".webm", ".wmv"])
"""Suffixes of videos; files with unknown suffixes are also read as videos."""

ZIP_MAGIC = r"got b'PK\x03\x04"
"""Part of NumPy's message for a .npz file, which is a ZIP file."""
PNG, PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND\xaeB`\x82"
"""First bytes of a PNG file, and its last chunk, whose checksum is always the same."""


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Sorting key for natural order (cal-2 before cal-10), ignoring case.

    >>> sorted(["cal-10.png", "cal-2.png", "CAL-1.png"], key=natural_key)
    ['CAL-1.png', 'cal-2.png', 'cal-10.png']
    """
    return [
        (0, int(part), part) if part.isdecimal() else (1, 0, part.casefold())
        for part in re.split(r"(\d+)", name)
        if part
    ]


def read_image(path: Path) -> NDArray[Any]:
    """Decode an image file without conversion: (H, W) or (H, W, C), any depth.

    Raises SourceError if the file cannot be read, is not an image, or is truncated.
    """
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            raise SourceError(f"{path}: required a file, not a folder or a device")
        return decode_image(path.read_bytes(), str(path))
    except OSError as error:
        raise damaged(str(path), error) from error


def decode_image(data: bytes, name: str) -> NDArray[Any]:
    """Decode the bytes of an image file, as `read_image`. name : for messages."""
    if not data:
        raise SourceError(f"{name}: the image is empty")
    if _is_cut_off(data):
        raise SourceError(f"{name}: the image is cut off ({len(data)} bytes); copy it again or remove it")
    image: NDArray[Any] | None = None
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        if "MAX_IMAGE" in str(error):
            raise SourceError(
                f"{name}: has more than {MAX_PIXELS} pixels; if that is right, set the environment variable "
                "OPENCV_IO_MAX_IMAGE_PIXELS"
            ) from None
    if image is None:
        raise SourceError(f"{name}: not an image that OpenCV can read, or a damaged one")
    return image


def load_image(spec: str, directory: Path | None = None) -> ColorImage:
    """Find and decode one image file: (H, W, 3) uint8 BGR. Raises as `find_path` and `read_image` do."""
    path = find_path(spec, directory)
    return to_bgr(read_image(path), str(path))


def _is_cut_off(data: bytes) -> bool:
    """Whether a JPEG or PNG is truncated; OpenCV would silently fill a JPEG with gray."""
    if data.startswith(b"\xff\xd8\xff"):
        # An end-of-image marker must follow the last start-of-scan marker. Neither can occur inside
        # compressed data, and an embedded thumbnail has both.
        return data.rfind(b"\xff\xd9") < data.rfind(b"\xff\xda")
    return data.startswith(PNG) and PNG_END not in data


class ImageFiles(FrameReader):
    """A recording of one image file per frame; frame i is taken at i / fps.

    Parameters
    ----------
    files : in order.
    name : folder or pattern, for messages.

    Attributes
    ----------
    first : name of the first file without its folder.
    """

    def __init__(self, files: Sequence[Path], name: str, fps: float | None = None) -> None:
        super().__init__(name)
        self.fps = fps or DEFAULT_FPS
        self.total = len(files)
        self.description = f"{name}, {len(files)} images"
        self.first = files[0].name
        self.files = files
        self._read_first()

    def _frames(self) -> Iterator[tuple[NDArray[Any], float]]:
        for index, path in enumerate(self.files):
            self._picture = str(path)
            yield read_image(path), index / (self.fps or DEFAULT_FPS)


def open_folder(folder: Path, fps: float | None = None) -> ImageFiles:
    """All images of a folder in natural order, without hidden files."""
    if files := images_of(folder):
        return ImageFiles(files, str(folder), fps)
    entries = _entries(folder)
    if not entries:
        raise SourceError(f"{folder}: no images in this folder; it is empty")
    names = ", ".join(entry.name + ("/" if entry.is_dir() else "") for entry in entries[:5])
    more = f" and {len(entries) - 5} more" if len(entries) > 5 else ""
    hint = "; name one of its folders" if any(entry.is_dir() for entry in entries) else ""
    raise SourceError(f"{folder}: no images in this folder; it holds {names}{more}{hint}")


def images_of(folder: Path) -> list[Path]:
    """The images of a folder, in the order in which `open_folder` gives them. Raises SourceError if it cannot
    be read."""
    return [entry for entry in _entries(folder) if is_image(entry) and entry.is_file()]


def _entries(folder: Path) -> list[Path]:
    try:
        return sorted(folder.iterdir(), key=lambda entry: natural_key(entry.name))
    except OSError as error:
        raise damaged(str(folder), error) from error


def is_image(path: Path) -> bool:
    """Whether a file has the name of an image and is not hidden."""
    return path.suffix.lower() in IMAGE_SUFFIXES and not path.name.startswith(".")


def open_glob(pattern: str, directory: Path | None = None, fps: float | None = None) -> ImageFiles:
    """All files that match a pattern (`*`, `?`, `[...]`, `**`), in natural order.

    The pattern is relative to the current directory, or, without matches there, to `directory`.
    """
    for base in (Path(), directory or Path()):
        files = [path for path in matching(base / expanded(pattern)) if path.is_file()]
        if files:
            return ImageFiles(files, pattern, fps)
    raise SourceError(f"{pattern}: no file matches this pattern; on a command line, quote it")


def matching(pattern: Path) -> list[Path]:
    """The files and folders that match a pattern, in natural order, without hidden ones.

    `**` does not follow links, which may be circular.
    """
    parts = pattern.parts
    fixed = next((index for index, part in enumerate(parts) if glob.has_magic(part)), len(parts))
    folder = Path(*parts[:fixed])
    visible = [
        path
        for path in folder.glob(str(Path(*parts[fixed:])))
        if not any(part.startswith(".") for part in path.relative_to(folder).parts)
    ]
    return sorted(visible, key=lambda path: natural_key(str(path)))


class ArrayFile(FrameReader):
    """A memory-mapped .npy file: uint8, N x H x W x 3 BGR or N x H x W gray.

    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder, "press.npy")
    ...     np.save(path, np.zeros((5, 48, 64), np.uint8))
    ...     reader = ArrayFile(path, fps=10)
    ...     first, second = reader.read(), reader.read()
    >>> second[0].shape, second[1]
    ((48, 64, 3), 0.1)

    Frame i is taken at i / fps.
    """

    def __init__(self, path: Path, fps: float | None = None) -> None:
        super().__init__(str(path))
        self._path = path
        self._array = _map_array(path)
        self.fps = fps or DEFAULT_FPS
        self.total, height, width = self._array.shape[:3]
        self.size = (width, height)
        self.description = f"{path}, {self.total} frames"

    def _frames(self) -> Iterator[tuple[NDArray[Any], float]]:
        end = self._array.offset + self._array.nbytes
        with self._path.open("rb") as file:
            for index, frame in enumerate(np.asarray(self._array)):
                # Reading the map beyond the end of the file would crash the process.
                if os.fstat(file.fileno()).st_size < end:
                    raise SourceError(f"{self._path}: was cut off during the run, within frame {index}")
                yield np.array(frame, order="C"), index / (self.fps or DEFAULT_FPS)


def _map_array(path: Path) -> np.memmap[Any, Any]:
    try:
        # np.load would also accept archives and pickles.
        array = np.lib.format.open_memmap(path, mode="r")
    except OSError as error:
        raise damaged(str(path), error) from error
    except Exception as error:
        # The header is parsed as Python source, so that any exception is possible.
        if ZIP_MAGIC in str(error):
            raise SourceError(f"{path}: a .npz archive; save its array with np.save") from error
        if "mmap length" in str(error) or "file size" in str(error):
            raise SourceError(
                f"{path}: the file is cut off: it holds fewer bytes than its header promises; copy it again"
            ) from error
        raise SourceError(f"{path}: not a .npy file, or a damaged one") from error
    check_array(array, str(path))
    return array


def open_file(spec: str, directory: Path | None = None, fps: float | None = None) -> FrameReader:
    """Open images, an array or a video: a file, a folder or a pattern. Raises SourceError."""
    if glob.has_magic(spec) and locate(spec, directory) is None:
        return open_glob(spec, directory, fps)
    path = find_path(spec, directory)
    if path.is_dir():
        return open_folder(path, fps)
    suffix = path.suffix.lower()
    if suffix in (".npy", ".npz"):
        return ArrayFile(path, fps)
    if suffix in IMAGE_SUFFIXES:
        return ImageFiles([path], str(path), fps)
    return open_video(path, fps)
