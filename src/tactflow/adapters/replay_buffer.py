"""`tactflow export replay-buffer`: the Zarr replay buffer of Diffusion Policy, with the arrays of touch that
Reactive Diffusion Policy trains on.

Layout: group `data` with one array per quantity, time first, and `meta/episode_ends`
(https://github.com/real-stanford/diffusion_policy, `common/replay_buffer.py`). Names and units of the arrays
of touch: https://github.com/xiaoxiaoxh/reactive_diffusion_policy, whose markers are divided by the width and
the height of the picture (`common/tactile_marker_utils.py`).
"""

from __future__ import annotations

import logging
from collections.abc import Iterable
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tactflow.engine.errors import StageError
from tactflow.message.episodes import AlignedMarkers, MarkerOrder, at_rate
from tactflow.system.extras import missing

if TYPE_CHECKING:
    from tactflow.message.result import Result

log = logging.getLogger("tactflow")

BATCH = 64
"""Frames of a chunk; so many pictures are in memory together. Chosen by hand."""
COMPONENTS = 15
"""Length of the embedding, as in Reactive Diffusion Policy."""
COMPRESSION = {"cname": "zstd", "clevel": 3, "shuffle": 1}
"""Of Blosc, as Reactive Diffusion Policy writes it."""


def export(folder: Path, episodes: Iterable[tuple[str, Iterable[Result]]], *, fps: int, **_: object) -> None:
    """Write `replay_buffer.zarr` and the matrices of its embedding; an exporter of `tactflow export`.

    Parameters
    ----------
    folder : empty, or not there.
    episodes : the name of each recording, and its results with pictures and markers.
    fps : of the dataset, frames per second.

    Raises
    ------
    StageError : a package is missing, or a recording does not go with those before. OSError : the files
        cannot be written.
    """
    problem = missing("replay buffers", "zarr", ["zarr"])
    if problem is not None:
        raise StageError(problem)
    buffer = ReplayBuffer(folder / "replay_buffer.zarr")
    for name, results in episodes:
        log.info("%s: %d frames", name, buffer.add(at_rate(results, fps)))
    transform, mean = buffer.finish()
    # The names that Reactive Diffusion Policy reads them by.
    np.save(folder / "pca_transform_matrix.npy", transform)
    np.save(folder / "pca_mean_matrix.npy", mean)


class ReplayBuffer:
    """Writes one replay buffer. path : of the Zarr folder."""

    def __init__(self, path: Path) -> None:
        import zarr

        # Diffusion Policy uses version 2 of the package, which only knows this format.
        root = zarr.open_group(path, mode="w", zarr_format=2)
        self._data: Any = root.create_group("data")
        self._meta: Any = root.create_group("meta")
        self._order = MarkerOrder()
        self._ends: list[int] = []
        self._kind = self._sensor = ""

    def add(self, results: Iterable[Result]) -> int:
        """Write one episode; returns the number of its frames.

        results : of one sensor, with pictures and markers.

        Raises
        ------
        StageError : the sensor, the size of its pictures or its markers differ from the episodes before, or
            there is no picture or no marker. OSError : the files cannot be written.
        """
        begin = frames = self._ends[-1] if self._ends else 0
        pending = map(self._row, results)
        while rows := list(islice(pending, BATCH)):
            for name in rows[0]:
                self._append(name, np.stack([row[name] for row in rows]))
            frames += len(rows)
        if frames == begin:
            raise StageError("there is no frame in it")
        self._ends.append(frames)
        return frames - begin

    def finish(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Write the ends of the episodes and the embedding.

        Returns
        -------
        transform (2 N, 15) and mean (2 N,) float32: the embedding of the displacements d, (2 N,), is
        (d - mean) @ transform.
        """
        ends = np.array(self._ends, np.int64)
        self._meta.create_array("episode_ends", data=ends, chunks=ends.shape, compressors=None)
        # Small beside the pictures, which the loaders keep in memory, too.
        offsets = self._data[f"{self._sensor}_marker_offset"][:].reshape(ends[-1], -1)
        transform, mean = fit_embedding(offsets)
        self._append(f"{self._sensor}_marker_offset_emb", (offsets - mean) @ transform)
        return transform, mean

    def _row(self, result: Result) -> dict[str, NDArray[Any]]:
        """The arrays of one frame."""
        image, markers = self._check(result)
        size = np.array([image.shape[1], image.shape[0]], np.float64)
        touch: dict[str, NDArray[Any]] = {
            "img": image[:, :, ::-1],
            "initial_marker": (markers.origin / size).astype(np.float32),
            "marker_offset": (markers.offset / size).astype(np.float32),
            "marker_status": markers.status,
        }
        row = {f"{result.sensor}_{name}": array for name, array in touch.items()}
        row["timestamp"] = np.array(result.t)
        return row

    def _check(self, result: Result) -> tuple[NDArray[np.uint8], AlignedMarkers]:
        """The picture and the markers of a result, if it goes with those before."""
        image = result.image
        if image is None:
            raise StageError("the pipeline makes no picture: it needs a stage preprocess")
        kind = f"{result.sensor}, {image.shape[1]} x {image.shape[0]} pixels"
        if self._kind not in ("", kind):
            raise StageError(f"{kind}; those before are {self._kind}: make two datasets")
        self._kind, self._sensor = kind, result.sensor
        if result.markers is not None and len(result.markers.origin):
            return image, self._order.align(result.markers)
        if self._order.origin is None:
            raise StageError("its first frame has no markers: it needs a stage tracker, and a gel with dots")
        return image, self._order.lost()

    def _append(self, name: str, values: NDArray[Any]) -> None:
        if name in self._data:
            self._data[name].append(values)
            return
        from numcodecs import Blosc  # type: ignore[import-untyped]

        array = self._data.create_array(
            name,
            shape=(0, *values.shape[1:]),
            dtype=values.dtype,
            chunks=(BATCH, *values.shape[1:]),
            compressors=Blosc(**COMPRESSION),
        )
        array.append(values)


def fit_embedding(vectors: NDArray[np.floating[Any]]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Fit a principal component analysis to vectors, (frames, length).

    Returns
    -------
    transform (length, 15) float32, orthonormal columns in the order of their variance, the largest number of
    each positive; columns that do not exist are 0. mean (length,) float32.

    >>> transform, mean = fit_embedding(np.outer(np.arange(5.0), [3.0, 4.0]))
    >>> transform[:, 0].round(3), mean
    (array([0.6, 0.8], dtype=float32), array([6., 8.], dtype=float32))
    """
    covariance = np.atleast_2d(np.cov(vectors, rowvar=False, bias=True))
    columns = np.linalg.eigh(covariance)[1][:, ::-1][:, :COMPONENTS]
    largest = np.take_along_axis(columns, np.abs(columns).argmax(0)[None], 0)
    transform = np.zeros((vectors.shape[1], COMPONENTS), np.float32)
    transform[:, : columns.shape[1]] = columns * np.sign(largest)
    return transform, vectors.mean(0, dtype=np.float64).astype(np.float32)
