"""Follow the marks of a reference frame as points: by any optical flow, or by the nearest detections.

These are the usual ways, for comparison with `MarkerTracker`: each mark is followed on its own, and nothing
tells one from its neighbour.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from tactflow.vision.arrays import Flags, Floats, Floats32
from tactflow.vision.types import Markers, MarkerStatus

PointFlow = Callable[[NDArray[np.uint8], NDArray[np.uint8], Floats32, Floats32], tuple[Floats32, Flags]]
"""Takes two pictures, points (N, 2) float32 in the first, px, and starting points (N, 2) for the search in
the second; returns their positions (N, 2) there, and which of them were found (N,)."""

MIN_CORRELATION: Final = 0.5
"""Least normalised correlation of a point's surroundings with those in the reference: halfway between
chance and equality. A smooth flow returns to its origin on a blank picture, too, where nothing is there."""


class FlowTracker:
    """Follows points of a reference frame by an optical flow, with a forward-backward check.

    Each frame is compared with the reference, so positions do not drift; the last displacement is where the
    search starts. A point is lost where the flow does not find it, where it leaves the picture, where the
    flow back to the reference ends farther than `max_error` from where it began, and where its surroundings
    do not look like those in the reference. A lost point stays at its last known position and is searched
    for from there.

    Parameters
    ----------
    reference : (H, W) uint8, grey levels.
    origin : (N, 2) float64, points in it, px.
    radius : of the marks, px, > 0; surroundings are twice as wide.
    flow : the optical flow.
    max_error : px, > 0; larger values accept more, and more that is wrong.

    References
    ----------
    Z. Kalal, K. Mikolajczyk, J. Matas, "Forward-backward error: automatic detection of tracking failures",
    ICPR 2010.

    Examples
    --------
    >>> gel = np.full((40, 60), 200, np.uint8)
    >>> gel[8:13, 8:13] = gel[28:33, 48:53] = 20
    >>> still = lambda before, after, points, start: (points, np.full(len(points), True))
    >>> tracker = FlowTracker(gel, np.array([[10.0, 10.0], [50.0, 30.0]]), 3.0, still, 1.0)
    >>> gel[20:] = 200
    >>> tracker.track(gel.copy()).status.tolist()
    [0, 2]
    """

    def __init__(
        self, reference: NDArray[np.uint8], origin: Floats, radius: float, flow: PointFlow, max_error: float
    ) -> None:
        self._reference, self._flow, self._max_error = reference.copy(), flow, max_error
        self._origin = np.array(origin, np.float64)
        self._position = self._origin.copy()
        axis = np.arange(-math.ceil(2 * radius), math.ceil(2 * radius) + 1, dtype=np.float32)
        self._window = np.stack(np.meshgrid(axis, axis), axis=2).reshape(1, -1, 2)
        self._patches = self._surroundings(self._reference, self._origin.astype(np.float32))

    def track(self, image: NDArray[np.uint8]) -> Markers:
        """Follow the points to one frame; standard errors are unknown, NaN.

        image : (H, W) uint8. Raises ValueError if it is of another size than the reference.
        """
        if image.shape != self._reference.shape:
            raise ValueError(f"required a frame of shape {self._reference.shape}, got {image.shape}")
        origin, last = self._origin.astype(np.float32), self._position.astype(np.float32)
        position, found = self._flow(self._reference, image, origin, last)
        limits = np.array(image.shape[1::-1]) - 1
        # A comparison with NaN is false: what has no finite position is lost.
        seen = found & ((position >= 0) & (position <= limits)).all(axis=1)
        position = np.where(seen[:, None], position, last)
        back, returned = self._flow(image, self._reference, position, position - (last - origin))
        seen &= returned & (np.linalg.norm(back - origin, axis=1) <= self._max_error)
        likeness = (self._surroundings(image, position) * self._patches).sum(axis=1)
        seen &= likeness >= MIN_CORRELATION
        self._position = np.where(seen[:, None], position, self._position).astype(np.float64)
        return _markers(self._origin, self._position, seen)

    def _surroundings(self, image: NDArray[np.uint8], points: Floats32) -> Floats32:
        """Grey levels around points (N, 2), each row without its mean and of unit length; 0 if constant."""
        places = points[:, None] + self._window
        x, y = np.ascontiguousarray(places[..., 0]), np.ascontiguousarray(places[..., 1])
        gray = image.astype(np.float32)
        patches = np.asarray(cv2.remap(gray, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
        patches = patches - patches.mean(axis=1, keepdims=True)
        length = np.linalg.norm(patches, axis=1, keepdims=True)
        return np.asarray(patches / np.where(length > 0, length, 1), np.float32)


class NearestTracker:
    """Links each mark of the reference frame to the detection nearest to its last position.

    A pair counts if each is the nearest to the other, no farther apart than `max_displacement`. A mark
    without a partner is lost, and keeps its last known position.

    Parameters
    ----------
    origin : (N, 2) float64, px.
    max_displacement : between two frames, px, > 0; beyond half the distance of neighbouring marks, the
        nearest detection may be the neighbour.

    Examples
    --------
    >>> tracker = NearestTracker(np.array([[10.0, 10.0], [30.0, 10.0]]), 8.0)
    >>> markers = tracker.link(np.array([[12.0, 11.0], [90.0, 90.0]]))
    >>> markers.position.tolist(), markers.status.tolist()
    ([[12.0, 11.0], [30.0, 10.0]], [0, 2])
    """

    def __init__(self, origin: Floats, max_displacement: float) -> None:
        self._origin, self._farthest = np.array(origin, np.float64), max_displacement
        self._position = self._origin.copy()

    def link(self, centers: Floats) -> Markers:
        """Link the detections (M, 2), px, of one frame; standard errors are unknown, NaN."""
        if not len(centers):
            return _markers(self._origin, self._position, np.zeros(len(self._origin), np.bool_))
        distance, nearest = KDTree(centers).query(self._position)
        partner = np.asarray(KDTree(self._position).query(centers)[1])
        mutual = partner[nearest] == np.arange(len(self._origin))
        seen = mutual & (distance <= self._farthest)
        self._position = np.where(seen[:, None], centers[nearest], self._position)
        return _markers(self._origin, self._position, seen)


def _markers(origin: Floats, position: Floats, seen: Flags) -> Markers:
    status = np.where(seen, MarkerStatus.TRACKED, MarkerStatus.LOST).astype(np.uint8)
    return Markers(origin.copy(), position.copy(), status, np.full(len(origin), np.nan))
