"""Common parts of datasets for training policies: a constant rate, and the same markers in every frame."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import chain
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from tactflow.engine.errors import StageError
from tactflow.vision.types import Markers, MarkerStatus

if TYPE_CHECKING:
    from tactflow.message.result import Result


Results: TypeAlias = "Iterable[Result] | Mapping[str, Iterable[Result]]"
"""Of a recording, or sensor -> those of its recording, with times of one clock."""


def aligned(sensors: Mapping[str, Iterable[Result]], fps: int) -> Iterator[dict[str, Result]]:
    """The results of all sensors at each multiple of 1 / fps, from the first to the last that all have.

    sensors : with times of one clock. Of each, the result nearest in time is taken.

    >>> from types import SimpleNamespace
    >>> def results(times): return [SimpleNamespace(t=t) for t in times]
    >>> found = aligned({"left": results([1.0, 1.1, 1.2, 1.3]), "right": results([1.12, 1.18, 1.31])}, 10)
    >>> [(moment["left"].t, moment["right"].t) for moment in found]
    [(1.1, 1.12), (1.2, 1.18), (1.3, 1.31)]
    """
    streams = {name: iter(results) for name, results in sensors.items()}
    first = {name: next(stream, None) for name, stream in streams.items()}
    started = {name: result for name, result in first.items() if result is not None}
    if len(started) < len(streams):
        return
    begin = max(result.t for result in started.values())
    paced = [at_rate(chain([started[name]], stream), fps, begin) for name, stream in streams.items()]
    # The shortest ends the episode.
    for moment in zip(*paced, strict=False):
        yield dict(zip(streams, moment, strict=True))


def at_rate(results: Iterable[Result], fps: int, begin: float | None = None) -> Iterator[Result]:
    """The result nearest in time for each multiple of 1 / fps since `begin`, s; by default the first result.

    >>> from types import SimpleNamespace
    >>> times = [5.0, 5.02, 5.21, 5.3]
    >>> [result.t for result in at_rate((SimpleNamespace(t=t) for t in times), 10)]
    [5.0, 5.02, 5.21, 5.3]
    """
    before: Result | None = None
    index = 0
    for result in results:
        if before is None:
            before, begin = result, result.t if begin is None else begin
        assert begin is not None
        # In a tie, take the earlier one.
        while begin + index / fps < (before.t + result.t) / 2:
            yield before
            index += 1
        before = result
    if before is not None and begin is not None and index <= round((before.t - begin) * fps):
        yield before


@dataclass(frozen=True, slots=True)
class AlignedMarkers:
    """The N markers of a dataset in one frame.

    Attributes
    ----------
    origin : (N, 2) float64, positions in the reference frame of this recording, px.
    offset : (N, 2) float64, displacements since then, px.
    status : (N,) uint8, values of `MarkerStatus`. All are finite.
    """

    origin: NDArray[np.float64]
    offset: NDArray[np.float64]
    status: NDArray[np.uint8]


class MarkerOrder:
    """Sorts the markers of all recordings of a sensor as in the first one.

    Each recording detects its markers anew, and may miss some. Two are the same marker if their positions in
    the reference frames are closer than half the distance between neighbours.

    Attributes
    ----------
    origin : (N, 2) float64, px, positions in the first recording; None until a frame has markers.

    Examples
    --------
    >>> order = MarkerOrder()
    >>> first = np.array([[10.0, 10.0], [20.0, 10.0], [30.0, 10.0]])
    >>> tracked = np.zeros(3, np.uint8)
    >>> _ = order.align(Markers(first, first, tracked, np.zeros(3)))
    >>> later = first[[2, 0]] + 0.5
    >>> aligned = order.align(Markers(later, later + [[2.0, 0.0], [1.0, 0.0]], tracked[:2], np.zeros(2)))
    >>> aligned.offset[:, 0], aligned.status
    (array([1., 1., 2.]), array([0, 2, 0], dtype=uint8))
    """

    def __init__(self) -> None:
        self.origin: NDArray[np.float64] | None = None
        self._aligned_origin: NDArray[np.float64] | None = None
        self._nearest = np.zeros(0, np.intp)
        self._is_missing = np.zeros(0, np.bool_)

    def align(self, markers: Markers) -> AlignedMarkers:
        """The markers in the order of the first recording.

        A marker that this recording misses keeps its position in the first one, gets the displacement of its
        nearest neighbour, and is lost.

        Raises
        ------
        StageError : fewer than half of the markers are at the positions of the first recording.
        """
        if self.origin is None:
            self.origin = markers.origin
        if self._aligned_origin is None or not np.array_equal(self._aligned_origin, markers.origin):
            self._match(self.origin, markers.origin)
        status = np.where(self._is_missing, MarkerStatus.LOST, markers.status[self._nearest])
        origin = np.where(self._is_missing[:, None], self.origin, markers.origin[self._nearest])
        return AlignedMarkers(origin, markers.displacement[self._nearest], status.astype(np.uint8))

    def lost(self) -> AlignedMarkers:
        """All markers, unmoved and lost, for a frame without markers. Only after `align`."""
        assert self.origin is not None
        count = len(self.origin)
        return AlignedMarkers(self.origin, np.zeros((count, 2)), np.full(count, MarkerStatus.LOST, np.uint8))

    def _match(self, first: NDArray[np.float64], origin: NDArray[np.float64]) -> None:
        distance, nearest = (
            KDTree(origin).query(first) if len(origin) else (np.full(len(first), np.inf), None)
        )
        # For a single marker, the distance to its neighbour is infinite.
        neighbours = KDTree(first).query(first, [2])[0]
        self._is_missing = np.asarray(distance > np.median(neighbours) / 2)
        if nearest is None or 2 * self._is_missing.sum() > len(first):
            matched = int(len(first) - self._is_missing.sum())
            raise StageError(
                f"only {matched} of {len(first)} markers are where those of the first recording were: was "
                "the camera or the gel moved? Make two datasets"
            )
        self._nearest, self._aligned_origin = np.asarray(nearest), origin


class Moments:
    """Running minimum, maximum, mean and standard deviation of rows (n, ...) of numbers; ignores NaN.

    >>> moments = Moments()
    >>> moments.add(np.array([[1.0, np.nan], [3.0, np.nan]]))
    >>> {name: values.tolist() for name, values in moments.summary().items()}
    {'min': [1.0, 0.0], 'max': [3.0, 0.0], 'mean': [2.0, 0.0], 'std': [1.0, 0.0]}
    """

    def __init__(self) -> None:
        self._count = self._sum = self._squares = np.zeros(())
        self._min, self._max = np.array(np.inf), np.array(-np.inf)

    def add(self, rows: NDArray[np.generic]) -> None:
        """Add one row or more."""
        numbers = rows.astype(np.float64)
        known = np.isfinite(numbers)
        zeroed = np.where(known, numbers, 0.0)
        self._count = self._count + known.sum(0)
        self._sum = self._sum + zeroed.sum(0)
        self._squares = self._squares + (zeroed**2).sum(0)
        self._min = np.minimum(self._min, np.where(known, numbers, np.inf).min(0))
        self._max = np.maximum(self._max, np.where(known, numbers, -np.inf).max(0))

    def summary(self) -> dict[str, NDArray[np.float64]]:
        """The four statistics by name, of a row's shape; 0 without known values."""
        count = np.maximum(self._count, 1)
        mean = self._sum / count
        std = np.sqrt(np.maximum(self._squares / count - mean**2, 0))
        statistics = {"min": self._min, "max": self._max, "mean": mean, "std": std}
        return {name: np.where(self._count > 0, values, 0.0) for name, values in statistics.items()}
