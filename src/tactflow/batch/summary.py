"""Content of the page for one recording: contact area, flow and angle over time, and contact pictures.

The page draws the plot: workers do not import matplotlib, which takes longer than a short recording.
"""

from __future__ import annotations

import base64
import math
from typing import NamedTuple

import cv2
import numpy as np
import orjson

from tactflow.drawing.jpeg import encode_jpeg
from tactflow.drawing.results import Annotator
from tactflow.message.result import Result

MAX_POINTS = 480
"""Points of a curve after merging neighbours, about two per pixel of the plot; merged at twice as many."""
MAX_PICTURES = 4
"""Pictures per recording: they fit next to its plot."""
PICTURE_SIDE = 240
"""Longer side of a picture, px: about the height of the plot."""
_QUALITY = 70
"""JPEG quality of a picture, 1 to 100: about 7 kB. Chosen by hand."""


class Point(NamedTuple):
    """A point of the curves. t : s. area : px^2. flow : norm of the mean flow, px. angle : degrees."""

    t: float
    area: float
    flow: float
    angle: float


class _Picture(NamedTuple):
    seq: int
    t: float
    area: float
    jpeg: bytes


class Summary:
    """Collects the frames of a run in bounded memory."""

    def __init__(self) -> None:
        self.frames = self.contacts = self.touching = 0
        self.largest = self.duration = 0.0
        self.points: list[Point] = []
        self._frames_per_point = 1
        self._pictures: list[_Picture] = []
        self._best: Result | None = None

    def add(self, result: Result) -> None:
        """Add one frame."""
        contact, flow = result.contact, result.flow
        area = 0.0 if contact is None else float(contact.area)
        mean = math.nan if flow is None or flow.mean is None else math.hypot(*flow.mean)
        angle = math.nan if contact is None or contact.angle is None else contact.angle
        self._add_point(Point(result.t, area, mean, angle))
        self.duration = result.t
        self.frames += 1
        if contact is None:
            self._end_contact()
            return
        self.touching += 1
        self.contacts += self._best is None
        self.largest = max(self.largest, area)
        if self._best is None or self._best.contact is None or area > self._best.contact.area:
            self._best = result

    def _add_point(self, point: Point) -> None:
        """Keep the frame with the largest contact of each point, so that no contact is lost."""
        if self.frames % self._frames_per_point == 0:
            self.points.append(point)
        elif point.area > self.points[-1].area:
            self.points[-1] = point
        if len(self.points) == 2 * MAX_POINTS:
            pairs = zip(self.points[::2], self.points[1::2], strict=True)
            self.points = [max(pair, key=lambda p: p.area) for pair in pairs]
            self._frames_per_point *= 2

    def _end_contact(self) -> None:
        """Keep a picture of the finished contact if it is among the largest."""
        if self._best is None:
            return
        result, self._best = self._best, None
        assert result.contact is not None
        area = float(result.contact.area)
        if len(self._pictures) == MAX_PICTURES and area <= self._pictures[-1].area:
            return
        new = _Picture(result.seq, result.t, area, _jpeg(result))
        self._pictures = sorted([*self._pictures, new], key=lambda p: -p.area)[:MAX_PICTURES]

    def preview(self) -> bytes:
        """JSON: `points`, (t, area, flow, angle) of each; `pictures`, (t, JPEG in Base64) of each."""
        self._end_contact()
        pictures = [(p.t, base64.b64encode(p.jpeg).decode()) for p in sorted(self._pictures)]
        return orjson.dumps({"points": [tuple(p) for p in self.points], "pictures": pictures})


def _jpeg(result: Result) -> bytes:
    """A small picture of the processed (or else the raw) frame with the results drawn on it."""
    image = result.frame.image if result.image is None else result.image
    annotate = Annotator(text=False)
    drawn = annotate(image, contact=result.contact, flow=result.flow, markers=result.markers)
    scale = min(1.0, PICTURE_SIDE / max(drawn.shape[:2]))
    small = cv2.resize(drawn, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return encode_jpeg(np.asarray(small, np.uint8), _QUALITY)
