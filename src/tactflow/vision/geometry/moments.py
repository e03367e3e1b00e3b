"""Region properties of a mask: bounding box, moments, convex hull and contours."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.compiled import helper, kernel

Ends = NDArray[np.int32]


class Box(NamedTuple):
    """A bounding box, px: its first column and row, its width and height; all 0 for an empty region."""

    left: int
    top: int
    width: int
    height: int


class Moments(NamedTuple):
    """Sums over the pixels of a region, relative to some pixel; whole numbers, so exact.

    pixels : how many. x, y : sums of the coordinates, px. xx, xy, yy : sums of their products, px^2.
    """

    pixels: int
    x: int
    y: int
    xx: int
    xy: int
    yy: int

    def central(self) -> tuple[int, int, int]:
        """Second central moments xx, xy, yy times the number of pixels; exact."""
        count, x, y, xx, xy, yy = self
        return count * xx - x * x, count * xy - x * y, count * yy - y * y


class RegionProperties:
    """Properties of all regions of a mask together, measured once for the stages that need them.

    mask : (H, W) uint8, not 0 inside: a frame's, or a window of it.
    corner : (x, y) of the window's first pixel in the frame, px.
    contours : where they are known.

    box : around all that is set, px of the frame. moments : relative to the corner of the box.
    connected : True for a region (8-connected) of which each row is one run of pixels; False where it takes
        the contours to tell.

    Examples
    --------
    >>> mask = np.zeros((20, 20), np.uint8)
    >>> mask[5:7, 5:8] = 255
    >>> region = RegionProperties(mask)
    >>> region.box, region.moments.pixels, region.connected
    (Box(left=5, top=5, width=3, height=2), 6, True)
    >>> polygon, area = region.hull()
    >>> polygon.tolist(), area
    ([[7.0, 5.0], [7.0, 6.0], [5.0, 6.0], [5.0, 5.0]], 6.0)
    >>> [len(contour) for contour in region.contours]
    [6]
    """

    def __init__(
        self,
        mask: NDArray[np.uint8],
        corner: tuple[int, int] = (0, 0),
        contours: Sequence[NDArray[Any]] | None = None,
    ) -> None:
        self.mask, self.corner = mask, corner
        self._ends = np.empty((len(mask), 2), np.int32)
        left, top, width, height, *sums, connected = measure_region(np.ascontiguousarray(mask), self._ends)
        self.box = Box(left + corner[0], top + corner[1], width, height)
        self.moments = Moments(*sums)
        self.connected = connected == 1
        self._contours = contours if self.moments.pixels else ()

    @classmethod
    def of(cls, mask: NDArray[np.uint8], known: RegionProperties | None = None) -> RegionProperties:
        """Measure a mask, unless what is known is of this very mask."""
        return known if known is not None and known.mask is mask else cls(mask)

    @property
    def contours(self) -> Sequence[NDArray[Any]]:
        """Of each region that around its outside, (n, 1, 2) int32, every pixel of it, px of the frame."""
        if self._contours is None:
            left, top, width, height = self.box
            x, y = left - self.corner[0], top - self.corner[1]
            window = self.mask[y : y + height, x : x + width]
            found = cv2.findContours(window, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE, offset=(left, top))
            self._contours = found[0]
        return self._contours

    def hull(self) -> tuple[NDArray[np.float64], float]:
        """Convex hull of all that is set: (n, 2), px of the frame, and how many pixels lie in or on it.

        Its corners are listed clockwise as seen on the screen, of the first row the left one last. The mask
        is not empty.
        """
        corners = np.empty((2 * self.box.height + 2, 2))
        count, pixels = wrap_rows(self._ends, *self.corner, corners)
        return (corners[1:count] if count > 1 else corners[:1]), pixels


@kernel("UniTuple(int64, 11)(uint8[:, ::1], int32[:, ::1])")
def measure_region(mask: NDArray[np.uint8], ends: Ends) -> tuple[int, ...]:
    """Bounding box of the pixels that are set, their moments, and where the rows begin and end.

    Returns the box; the moments relative to its corner, as `Box` and `Moments` list them; 1 if each row of
    the box is one run of pixels that touches that of the row above, else 0. All 0 where no pixel is set.

    mask : (H, W) uint8, H and W >= 1. ends : (H, 2), filled: first and last column of the pixels of each row;
    W and -1 in a row without any.
    """
    height, width = mask.shape
    left, right, top, bottom = width, -1, -1, -1
    connected = True
    count = sx = sy = sxx = sxy = syy = np.int64(0)
    for y in range(height):
        row = mask[y]
        ends[y, 0], ends[y, 1] = width, -1
        if not _any(row):
            continue
        # A run is sought from where the row above begins and ends.
        first = _begin_of_run(row, ends[bottom, 0] if bottom >= 0 else 0)
        last = _end_of_run(row, max(first, ends[bottom, 1] if bottom >= 0 else 0))
        if _all(row[first : last + 1]) and not (_any(row[:first]) or _any(row[last + 1 :])):
            number = last + 1 - first
            more = number * (number - 1)
            ones = number * first + more // 2
            twos = number * first * first + more * first + more * (2 * number - 1) // 6
            touching = bottom == y - 1 and ends[bottom, 0] <= last + 1 and first <= ends[bottom, 1] + 1
            connected = connected and (top < 0 or touching)
        else:
            number = ones = twos = 0
            for x in range(width):
                number += 1 if row[x] != 0 else 0
                ones += x if row[x] != 0 else 0
                twos += x * x if row[x] != 0 else 0
            first, last = 0, width - 1
            while row[first] == 0:
                first += 1
            while row[last] == 0:
                last -= 1
            connected = False
        top, bottom = y if top < 0 else top, y
        left, right = min(left, first), max(right, last)
        ends[y, 0], ends[y, 1] = first, last
        count, sx, sxx = count + number, sx + ones, sxx + twos
        sy, sxy, syy = sy + number * y, sxy + ones * y, syy + number * y * y
    if count == 0:
        left, top, connected = 0, 0, False
    pixels, along, down = int(count), int(sx - left * count), int(sy - top * count)
    xx = sxx - 2 * left * sx + left * left * count
    xy = sxy - left * sy - top * sx + left * top * count
    yy = int(syy - 2 * top * sy + top * top * count)
    width, height = right + 1 - left, bottom + 1 - top
    return left, top, width, height, pixels, along, down, xx, xy, yy, 1 if connected else 0


@helper
def _any(row: NDArray[np.uint8]) -> bool:
    """Whether a pixel is set."""
    some = np.uint8(0)
    for x in range(row.size):
        some = np.uint8(some | row[x])
    return bool(some != 0)


@helper
def _all(row: NDArray[np.uint8]) -> bool:
    """Whether all pixels are set."""
    least = np.uint8(255)
    for x in range(row.size):
        least = min(least, row[x])
    return bool(least != 0)


@helper
def _begin_of_run(row: NDArray[np.uint8], near: int) -> int:
    """Where a run of pixels begins that is at `near` or to the right, or else to the left; there is one."""
    x = near
    while x < row.size and row[x] == 0:
        x += 1
    if x == row.size:
        x = near
        while row[x] == 0:
            x -= 1
    while x > 0 and row[x - 1] != 0:
        x -= 1
    return x


@helper
def _end_of_run(row: NDArray[np.uint8], near: int) -> int:
    """Where a run of pixels ends that is at `near` or to the left; there is one."""
    x = near
    while row[x] == 0:
        x -= 1
    while x + 1 < row.size and row[x + 1] != 0:
        x += 1
    return x


@kernel("Tuple((int64, float64))(int32[:, ::1], int64, int64, float64[:, ::1])")
def wrap_rows(ends: Ends, left: int, above: int, corners: NDArray[np.float64]) -> tuple[int, float]:
    """Corners of the convex hull of some rows of pixels; how many, and how many pixels lie in or on it.

    ends : (H, 2), of `measure_region`; not all rows are empty. left, above : added to columns and rows, px.
    corners : (at least twice the rows in use and 2, 2), its beginning filled: x and y, clockwise on the
    screen, first and last the left one of the first row.
    """
    top, bottom = 0, len(ends) - 1
    while ends[top, 1] < 0:
        top += 1
    while ends[bottom, 1] < 0:
        bottom -= 1
    rows = bottom + 1 - top
    count = start = 0
    # From the first row's left end down along the right ends, then up along the left ones.
    for step in range(2 * rows + 1):
        down = 0 < step <= rows
        row = top + (step - 1 if down else (2 * rows - step) % rows)
        if ends[row, 1] < 0:
            continue
        start = count - 1 if step == rows + 1 else start
        x, y = float(ends[row, 1 if down else 0] + left), float(row + above)
        if count > 0 and corners[count - 1, 0] == x and corners[count - 1, 1] == y:
            continue
        # No corners are those at which the way does not turn right.
        while count - start >= 2:
            across, along = corners[count - 1, 0], corners[count - 1, 1]
            if (across - corners[count - 2, 0]) * (y - along) > (along - corners[count - 2, 1]) * (
                x - across
            ):
                break
            count -= 1
        corners[count, 0], corners[count, 1] = x, y
        count += 1
    # Pick's theorem: twice the area, and the pixels on the border.
    twice = on_border = 0.0
    for k in range(1, count):
        x, y = corners[k - 1, 0], corners[k - 1, 1]
        twice += x * corners[k, 1] - corners[k, 0] * y
        on_border += math.gcd(int(corners[k, 0] - x), int(corners[k, 1] - y))
    return count, (abs(twice) + on_border) / 2 + 1
