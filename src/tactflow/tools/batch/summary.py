"""What the table and the page show of one recording: numbers, and pictures of its largest contacts."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from tactflow.drawing.jpeg import encode_jpeg
from tactflow.drawing.results import Annotator
from tactflow.message.result import Result

MAX_PICTURES = 4
"""Pictures per recording: they fit next to each other."""
TRACE_LABELS = {"area": "area, px²", "flow": "flow, px", "force": "force, N"}
"""What is drawn over time for each recording: name -> label."""
TRACE_POINTS = 150
"""Points of such a curve, at least, in a long recording; twice as many at most."""
PICTURE_SIDE_PX = 240
"""Longer side of a picture, px."""
PAPER_GREY = 45
"""Grey level of the picture on which results without one are drawn."""
_JPEG_QUALITY = 70
"""JPEG quality of a picture, 1 to 100: about 7 kB. Chosen by hand."""


class Picture(NamedTuple):
    """A contact at its largest.

    Attributes
    ----------
    t : s.
    area : px^2.
    """

    t: float
    area: float
    jpeg: bytes


class Trace:
    """A few quantities of a run, thinned out evenly so that they stay few.

    Attributes
    ----------
    values : name of `TRACE_LABELS` -> a number or None for each kept frame; "t" -> its time, s.
    """

    def __init__(self) -> None:
        self.values: dict[str, list[float | None]] = {name: [] for name in ("t", *TRACE_LABELS)}
        self._stride, self._seen = 1, 0

    def add(self, result: Result) -> None:
        """Add one frame."""
        self._seen += 1
        if (self._seen - 1) % self._stride:
            return
        contact, flow, force = result.contact, result.flow, result.force
        mean = None if flow is None else flow.mean
        row = {
            "t": result.t,
            "area": None if contact is None else float(contact.area),
            "flow": None if mean is None else float(np.hypot(*mean)),
            "force": None if force is None else force.value[2],
        }
        for name, value in row.items():
            self.values[name].append(value)
        if len(self.values["t"]) > 2 * TRACE_POINTS:
            self.values = {name: values[::2] for name, values in self.values.items()}
            self._stride *= 2


class Summary:
    """Collects the frames of a run in bounded memory."""

    def __init__(self) -> None:
        self.trace = Trace()
        self.contacts = self.touching = 0
        self.largest = self.duration = 0.0
        self._pictures: list[Picture] = []
        self._best: Result | None = None

    def add(self, result: Result) -> None:
        """Add one frame."""
        contact = result.contact
        self.trace.add(result)
        self.duration = result.t
        if contact is None:
            self._end_contact()
            return
        self.touching += 1
        self.contacts += self._best is None
        self.largest = max(self.largest, float(contact.area))
        if self._best is None or _rank(result) > _rank(self._best):
            self._best = result

    def _end_contact(self) -> None:
        """Keep a picture of the finished contact if it is among the largest."""
        if self._best is None:
            return
        result, self._best = self._best, None
        assert result.contact is not None
        area = float(result.contact.area)
        if len(self._pictures) == MAX_PICTURES and area <= self._pictures[-1].area:
            return
        pictures = [*self._pictures, Picture(result.t, area, _jpeg(result))]
        self._pictures = sorted(pictures, key=lambda picture: -picture.area)[:MAX_PICTURES]

    def pictures(self) -> list[Picture]:
        """The largest contacts, in order of time."""
        self._end_contact()
        return sorted(self._pictures)


def _rank(result: Result) -> tuple[bool, float]:
    """Results with a picture first, then those with a large contact."""
    pictured = result.image is not None or result.frame.image.size > 0
    return pictured, 0.0 if result.contact is None else float(result.contact.area)


def _jpeg(result: Result) -> bytes:
    """A small picture of the processed (or else the raw) frame with the results drawn on it.

    Results without a picture are drawn on a uniform one.
    """
    image = result.frame.image if result.image is None else result.image
    if not image.size:
        width, height = result.size
        image = np.full((max(1, height), max(1, width), 3), PAPER_GREY, np.uint8)
    annotate = Annotator(text=False)
    drawn = annotate(image, contact=result.contact, flow=result.flow, markers=result.markers)
    scale = min(1.0, PICTURE_SIDE_PX / max(drawn.shape[:2]))
    small = cv2.resize(drawn, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return encode_jpeg(np.asarray(small, np.uint8), _JPEG_QUALITY)
