"""Where every mark of the reference frame is now."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.markers import Detection, to_gray
from tactflow.vision.types import Markers, MarkerStatus


class MarkerTracker:
    """Follows marks from frame to frame by their appearance in the reference.

    reference : (H, W, 3) uint8 BGR or (H, W) uint8, the untouched gel.
    detection : its marks.
    """

    def __init__(self, reference: NDArray[np.uint8], detection: Detection) -> None:
        self._reference = to_gray(reference)
        self._origin = detection.centers
        self._position = detection.centers.copy()
        self._pitch = detection.pitch
        self._window = 2 * int(np.ceil(1.6 * detection.dot_radius)) + 3
        edges = detection.edges
        self._first = np.concatenate([edges[:, 0], edges[:, 1]])
        self._second = np.concatenate([edges[:, 1], edges[:, 0]])

    def track(self, image: NDArray[np.uint8]) -> Markers:
        """Positions in one frame of the reference's size."""
        gray = to_gray(image)
        if gray.shape != self._reference.shape:
            raise ValueError(f"required a frame of shape {self._reference.shape}, got {gray.shape}")
        origin = self._origin
        found, status, _ = cv2.calcOpticalFlowPyrLK(
            self._reference,
            gray,
            origin.astype(np.float32).reshape(-1, 1, 2),
            self._position.astype(np.float32).reshape(-1, 1, 2),
            winSize=(self._window, self._window),
            maxLevel=1,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )
        position = found.reshape(-1, 2).astype(np.float64)
        displacement = position - origin
        count = len(origin)
        neighbours = np.bincount(self._first, minlength=count)
        mean = np.column_stack(
            [np.bincount(self._first, displacement[self._second, axis], count) for axis in (0, 1)]
        ) / np.maximum(neighbours, 1)[:, None]
        deviation = np.hypot(*(displacement - mean).T)
        bad = (status.ravel() == 0) | ((deviation > 0.4 * self._pitch) & (neighbours > 1))
        position[bad] = (origin + mean)[bad]
        self._position = position
        states = np.where(bad, MarkerStatus.INFERRED, MarkerStatus.TRACKED).astype(np.uint8)
        return Markers(origin.copy(), position.copy(), states, np.full(count, np.nan))
