"""How the results of two pipelines over the same recordings differ, number by number, frame by frame."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import orjson

from tactflow.adapters.tables import Column, frame_columns
from tactflow.batch.folder import Folder
from tactflow.batch.recordings import Recording
from tactflow.batch.task import Outcome

MOST_WORST = 8
"""Frames that are shown. Chosen by hand: they fit on two screens."""
WORST_OF_ONE = 2
"""Of these, at most so many of one recording, whose neighbours look the same. Chosen by hand."""
_DECADES = (-9, 9)
"""Powers of ten between which differences are told apart."""
_STEPS = 50
"""Classes of each power of ten: a quantile is right to 5 %."""
HALF_TURN = 180.0
"""Degrees after which the direction of an axis is the same again."""

Frame = Mapping[str, Any]
"""One row of the table `frames`: column -> value, None where there is none."""


class Spread:
    """How one number differs, in as much memory for a million frames as for one.

    column : the number. count : frames in which both have it. equal : in which it is the same to the bit.
    mean : of the second minus the first. largest : without the sign.

    >>> spread = Spread(Column("contact_area", ("contact", "area"), "number", "of the convex hull, px^2"))
    >>> for second in (10.0, 11.0, 9.0, 10.0):
    ...     spread.add(second - 10.0)
    >>> spread.count, spread.equal, spread.mean, spread.largest, round(spread.quantile(0.95), 1)
    (4, 2, 0.0, 1.0, 1.0)
    """

    def __init__(self, column: Column) -> None:
        self.column = column
        self.count = self.equal = 0
        self.largest = self._total = 0.0
        low, high = _DECADES
        self._bounds = np.logspace(low, high, (high - low) * _STEPS + 1)
        self._classes = np.zeros(len(self._bounds) + 1, np.int64)

    def add(self, difference: float) -> None:
        """Take one frame."""
        self.count += 1
        self.equal += difference == 0.0
        self._total += difference
        self.largest = max(self.largest, abs(difference))
        self._classes[np.searchsorted(self._bounds, abs(difference))] += 1

    @property
    def mean(self) -> float:
        """Of the differences, with their sign."""
        return self._total / self.count if self.count else 0.0

    def quantile(self, share: float) -> float:
        """What this share of the differences is below, without their sign; right to 5 %."""
        place = int(np.searchsorted(np.cumsum(self._classes), share * self.count))
        # The first class is what is next to nothing, the last has no bound.
        return (
            0.0 if place == 0 else min(float(self._bounds[min(place, len(self._bounds) - 1)]), self.largest)
        )


@dataclass(frozen=True, slots=True)
class Worst:
    """A frame in which the outlines of two pipelines agree least.

    overlap : of the two, intersection over union. area : of the larger one, px^2.
    """

    recording: Recording
    seq: int
    t: float
    overlap: float
    area: float

    @property
    def rank(self) -> tuple[float, float]:
        """The least overlap first, of these the largest."""
        return self.overlap, -self.area


@dataclass(slots=True)
class Comparison:
    """All that differs between two pipelines.

    frames : that both have. alone : that only one has. only_first, only_second : in which only that one finds
    a contact. both : in which both do. overlap : mean of the two outlines, intersection over union, of these.
    scales : by which pixels of the second were multiplied, where its pictures are of another size.
    """

    frames: int = 0
    alone: int = 0
    only_first: int = 0
    only_second: int = 0
    both: int = 0
    overlap: float = 0.0
    spreads: dict[str, Spread] = field(default_factory=dict[str, Spread])
    worst: list[Worst] = field(default_factory=list[Worst])
    scales: set[float] = field(default_factory=set[float])

    def add(self, recording: Recording, first: Iterable[Frame], second: Iterable[Frame]) -> None:
        """Compare the frames of one recording."""
        columns = [column for column in frame_columns() if _compared(column)]
        worst: list[Worst] = []
        for one, other in _pairs(first, second):
            if one is None or other is None:
                self.alone += 1
                continue
            self.frames += 1
            scale = one["size_width"] / other["size_width"]
            self.scales.add(round(scale, 3))
            self._numbers(columns, one, other, scale)
            found = self._outlines(recording, one, other, scale)
            worst = sorted([*worst, *found], key=lambda w: w.rank)[:WORST_OF_ONE]
        self.worst = sorted([*self.worst, *worst], key=lambda w: w.rank)[:MOST_WORST]

    def _numbers(self, columns: Iterable[Column], one: Frame, other: Frame, scale: float) -> None:
        for column in columns:
            before, after = one.get(column.name), other.get(column.name)
            if before is None or after is None:
                continue
            difference = _in_pixels_of_first(column, after, scale) - before
            if column.name.endswith("angle"):
                difference = (difference + HALF_TURN / 2) % HALF_TURN - HALF_TURN / 2
            spread = self.spreads.get(column.name)
            if spread is None:
                spread = self.spreads[column.name] = Spread(column)
            spread.add(difference)

    def _outlines(self, recording: Recording, one: Frame, other: Frame, scale: float) -> list[Worst]:
        hulls = [one["contact_hull"], other["contact_hull"]]
        if not any(hulls):
            return []
        self.only_first += not hulls[1]
        self.only_second += not hulls[0]
        shapes = [np.array(hull or np.empty((0, 2)), np.float32) for hull in hulls]
        shapes[1] = (shapes[1] + 0.5) * np.float32(scale) - 0.5
        overlap = _overlap(*shapes) if all(hulls) else 0.0
        if all(hulls):
            self.both += 1
            self.overlap += (overlap - self.overlap) / self.both
        area = max(_area(shape) for shape in shapes)
        return [Worst(recording, one["seq"], one["t"], overlap, area)]


def compare(
    folder: Folder,
    recordings: Iterable[Recording],
    first: Mapping[str, Outcome],
    second: Mapping[str, Outcome],
) -> Comparison:
    """Compare what two pipelines made of recordings; those that either has not done are left out."""
    comparison = Comparison()
    for recording in recordings:
        outcomes = [found.get(recording.source) for found in (first, second)]
        results = [o.result for o in outcomes if o is not None and o.status == "done" and o.result]
        if len(results) == 2:
            one, other = (_frames(folder.results / name) for name in results)
            comparison.add(recording, one, other)
    return comparison


def _frames(path: Path) -> Iterator[Frame]:
    """The frames of a result, in order."""
    if not path.is_dir():
        columns = frame_columns()
        with path.open("rb") as lines:
            for line in lines:
                message = orjson.loads(line)
                yield {column.name: column.value(message) for column in columns}
        return
    import pyarrow.parquet as pq  # type: ignore[import-untyped]

    for part in sorted((path / "frames").glob("part-*.parquet")):
        for batch in pq.ParquetFile(part).iter_batches():
            yield from batch.to_pylist()


def _pairs(first: Iterable[Frame], second: Iterable[Frame]) -> Iterator[tuple[Frame | None, Frame | None]]:
    """Frames of the same number side by side; None where one is missing."""
    ones, others = iter(first), iter(second)
    one, other = next(ones, None), next(others, None)
    while one is not None or other is not None:
        if other is None or (one is not None and one["seq"] < other["seq"]):
            yield one, None
            one = next(ones, None)
        elif one is None or other["seq"] < one["seq"]:
            yield None, other
            other = next(others, None)
        else:
            yield one, other
            one, other = next(ones, None), next(others, None)


def _compared(column: Column) -> bool:
    """Whether the differences of a column say something: not of frame numbers, times and sizes."""
    is_number = column.kind in ("number", "integer", "boolean")
    return is_number and column.name not in ("seq", "t", "size_width", "size_height", "contact_slope")


def _in_pixels_of_first(column: Column, value: float, scale: float) -> float:
    if re.search(r"px\^2", column.description):
        return value * scale**2
    if not re.search(r"\bpx\b", column.description):
        return value
    # The centre of the first pixel is 0 in both pictures.
    return (value + 0.5) * scale - 0.5 if "center" in column.name else value * scale


def _area(hull: np.ndarray[Any, np.dtype[np.float32]]) -> float:
    return float(cv2.contourArea(hull)) if len(hull) else 0.0


def _overlap(
    one: np.ndarray[Any, np.dtype[np.float32]], other: np.ndarray[Any, np.dtype[np.float32]]
) -> float:
    """Intersection over union of two convex outlines."""
    shared = float(cv2.intersectConvexConvex(one, other)[0])
    union = _area(one) + _area(other) - shared
    return shared / union if union > 0 else 0.0
