"""Spots of the marks' size, anywhere in a frame."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.arrays import Floats, Floats32
from tactflow.vision.markers.detection import Detection
from tactflow.vision.markers.scale_space import RADIUS_PER_SIGMA, blurred, find_peaks, shrunk

LARGEST_RADIUS: Final = 2.3
"""Radius of a mark, px, from which the frame is halved: less is needed to find it than to measure it. Chosen
by hand."""

LEAST_SIGMA: Final = 0.8
"""Width of the narrower Gaussian, px, at least: below it is no filter of its own. Chosen by hand."""

PEAK_REACH: Final = 0.7
"""Half the side of the square in which a peak is the highest, in radii of a mark. Chosen by hand."""

MARGIN: Final = 3.0
"""Frame around a searched window that is filtered too, in radii of a mark: the reach of the filter."""


class SpotFinder:
    """Finds spots of the marks' size: peaks of a difference of Gaussians at low resolution.

    reference : (H, W) uint8, grey levels of the untouched gel. detection : its marks.

    References
    ----------
    Lowe, "Distinctive image features from scale-invariant keypoints", IJCV 60 (2004).
    """

    def __init__(self, reference: NDArray[np.uint8], detection: Detection) -> None:
        self._factor = 1
        while detection.dot_radius / self._factor >= LARGEST_RADIUS:
            self._factor *= 2
        radius = detection.dot_radius / self._factor
        self._sigma = max(radius / RADIUS_PER_SIGMA, LEAST_SIGMA)
        self._dark = detection.polarity == "dark"
        self._reach = max(1, round(PEAK_REACH * radius))
        self._margin = MARGIN * detection.dot_radius + 2 * self._factor
        response = self._response(reference)
        shrunk = (detection.centers - (self._factor - 1) / 2) / self._factor
        limits = np.array([response.shape[1] - 1, response.shape[0] - 1])
        column, row = np.clip(np.rint(shrunk).astype(np.int64), 0, limits).T
        self._typical = max(float(np.median(response[row, column])), 1.0)

    def find(
        self, image: NDArray[np.uint8], least: float, low: Floats, high: Floats
    ) -> tuple[Floats, Floats]:
        """Spots between two corners.

        image : (H, W, 3) uint8 BGR or (H, W) uint8. least : strength of a spot, 1 for a
        typical mark. low, high : (2,), corners of the window, px.
        Returns spots (M, 2) float64, px, and their strengths (M,) float64.
        """
        factor = self._factor
        left, top = (max(int((side - self._margin) // factor) * factor, 0) for side in low.tolist())
        right, bottom = (max(int(side + self._margin), 0) for side in high.tolist())
        image = image[top:bottom, left:right]
        if min(image.shape[:2]) < 3 * factor:
            return np.zeros((0, 2)), np.zeros(0)
        gray = image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
        points, strength = find_peaks(self._response(gray), least * self._typical, self._reach)
        return points * factor + ((factor - 1) / 2 + left, (factor - 1) / 2 + top), strength / self._typical

    def _response(self, gray: NDArray[np.uint8]) -> Floats32:
        """Difference of Gaussians at low resolution, positive on marks."""
        narrow, wide = blurred(shrunk(gray, self._factor).astype(np.float32), self._sigma)
        return np.asarray(wide - narrow if self._dark else narrow - wide, np.float32)
