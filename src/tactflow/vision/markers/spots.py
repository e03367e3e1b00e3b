"""Spots of the marks' size, anywhere in a frame, and which points lie near which others."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.arrays import Flags, Floats, Floats32
from tactflow.vision.markers.detection import Detection
from tactflow.vision.markers.scale_space import RADIUS_PER_SIGMA, blurred, shrunk

IntArray = NDArray[np.intp]

LARGEST_RADIUS: Final = 2.3
"""Radius of a mark, px, from which the frame is halved: less is needed to find it than to measure it. Chosen
by hand."""

LEAST_SIGMA: Final = 0.8
"""Width of the narrower Gaussian, px, at least: below it is no filter of its own. Chosen by hand."""

PEAK_REACH: Final = 0.7
"""Half the side of the square in which a peak is the highest, in radii of a mark. Chosen by hand."""

MARGIN: Final = 3.0
"""Frame around a searched window that is filtered too, in radii of a mark: the reach of the filter."""

CELL: Final = 0.12
"""Side of the cells in which nearness is judged, pitches. Chosen by hand."""


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

        image : (H, W, 3) uint8 BGR or (H, W) uint8. least : strength of a spot. low, high : (2,), corners of
        the window, px.
        Returns spots (M, 2) float64, px, and their strengths (M,) float64, 1 for a typical mark.
        """
        factor = self._factor
        left, top = (max(int((side - self._margin) // factor) * factor, 0) for side in low.tolist())
        right, bottom = (max(int(side + self._margin), 0) for side in high.tolist())
        image = image[top:bottom, left:right]
        if min(image.shape[:2]) < 3 * factor:
            return np.zeros((0, 2)), np.zeros(0)
        gray = image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
        points, value = find_peaks(self._response(gray), least * self._typical, self._reach)
        strength = np.asarray(value / self._typical, np.float64)
        return points * factor + ((factor - 1) / 2 + left, (factor - 1) / 2 + top), strength

    def _response(self, gray: NDArray[np.uint8]) -> Floats32:
        """Difference of Gaussians at low resolution, positive on marks."""
        narrow, wide = blurred(shrunk(gray, self._factor).astype(np.float32), self._sigma)
        return np.asarray(wide - narrow if self._dark else narrow - wide, np.float32)


def find_peaks(response: Floats32, least: float, reach: int) -> tuple[Floats, Floats32]:
    """Pixels above `least` that are the highest in a square of side 2 reach + 1.

    Returns (M, 2) float64, each the vertex of a parabola along each axis, at most half a pixel away, and the
    response (M,) float32.
    """
    highest = cv2.dilate(response, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8))
    peak = (response >= highest) & (response > np.float32(least))
    peak[[0, -1]] = False
    peak[:, [0, -1]] = False
    at = np.flatnonzero(peak)
    width = response.shape[1]
    rows, columns = np.divmod(at, width)
    flat = response.ravel()
    value = flat[at]
    points = np.empty((len(at), 2))
    for axis, (whole, step) in enumerate(((columns, 1), (rows, width))):
        before, after = flat[at - step], flat[at + step]
        bend = np.minimum(before + after - 2 * value, np.float32(-1e-6))
        offset = 0.5 * (before - after) / bend
        points[:, axis] = whole + np.minimum(np.maximum(offset, -0.5), 0.5)
    return points, value


class NearPoints:
    """Says which points have others near them, by a raster, so that the cost does not grow with the product
    of their numbers.

    shape : (height, width) of the frame, px. pitch : of the marks, px.
    """

    def __init__(self, shape: tuple[int, ...], pitch: float) -> None:
        self._pitch = pitch
        self._cell = CELL * pitch
        self._shape = tuple(int(side / self._cell) + 2 for side in shape)

    def disc(self, distance: float) -> NDArray[np.uint8]:
        """The cells within so many pitches of a cell."""
        size = 2 * round(distance * self._pitch / self._cell) + 1
        return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)), np.uint8)

    def near(self, points: Floats, others: Floats, disc: NDArray[np.uint8]) -> Flags:
        """(n,) bool, which points (n, 2) have one of the others (m, 2) in a disc, to a tenth of a pitch."""
        if len(points) == 0 or len(others) == 0:
            return np.zeros(len(points), bool)
        raster = np.zeros(self._shape, np.uint8)
        raster[self._cells(others)] = 1
        wide: NDArray[np.uint8] = np.asarray(cv2.dilate(raster, disc), np.uint8)
        return np.asarray(wide[self._cells(points)], np.bool_)

    def _cells(self, points: Floats) -> tuple[IntArray, IntArray]:
        """Row and column of the cells that points (n, 2) lie in; those outside count to the border."""
        limits = np.array(self._shape[::-1]) - 1
        column, row = np.clip((points * (1 / self._cell) + 0.5).astype(np.intp), 0, limits).T
        return row, column
