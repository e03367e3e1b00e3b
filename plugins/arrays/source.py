"""Frames in arrays of HDF5 and Zarr files."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactflow.engine.errors import SourceError
from tactflow.sources.base import FrameReader, check_array, damaged, require
from tactflow.sources.files import DEFAULT_FPS, decode_image
from tactflow.sources.paths import find_path, listed, split_query

SETTINGS = {
    "dataset": "name of the frames",
    "times": "name of their times (numbers with a point are s, whole ones ns)",
    "order": "rgb (bgr if not given)",
}
EXPORTED = {"dataset": "/frames", "times": "/t"}
"""Written by `tactflow export`, and read by default from a file that has both."""
BLOCK = 64 << 20
"""Maximum number of bytes read at a time. Chosen by hand."""


class ArrayDataset(FrameReader):
    """Frames of one array of an HDF5 file or a Zarr folder.

    spec : `file.h5?dataset=/frames`; `times=/t` names their times, else frame i is taken at i / fps;
    `order=rgb` if the colors are in that order. An export of tactflow needs none of these. directory, fps :
    as for `open_source`. Raises SourceError if there is no such file or array (it lists the valid
    ones), it holds no frames, or a package is missing.
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
        if not settings and set(EXPORTED.values()) <= arrays.keys():
            settings = EXPORTED
        try:
            self._array = _choose(spec, settings.get("dataset"), arrays, "dataset")
            _check(self._array, self.name)
            self.total = int(self._array.shape[0])
            if "times" in settings:
                self._times = self._seconds(_choose(spec, settings["times"], arrays, "times"))
            else:
                self.fps = fps or DEFAULT_FPS
                self._times = np.arange(self.total) / self.fps
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
        for index, (frame, t) in enumerate(
            zip(_read_chunks(self._array, len(self._times)), self._times, strict=True)
        ):
            if frame.ndim == 1:
                frame = decode_image(frame.tobytes(), f"{self.name}, frame {index}")
            if self._swapped and frame.ndim == 3:
                frame = frame[..., [2, 1, 0, 3][: frame.shape[2]]] if frame.shape[2] > 1 else frame
            yield frame, float(t)

    def _seconds(self, array: Any) -> NDArray[np.float64]:
        """Times from 0 at the first frame, s."""
        length = self._array.shape[0]
        if array.shape != (length,) or array.dtype.kind not in "fiu":
            raise SourceError(
                f"{self.name}: times are {array.dtype} of shape {array.shape}; required {length} numbers"
            )
        times = np.asarray(array[:])
        # Whole numbers are subtracted before they are rounded: Unix time in ns has 19 digits.
        seconds: NDArray[np.float64] = (times - times[:1]) / (1e9 if array.dtype.kind in "iu" else 1.0)
        if not np.isfinite(seconds).all():
            raise SourceError(f"{self.name}: required finite times")
        return seconds


def _hdf5_arrays(path: Path) -> tuple[dict[str, Any], Callable[[], object]]:
    """The arrays of an HDF5 file by name, and the function that closes it."""
    import h5py  # type: ignore[import-untyped]

    file = h5py.File(path, "r")
    arrays: dict[str, Any] = {}

    def visit(name: str, item: Any) -> None:
        # Skip those with pixels in other files, which may be any file of this machine.
        if isinstance(item, h5py.Dataset) and not item.external and not item.is_virtual:
            arrays[f"/{name}"] = item

    file.visititems(visit)
    return arrays, file.close


def _zarr_arrays(path: Path) -> tuple[dict[str, Any], Callable[[], object]]:
    """The arrays of a Zarr folder by name; nothing needs to be closed."""
    import zarr

    root = zarr.open(str(path), mode="r")
    members = [("", root)] if isinstance(root, zarr.Array) else root.members(max_depth=None)
    arrays = {f"/{name}": item for name, item in members if isinstance(item, zarr.Array)}
    return {name: array for name, array in arrays.items() if not _is_pickled(array)}, lambda: None


def _is_pickled(array: Any) -> bool:
    """Whether reading a Zarr array may execute code in it: only new versions of numcodecs refuse to."""
    codecs = (*(array.filters or ()), *(array.compressors or ()))
    return any(getattr(codec, "codec_id", None) == "pickle" for codec in codecs)


def _open(path: Path) -> tuple[dict[str, Any], Callable[[], object]]:
    is_zarr = path.suffix.lower() == ".zarr"
    if is_zarr:
        require(path, "Zarr files", "zarr", "zarr")
    else:
        require(path, "HDF5 files", "hdf5", "h5py")
    try:
        return _zarr_arrays(path) if is_zarr else _hdf5_arrays(path)
    except Exception as error:
        raise damaged(str(path), error) from error


def _choose(spec: str, name: str | None, arrays: Mapping[str, Any], setting: str) -> Any:
    array = None if name is None else arrays.get(f"/{name.strip('/')}")
    if array is not None:
        return array
    found = [
        f"{key} ({array.dtype} {' x '.join(map(str, array.shape))})" for key, array in sorted(arrays.items())
    ]
    problem = f"add ?{setting}=" if name is None else f"there is no {name}; required"
    raise SourceError(f"{spec}: {problem} one of: {listed(found)}")


def _check(array: Any, name: str) -> None:
    """Raise SourceError if an array holds no frames."""
    shape, dtype = array.shape, array.dtype
    are_files = (array.ndim == 1 and dtype.kind == "O") or (array.ndim == 2 and dtype == np.uint8)
    if 0 in shape or not are_files:
        check_array(array, name)


def _read_chunks(array: Any, length: int) -> Iterator[NDArray[Any]]:
    """Frames in order. The file is read by whole chunks, because they are compressed."""
    frame_bytes = max(math.prod(array.shape[1:]) * array.dtype.itemsize, 1)
    together = max(1, min(array.chunks[0] if array.chunks else 1, BLOCK // frame_bytes))
    for begin in range(0, length, together):
        for frame in array[begin : min(begin + together, length)]:
            yield np.frombuffer(frame, np.uint8) if isinstance(frame, bytes) else np.asarray(frame)
