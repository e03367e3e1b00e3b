"""Frames in arrays of HDF5 and Zarr files."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactflow.engine.errors import SourceError
from tactflow.sources.base import BgrImage, Normaliser, find_path, refuse_devices, refuse_too_large
from tactflow.sources.files import DEFAULT_FPS, decode_image
from tactflow.sources.query import split_query
from tactflow.sources.stores import damaged
from tactflow.system.extras import missing

ZARR = ".zarr"
SETTINGS = {
    "dataset": "name of the frames",
    "times": "name of their times (numbers with a point are s, whole ones ns)",
    "order": "rgb (bgr if not given)",
}
MOST_NAMED = 30
"""Arrays that a message lists at most. Chosen by hand."""
BLOCK = 64 << 20
"""Frames are read in the pieces in which the file keeps them, of so many bytes at most. Chosen by hand."""
MOST_UNPACKED = 1 << 30
"""Bytes that a piece of the file may take unpacked: as much as a chunk of a recording may."""
WANTED = "required uint8 or uint16 of N x H x W x 3 (BGR) or N x H x W (gray), or N JPEG or PNG files"
"""What an array of frames is, for messages."""


class ArrayDataset:
    """Frames of one array of an HDF5 file or a Zarr folder.

    Parameters
    ----------
    spec : `file.h5?dataset=/frames`; `times=/t` gives their times, else frame i is taken at i / fps;
        `order=rgb` where colours are in that order.
    directory : where a relative path is looked for if it is not in the current directory.
    fps : frames per second where there are no times; 30 if not given.

    Raises
    ------
    SourceError
        If there is no such file or array (it lists those that are there), the array holds no frames, or a
        package is missing.
    """

    live = False

    def __init__(self, spec: str, directory: Path | None = None, fps: float | None = None) -> None:
        name, settings = split_query(spec, directory, SETTINGS)
        if settings.get("order", "bgr") not in ("bgr", "rgb"):
            raise SourceError(f"{spec}: order={settings['order']}: required bgr or rgb")
        path = find_path(name, directory)
        self._name = f"{path}, {settings.get('dataset', '')}"
        arrays, self._release = _opened(path)
        try:
            frames = _chosen(spec, settings.get("dataset"), arrays, "dataset")
            self.total: int | None = _checked(frames, self._name)
            self._times: NDArray[Any] | None = None
            if "times" in settings:
                self._times = self._read_times(_chosen(spec, settings["times"], arrays, "times"))
            self._swaps = settings.get("order") == "rgb"
            self._rate = fps or DEFAULT_FPS
            self.fps: float | None = None if self._times is not None else self._rate
            self._normalise = Normaliser(self._name)
            self._frames = enumerate(_pieces(frames))
            self._first = self._next()
        except BaseException:
            self._release()
            raise
        self.size = self._normalise.size
        self.description = f"{spec}, {self.total} frames"

    def read(self) -> tuple[BgrImage, float] | None:
        """The next frame and its time; see `FrameReader.read`."""
        item, self._first = self._first or self._next(), None
        return item

    def close(self) -> None:
        """Let go of the file."""
        self._frames = enumerate(iter(()))
        self._release()

    def _next(self) -> tuple[BgrImage, float] | None:
        try:
            found = next(self._frames, None)
        except Exception as error:
            # HDF5 and the codecs of both kinds raise whatever they like.
            raise damaged(self._name, error) from error
        if found is None:
            return None
        index, frame = found
        if frame.ndim == 1:
            frame = decode_image(frame.tobytes(), f"{self._name}, frame {index}")
        image = self._normalise(frame)
        t = index / self._rate if self._times is None else float(self._times[index])
        return np.ascontiguousarray(image[:, :, ::-1]) if self._swaps else image, t

    def _read_times(self, array: Any) -> NDArray[np.float64]:
        """From 0 at the first frame, s; where they go back, they stay."""
        if array.shape != (self.total,) or array.dtype.kind not in "fiu":
            raise SourceError(
                f"{self._name}: times are {array.dtype} of shape {array.shape}; required {self.total} numbers"
            )
        times = np.asarray(array[:])
        # Whole numbers are subtracted before they are rounded: Unix time in ns has 19 digits.
        seconds = (times - times[:1]) / (1e9 if array.dtype.kind in "iu" else 1.0)
        if not np.isfinite(seconds).all():
            raise SourceError(f"{self._name}: required finite times")
        return np.maximum.accumulate(seconds)


def _opened(path: Path) -> tuple[dict[str, Any], Callable[[], object]]:
    """The arrays of a file by name, and what closes it."""
    kind = "zarr" if path.suffix.lower() == ZARR else "h5py"
    problem = missing("Zarr files" if kind == "zarr" else "HDF5 files", kind.replace("h5py", "hdf5"), [kind])
    if problem is not None:
        raise SourceError(f"{path}: {problem}")
    refuse_devices(path)
    try:
        return _open_zarr(path) if kind == "zarr" else _open_hdf5(path)
    except Exception as error:
        raise damaged(str(path), error) from error


def _open_hdf5(path: Path) -> tuple[dict[str, Any], Callable[[], object]]:
    import h5py  # type: ignore[import-untyped]

    file = h5py.File(path, "r")
    arrays: dict[str, Any] = {}

    def look(name: str, one: Any) -> None:
        # Not those whose pixels lie in other files, which may be any file of this machine.
        if isinstance(one, h5py.Dataset) and not one.external and not one.is_virtual:
            arrays[f"/{name}"] = one

    file.visititems(look)
    return arrays, file.close


def _open_zarr(path: Path) -> tuple[dict[str, Any], Callable[[], object]]:
    import zarr

    root = zarr.open(str(path), mode="r")
    members = [("", root)] if isinstance(root, zarr.Array) else root.members(max_depth=None)
    arrays = {f"/{name}": one for name, one in members if isinstance(one, zarr.Array)}
    return {name: array for name, array in arrays.items() if not _is_pickled(array)}, lambda: None


def _is_pickled(array: Any) -> bool:
    """Whether reading a Zarr array may run what is in it: only new versions of numcodecs refuse to."""
    codecs = (*(array.filters or ()), *(array.compressors or ()))
    return any(getattr(codec, "codec_id", None) == "pickle" for codec in codecs)


def _chosen(spec: str, name: str | None, arrays: Mapping[str, Any], setting: str) -> Any:
    if name is not None and f"/{name.strip('/')}" in arrays:
        return arrays[f"/{name.strip('/')}"]
    there = [
        f"{one} ({array.dtype} {' x '.join(map(str, array.shape))})" for one, array in sorted(arrays.items())
    ]
    more = f" and {len(there) - MOST_NAMED} more" if len(there) > MOST_NAMED else ""
    problem = f"add ?{setting}=" if name is None else f"there is no {name}; required"
    raise SourceError(
        f"{spec}: {problem} one of: {', '.join(there[:MOST_NAMED]) or 'nothing: it is empty'}{more}"
    )


def _checked(array: Any, name: str) -> int:
    """The number of frames of an array, if it holds frames of a size that can be."""
    shape, dtype = array.shape, array.dtype
    got = f"got {dtype} of shape {' x '.join(map(str, shape)) or '()'}"
    pixels = dtype.newbyteorder("=") in (np.uint8, np.uint16) and (
        len(shape) == 3 or (len(shape) == 4 and shape[3] in (1, 3, 4))
    )
    files = (len(shape) == 1 and dtype.kind == "O") or (len(shape) == 2 and dtype == np.uint8)
    if not (pixels or files) or 0 in shape:
        raise SourceError(f"{name}: {WANTED}; {got}")
    if pixels:
        refuse_too_large(name, shape[2], shape[1])
    piece = math.prod(array.chunks or (1,)) * dtype.itemsize
    if piece > MOST_UNPACKED:
        raise SourceError(f"{name}: is kept in pieces of {piece} bytes; required at most {MOST_UNPACKED}")
    return int(shape[0])


def _pieces(array: Any) -> Iterator[NDArray[Any]]:
    """One frame after the other; the file is read by whole pieces, each of which is unpacked as a whole."""
    frame = max(math.prod(array.shape[1:]) * array.dtype.itemsize, 1)
    together = max(1, min(array.chunks[0] if array.chunks else 1, BLOCK // frame))
    for begin in range(0, array.shape[0], together):
        for one in array[begin : begin + together]:
            yield np.frombuffer(one, np.uint8) if isinstance(one, bytes) else np.asarray(one)
