"""What a batch keeps of a recording for people: curves with a bounded number of points, and pictures."""

from __future__ import annotations

import base64
import math
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import cv2
import numpy as np

from tactflow.drawing.jpeg import encode_jpeg
from tactflow.drawing.results import Annotator
from tactflow.engine.collect import with_collector
from tactflow.engine.graph import Pipeline
from tactflow.message.result import Result

MOST_POINTS = 240
"""Points of a curve, before neighbours are merged: one a pixel of a plot. Chosen by hand."""
MOST_PICTURES = 4
"""Pictures of a recording. Chosen by hand: they fit in a line of the table."""
PICTURE_SIDE = 160
"""Longer side of a picture, px. Chosen by hand."""
_QUALITY = 70
"""JPEG quality of a picture, 1 to 100: some 4 kB. Chosen by hand."""
_SINK = "tactflow.batch"
"""Id of the sink that looks on; no id of a file has a point in it."""


class Point(NamedTuple):
    """A frame of a curve. t : s. area : of the contact, px^2. flow : length of the mean, px. angle : deg."""

    t: float
    area: float
    flow: float | None
    angle: float | None


class Curve:
    """The frames of a recording of any length in a bounded number of points.

    When there are too many, of each two the one with the larger contact stays: every point is a frame that
    was, and no contact gets lost.

    >>> curve = Curve(most=4)
    >>> for t, area in enumerate([0, 0, 5, 9, 0, 0, 7, 0]):
    ...     curve.add(Point(t, area, None, None))
    >>> [point.area for point in curve.points]
    [0, 9, 0, 7]
    """

    def __init__(self, most: int = MOST_POINTS) -> None:
        self._most = most
        self._kept: list[Point] = []
        self._held: Point | None = None
        self._count, self._every = 0, 1

    def add(self, point: Point) -> None:
        """Take the next frame."""
        self._held = point if self._held is None else max(self._held, point, key=_area)
        self._count += 1
        if self._count < self._every:
            return
        if len(self._kept) == self._most:
            self._kept = [max(pair, key=_area) for pair in zip(*[iter(self._kept)] * 2, strict=True)]
            self._every *= 2
            if self._count < self._every:
                return
        self._kept.append(self._held)
        self._held, self._count = None, 0

    @property
    def points(self) -> list[Point]:
        """The curve so far."""
        return self._kept + ([] if self._held is None else [self._held])


def _area(point: Point) -> float:
    return point.area


@dataclass(frozen=True, slots=True)
class Thumbnail:
    """A picture of a contact where it is largest: JPEG in base64."""

    seq: int
    t: float
    area: float
    jpeg: str


class Looker(Protocol):
    """Looks at every result of a run."""

    def add(self, result: Result) -> None:
        """Take one frame."""
        ...


class Summary:
    """Looks at every result of a run; memory does not grow with the recording."""

    def __init__(self) -> None:
        self.curve = Curve()
        self.frames = self.contacts = self.touching = 0
        self.largest = self.duration = 0.0
        self._first: bool | None = None
        self._pictures: list[Thumbnail] = []
        self._best: Result | None = None

    def add(self, result: Result) -> None:
        """Take one frame."""
        contact, flow = result.contact, result.flow
        mean = None if flow is None or flow.mean is None else math.hypot(*flow.mean)
        area = 0.0 if contact is None else float(contact.area)
        angle = None if contact is None else contact.angle
        self.curve.add(Point(result.t, area, mean, angle))
        self.duration = result.t
        self.frames += 1
        self._first = contact is not None if self._first is None else self._first
        if contact is None:
            self._end_contact()
            return
        self.touching += 1
        self.contacts += self._best is None
        self.largest = max(self.largest, area)
        if self._best is None or self._best.contact is None or area > self._best.contact.area:
            self._best = result

    @property
    def ends(self) -> tuple[bool, bool]:
        """Whether there is a contact in the first frame, and in the last one so far."""
        return bool(self._first), self._best is not None

    def _end_contact(self) -> None:
        """Keep a picture of the contact that is over, if it is one of the largest."""
        if self._best is None:
            return
        result, self._best = self._best, None
        assert result.contact is not None
        smallest = min((picture.area for picture in self._pictures), default=0.0)
        if len(self._pictures) == MOST_PICTURES and result.contact.area <= smallest:
            return
        one = Thumbnail(result.seq, result.t, float(result.contact.area), picture_of(result))
        self._pictures = sorted([*self._pictures, one], key=lambda p: -p.area)[:MOST_PICTURES]

    def finished(self) -> dict[str, Any]:
        """Curve and pictures, as they are stored, at the end of the recording."""
        self._end_contact()
        pictures = sorted(self._pictures, key=lambda picture: picture.seq)
        return {"curve": [tuple(point) for point in self.curve.points], "pictures": pictures}


def picture_of(result: Result, side: int = PICTURE_SIDE) -> str:
    """The processed frame, or else the raw one, with what was found drawn on it: JPEG in base64.

    side : the longer one of the picture, px.
    """
    image = result.frame.image if result.image is None else result.image
    annotator = Annotator(text=False)
    drawn = annotator(image, contact=result.contact, flow=result.flow, markers=result.markers)
    scale = min(1.0, side / max(drawn.shape[:2]))
    resized = cv2.resize(drawn, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    small = np.asarray(resized, np.uint8)
    return base64.b64encode(encode_jpeg(small, _QUALITY)).decode()


def with_looker(pipeline: Pipeline, looker: Looker) -> Pipeline:
    """The pipeline with a sink that lets somebody look on."""
    return with_collector(pipeline, Result, looker.add, name=_SINK, sinks=True)
