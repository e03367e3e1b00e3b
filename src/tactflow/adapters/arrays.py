"""Frames in arrays of HDF5 and Zarr files."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactflow.engine.errors import SourceError
from tactflow.sources.base import FrameReader, check_array, damaged, require
from tactflow.sources.files import DEFAULT_FPS, decode_image
from tactflow.sources.paths import find_path, listed, refuse_devices, split_query

SETTINGS = {
    "dataset": "name of the frames",
    "times": "name of their times (numbers with a point are s, whole ones ns)",
    "order": "rgb (bgr if not given)",
}
BLOCK = 64 << 20
"""Frames are read chunk by chunk, but not more than so many bytes together. Chosen by hand."""
LARGEST_CHUNK = 1 << 30
"""Bytes of an uncompressed chunk at most, so that a damaged file does not take all memory. Chosen by hand."""

Arrays = dict[str, Any]
"""Path inside a file, such as `/frames`, -> array of h5py or zarr."""


class ArrayDataset(FrameReader):
    """Frames of one array of an HDF5 file or a Zarr folder.

    spec : `file.h5?dataset=/frames`; `times=/t` names their times, else frame i is taken at i / fps;
    `order=rgb` if the colors are in that order. directory, fps : as for `open_source`. Raises SourceError if
    there is no such file or array (it lists those that are there), it holds no frames, or a package is
    missing.
    """

    # HDF5 and the codecs of both formats raise all kinds of errors.
    parser_errors = (Exception,)

    def __init__(self, spec: str, directory: Path | None = None, fps: float | None = None) -> None:
        name, settings = split_query(spec, directory, SETTINGS)
        if settings.get("order", "bgr") not in ("bgr", "rgb"):
            raise SourceError(f"{spec}: order={settings['order']}: required bgr or rgb")
        path = find_path(name, directory)
        super().__init__(f"{path}, {settings.get('dataset', '')}")
        self._swapped = settings.get("order") == "rgb"
        arrays, self._close = _open(path)
        try:
            self._array = _choose(spec, settings.get("dataset"), arrays, "dataset")
            _check(self._array, self.name)
            self.total = int(self._array.shape[0])
            self.fps = fps or DEFAULT_FPS
            self._times: NDArray[np.float64] | None = None
            if "times" in settings:
                self.fps = None
                self._times = self._seconds(_choose(spec, settings["times"], arrays, "times"))
            self._read_first()
        except Exception as error:
            self.close()
            raise error if isinstance(error, SourceError) else damaged(self.name, error) from error
        self.description = f"{spec}, {self.total} frames"

    def close(self) -> None:
        """Close the file."""
        super().close()
        self._close()

    def _frames(self) -> Iterator[tuple[NDArray[Any], float]]:
        for index, frame in enumerate(_read_chunks(self._array)):
            if frame.ndim == 1:
                frame = decode_image(frame.tobytes(), f"{self.name}, frame {index}")
            if self._swapped and frame.ndim == 3 and frame.shape[2] > 1:
                frame = frame[..., [2, 1, 0, 3][: frame.shape[2]]]
            t = index / (self.fps or DEFAULT_FPS) if self._times is None else float(self._times[index])
            yield frame, t

    def _seconds(self, array: Any) -> NDArray[np.float64]:
        """Times from 0 at the first frame, s."""
        if array.shape != (self.total,) or array.dtype.kind not in "fiu":
            raise SourceError(
                f"{self.name}: times are {array.dtype} of shape {array.shape}; required {self.total} numbers"
            )
        times = np.asarray(array[:])
        # Whole numbers are subtracted before they are rounded: Unix time in ns has 19 digits.
        seconds: NDArray[np.float64] = (times - times[:1]) / (1e9 if array.dtype.kind in "iu" else 1.0)
        if not np.isfinite(seconds).all():
            raise SourceError(f"{self.name}: required finite times")
        return seconds


def _open(path: Path) -> tuple[Arrays, Callable[[], None]]:
    """The arrays of a file, and what closes it."""
    is_zarr = path.suffix.lower() == ".zarr"
    extra, package = ("zarr", "zarr") if is_zarr else ("hdf5", "h5py")
    require(path, "Zarr files" if is_zarr else "HDF5 files", extra, package)
    refuse_devices(path)
    try:
        return _open_zarr(path) if is_zarr else _open_hdf5(path)
    except Exception as error:
        raise damaged(str(path), error) from error


def _open_hdf5(path: Path) -> tuple[Arrays, Callable[[], None]]:
    import h5py  # type: ignore[import-untyped]

    file, arrays = h5py.File(path, "r"), Arrays()

    def visit(name: str, item: Any) -> None:
        # Not those whose pixels lie in other files, which may be any file of this machine.
        if isinstance(item, h5py.Dataset) and not item.external and not item.is_virtual:
            arrays[f"/{name}"] = item

    file.visititems(visit)
    return arrays, file.close


def _open_zarr(path: Path) -> tuple[Arrays, Callable[[], None]]:
    import zarr

    def is_pickled(array: Any) -> bool:
        """Whether reading an array may execute code in it: only new versions of numcodecs refuse to."""
        codecs = (*(array.filters or ()), *(array.compressors or ()))
        return any(getattr(codec, "codec_id", None) == "pickle" for codec in codecs)

    root = zarr.open(str(path), mode="r")
    members = [("", root)] if isinstance(root, zarr.Array) else root.members(max_depth=None)
    arrays = {f"/{n}": item for n, item in members if isinstance(item, zarr.Array) and not is_pickled(item)}
    return arrays, lambda: None


def _choose(spec: str, name: str | None, arrays: Arrays, setting: str) -> Any:
    if name is not None and f"/{name.strip('/')}" in arrays:
        return arrays[f"/{name.strip('/')}"]
    found = [
        f"{key} ({array.dtype} {' x '.join(map(str, array.shape))})" for key, array in sorted(arrays.items())
    ]
    problem = f"add ?{setting}=" if name is None else f"there is no {name}; required"
    raise SourceError(f"{spec}: {problem} one of: {listed(found)}")


def _check(array: Any, name: str) -> None:
    """Raise SourceError if an array holds no frames, or too large ones."""
    shape, dtype = array.shape, array.dtype
    are_files = (array.ndim == 1 and dtype.kind == "O") or (array.ndim == 2 and dtype == np.uint8)
    if 0 in shape or not are_files:
        check_array(array, name)
    chunk = math.prod(array.chunks or (1,)) * dtype.itemsize
    if chunk > LARGEST_CHUNK:
        raise SourceError(f"{name}: has chunks of {chunk} bytes; required at most {LARGEST_CHUNK}")


def _read_chunks(array: Any) -> Iterator[NDArray[Any]]:
    """One frame after the other; the file is read by whole chunks, as they are compressed."""
    frame_bytes = max(math.prod(array.shape[1:]) * array.dtype.itemsize, 1)
    together = max(1, min(array.chunks[0] if array.chunks else 1, BLOCK // frame_bytes))
    for begin in range(0, array.shape[0], together):
        for frame in array[begin : begin + together]:
            yield np.frombuffer(frame, np.uint8) if isinstance(frame, bytes) else np.asarray(frame)
