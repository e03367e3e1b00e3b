"""Frames in arrays of HDF5 and Zarr files, such as replay buffers."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from posixpath import commonpath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactflow.engine.errors import SourceError
from tactflow.sources.base import DEFAULT_FPS, FrameReader, check_array, log
from tactflow.sources.files import decode_image
from tactflow.sources.paths import find_path, listed, split_query

from .stores import explained, load_filters, open_arrays

SETTINGS = {
    "dataset": "name of the frames",
    "times": "name of their times (numbers with a point are s, whole ones ns)",
    "order": "rgb (bgr if not given)",
    "episode": "number of an episode (all if not given)",
}
EXPORTED = {"dataset": "/frames", "times": "/t"}
"""Written by `tactflow export`, and read by default from a file that has both."""
EPISODE_ENDS = "episode_ends"
"""Name of an array with the index after the last frame of each episode, as replay buffers have it."""
MAX_EPISODES = 10**6
"""Maximum number of episodes in a file."""
MAX_READ_BYTES = 64 << 20
"""Maximum number of bytes read at a time. Chosen by hand."""


class ArrayDataset(FrameReader):
    """Frames of one array of an HDF5 file, a Zarr folder or a Zarr .zip file.

    Parameters
    ----------
    spec : `file.h5?dataset=/frames`; `times=/t` names their times, else frame i is taken at i / fps;
        `order=rgb` if the colors are in that order. If an array `episode_ends` divides the frames, each
        episode is an epoch with a reference of its own, and `episode=3` plays one of them. An export of
        tactflow needs no settings.
    directory, fps : as for `open_source`. Raises SourceError if there is no such file, array (it lists the
        valid ones) or episode, it holds no frames, or a package is missing.
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
        arrays, self._close = open_arrays(path)
        if not settings and set(EXPORTED.values()) <= arrays.keys():
            settings = EXPORTED
        self._array: Any = None
        try:
            self._array = _choose(spec, settings.get("dataset"), arrays, "dataset")
            _check(self._array, self.name)
            load_filters(self._array)
            self._range, self._epochs = _episodes(spec, settings, arrays, int(self._array.shape[0]))
            self.total = len(self._range)
            if "times" in settings:
                self._times = self._seconds(_choose(spec, settings["times"], arrays, "times"))
            else:
                self.fps = fps or DEFAULT_FPS
                self._times = np.arange(self.total) / self.fps
            self._read_first()
        except Exception as error:
            self.close()
            raise explained(self.name, self._array, error) from error
        self.description = f"{spec}, {self.total} frames"
        if self._epochs[-1]:
            text = "%s: %d episodes, each with a reference of its own; &episode=N plays one of them"
            log.info(text, self.name, self._epochs[-1] + 1)

    def close(self) -> None:
        """Close the file."""
        super().close()
        self._close()

    def _frames(self) -> Iterator[tuple[NDArray[Any], float, int, bool, int]]:
        try:
            frames = zip(_read(self._array, self._range), self._times, self._epochs, strict=True)
            for index, (frame, t, epoch) in enumerate(frames):
                if frame.ndim == 1:
                    frame = decode_image(frame.tobytes(), f"{self.name}, frame {index}")
                elif self._swapped and frame.shape[2:] > (1,):
                    frame = frame[..., [2, 1, 0, 3][: frame.shape[2]]]
                yield frame, float(t), index, False, int(epoch)
        except self.parser_errors as error:
            raise explained(self.name, self._array, error) from error

    def _seconds(self, array: Any) -> NDArray[np.float64]:
        """Times from 0 at the first frame, s."""
        length = self._array.shape[0]
        if array.shape != (length,) or array.dtype.kind not in "fiu":
            raise SourceError(
                f"{self.name}: times are {array.dtype} of shape {array.shape}; required {length} numbers"
            )
        load_filters(array)
        times = np.asarray(array[self._range.start : self._range.stop])
        # Whole numbers are subtracted before they are rounded: Unix time in ns has 19 digits.
        seconds: NDArray[np.float64] = (times - times[:1]) / (1e9 if array.dtype.kind in "iu" else 1.0)
        if not np.isfinite(seconds).all():
            raise SourceError(f"{self.name}: required finite times")
        return seconds


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
    are_strings = array.ndim == 1 and dtype.kind in "OSV" and dtype.names is None
    are_files = are_strings or (array.ndim == 2 and dtype == np.uint8)
    if 0 in shape or not are_files:
        check_array(array, name)


def _episodes(
    spec: str, settings: Mapping[str, str], arrays: Mapping[str, Any], length: int
) -> tuple[range, NDArray[np.int64]]:
    """The frames to play, and the number of the epoch of each: one epoch per episode.

    length : number of frames. Raises SourceError if there is no such episode.
    """
    number, dataset = settings.get("episode"), f"/{settings['dataset'].strip('/')}"
    found = [name for name in arrays if name.rpartition("/")[2] == EPISODE_ENDS]
    problem = f"there is no array {EPISODE_ENDS}, which divides the frames into episodes"
    if found:
        # Of several buffers in a file, the one with the frames.
        name = max(found, key=lambda name: len(commonpath([name, dataset])))
        ends = _ends(arrays[name])
        if ends is not None and ends[-1] == length:
            if number is None:
                return range(length), np.repeat(np.arange(len(ends)), np.diff(ends, prepend=0))
            if number.isdecimal() and int(number) < len(ends):
                begin, end = (int(bound) for bound in (0, *ends)[int(number) :][:2])
                return range(begin, end), np.zeros(end - begin, np.int64)
            raise SourceError(f"{spec}: episode={number}: required one of the episodes 0 to {len(ends) - 1}")
        problem = f"{name} does not divide the {length} frames into episodes: required ascending ends, the "
        problem += f"last one {length}"
        if number is None:
            log.warning("%s: %s; they are played as one episode", spec, problem)
    if number is not None:
        raise SourceError(f"{spec}: episode={number}: {problem}")
    return range(length), np.zeros(length, np.int64)


def _ends(array: Any) -> NDArray[np.int64] | None:
    """The index after the last frame of each episode; None if these are not ascending integers."""
    if array.ndim != 1 or array.dtype.kind not in "iu" or not 0 < array.shape[0] <= MAX_EPISODES:
        return None
    load_filters(array)
    ends = np.asarray(array[:]).astype(np.int64)
    return ends if (np.diff(ends, prepend=0) >= 0).all() else None


def _read(array: Any, indices: range) -> Iterator[NDArray[Any]]:
    """Frames in order. The file is read by whole chunks, because they are compressed."""
    frame_bytes = max(math.prod(array.shape[1:]) * array.dtype.itemsize, 1)
    # HDF5 keeps strings of any length outside of the chunks.
    chunk = 1 if not array.chunks or "vlen" in (array.dtype.metadata or {}) else array.chunks[0]
    together = max(1, min(chunk, MAX_READ_BYTES // frame_bytes))
    begin = indices.start
    while begin < indices.stop:
        end = min(begin - begin % together + together, indices.stop)
        for frame in array[begin:end]:
            # An element of an array of strings is bytes, or a scalar of NumPy.
            is_file = isinstance(frame, bytes | np.void)
            yield np.frombuffer(frame, np.uint8) if is_file else np.asarray(frame)
        begin = end
