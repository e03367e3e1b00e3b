"""`tactflow export replay-buffer`: the Zarr replay buffer of Diffusion Policy, with the arrays of touch that
Reactive Diffusion Policy trains on.

The layout has a group `data` with one array per quantity, time first, and `meta/episode_ends`
(https://github.com/real-stanford/diffusion_policy, `common/replay_buffer.py`). The names and units of the
arrays of touch are those of https://github.com/xiaoxiaoxh/reactive_diffusion_policy, which divides markers by
the width and the height of the picture (`common/tactile_marker_utils.py`).
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from tactflow.engine.errors import StageError
from tactflow.message.episodes import AlignedMarkers, MarkerOrder, at_rate
from tactflow.system.extras import missing

if TYPE_CHECKING:
    from tactflow.message.result import Result

log = logging.getLogger("tactflow")

FOLDER: Final = "replay_buffer.zarr"
"""Name of the buffer below the folder of the dataset, under which Reactive Diffusion Policy looks for it."""
CHUNK_FRAMES: Final = 16
"""Frames of a chunk, and in memory at once: about the horizon of a policy, which reads whole chunks."""
EMBEDDING_LENGTH: Final = 15
"""Length of the embedding of the marker offsets, as in Reactive Diffusion Policy."""
COMPRESSION: Final = {"cname": "zstd", "clevel": 5, "shuffle": 2}
"""Settings of Blosc that Diffusion Policy calls "disk"; 2 shuffles bits."""


def export(folder: Path, episodes: Iterable[tuple[str, Iterable[Result]]], *, fps: int, **_: object) -> None:
    """Write `replay_buffer.zarr` and, if there are markers, their embedding, for `tactflow export`.

    Parameters
    ----------
    folder : empty or missing.
    episodes : the name of each recording, and its results with pictures.
    fps : of the dataset, frames per second.

    Raises
    ------
    StageError : a package is missing, or a recording does not match the earlier ones. OSError : the files
        cannot be written.
    """
    problem = missing("replay buffers", "zarr", ["zarr"])
    if problem is not None:
        raise StageError(problem)
    writer = ReplayBufferWriter(folder / FOLDER)
    for name, results in episodes:
        log.info("%s: %d frames", name, writer.add(at_rate(results, fps)))
    embedding = writer.finish()
    if embedding is not None:
        # Reactive Diffusion Policy reads them by these names.
        np.save(folder / "pca_transform_matrix.npy", embedding[0])
        np.save(folder / "pca_mean_matrix.npy", embedding[1])


class ReplayBufferWriter:
    """Writes one replay buffer of one sensor.

    Parameters
    ----------
    path : of the Zarr folder. Raises OSError if it cannot be created.
    """

    def __init__(self, path: Path) -> None:
        import zarr

        # Diffusion Policy uses version 2 of the package, which only knows this format.
        root = zarr.open_group(path, mode="w", zarr_format=2)
        self._data: Any = root.create_group("data")
        self._meta: Any = root.create_group("meta")
        self._order = MarkerOrder()
        self._ends: list[int] = []
        self._kind = self._sensor = ""
        self._size = np.zeros(2, np.intp)

    def add(self, results: Iterable[Result]) -> int:
        """Write one episode; returns the number of its frames.

        results : of one sensor, with pictures, and with markers if its gel has any.

        Raises
        ------
        StageError : the sensor, the size of its pictures or its markers differ from the episodes before, or
            there is no picture. OSError : the files cannot be written.
        """
        frames, markers = 0, list[AlignedMarkers | None]()
        remaining = iter(results)
        while batch := list(islice(remaining, CHUNK_FRAMES)):
            pictures = [self._check(result)[:, :, ::-1] for result in batch]
            self._append(f"{self._sensor}_img", np.stack(pictures))
            self._append("timestamp", np.array([result.t for result in batch]))
            markers += map(self._aligned, batch)
            frames += len(batch)
        if not frames:
            raise StageError("there is no frame in it")
        self._append_markers(markers)
        self._ends.append(len(self) + frames)
        return frames

    def finish(self) -> tuple[NDArray[np.float32], NDArray[np.float32]] | None:
        """Write the ends of the episodes and the embedding.

        Returns
        -------
        transform (2 N, 15) and mean (2 N,) float32: the embedding of the offsets d, (2 N,), is
        (d - mean) @ transform. None without markers.
        """
        ends = np.array(self._ends, np.int64)
        self._meta.create_array("episode_ends", data=ends, chunks=ends.shape, compressors=None)
        if self._order.origin is None:
            return None
        # They are small beside the pictures, which the loaders keep in memory, too.
        offsets = self._data[f"{self._sensor}_marker_offset"][:].reshape(len(self), -1)
        transform, mean = fit_embedding(offsets)
        self._append(f"{self._sensor}_marker_offset_emb", (offsets - mean) @ transform)
        return transform, mean

    def __len__(self) -> int:
        """The number of frames in all complete episodes."""
        return self._ends[-1] if self._ends else 0

    def _check(self, result: Result) -> NDArray[np.uint8]:
        """The picture of a result, if it matches the earlier ones."""
        image = result.image
        if image is None:
            raise StageError("the pipeline makes no picture: it needs a stage preprocess")
        kind = f"{result.sensor}, {image.shape[1]} x {image.shape[0]} pixels"
        if self._kind not in ("", kind):
            raise StageError(f"{kind}; the earlier ones are {self._kind}: make two datasets")
        self._kind, self._sensor, self._size = kind, result.sensor, np.array(image.shape[1::-1])
        return image

    def _aligned(self, result: Result) -> AlignedMarkers | None:
        """The markers of a result in the order of the first recording; None before any were found."""
        has_any = result.markers is not None and len(result.markers.origin)
        if result.markers is None or not (has_any or self._order.origin is not None):
            return None
        return self._order.align(result.markers)

    def _append_markers(self, episode: Sequence[AlignedMarkers | None]) -> None:
        """Write the markers of an episode; in frames without any, all are lost."""
        if self._order.origin is None:
            return
        if self._ends and f"{self._sensor}_marker_offset" not in self._data:
            raise StageError("it has markers, and the recordings before have none: make two datasets")
        frames = [self._order.lost() if markers is None else markers for markers in episode]
        arrays = {
            "initial_marker": (np.stack([markers.origin for markers in frames]) / self._size).astype("f4"),
            "marker_offset": (np.stack([markers.offset for markers in frames]) / self._size).astype("f4"),
            "marker_status": np.stack([markers.status for markers in frames]),
        }
        for name, values in arrays.items():
            self._append(f"{self._sensor}_{name}", values)

    def _append(self, name: str, values: NDArray[Any]) -> None:
        if name in self._data:
            self._data[name].append(values)
            return
        from numcodecs import Blosc  # type: ignore[import-untyped]

        array = self._data.create_array(
            name,
            shape=(0, *values.shape[1:]),
            dtype=values.dtype,
            chunks=(CHUNK_FRAMES, *values.shape[1:]),
            compressors=Blosc(**COMPRESSION),
        )
        array.append(values)


def fit_embedding(vectors: NDArray[np.floating[Any]]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Fit a principal component analysis to vectors, (frames, length).

    Returns
    -------
    transform (length, 15) float32, orthonormal columns in descending order of their variance, the largest
    number of each positive; columns that do not exist are 0. mean (length,) float32.

    >>> transform, mean = fit_embedding(np.outer(np.arange(5.0), [3.0, 4.0]))
    >>> transform[:, 0].round(3), mean
    (array([0.6, 0.8], dtype=float32), array([6., 8.], dtype=float32))
    """
    covariance = np.atleast_2d(np.cov(vectors, rowvar=False, bias=True))
    columns = np.linalg.eigh(covariance)[1][:, ::-1][:, :EMBEDDING_LENGTH]
    largest = np.take_along_axis(columns, np.abs(columns).argmax(0)[None], 0)
    transform = np.zeros((vectors.shape[1], EMBEDDING_LENGTH), np.float32)
    transform[:, : columns.shape[1]] = columns * np.sign(largest)
    return transform, vectors.mean(0, dtype=np.float64).astype(np.float32)
