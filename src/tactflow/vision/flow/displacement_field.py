"""The displacement field of the gel between its markers, and how the gel inside a contact moves as a whole.

Both displacement components are taken for independent Gaussian processes over the gel at rest (kriging), with
a Matern kernel of order 5/2. Markers of one reference have one kernel matrix, so that it is inverted once; a
frame then costs matrix products. Everything that is asked of the field is linear in the displacements of the
markers, so that each answer has a standard error in closed form.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.flow.inside import check_mask
from tactflow.vision.flow.loops import (
    COEFFICIENTS,
    PRECISION,
    SHARE,
    VARIANCE,
    sample_region,
    sum_markers,
    sum_region,
    weigh_markers,
)
from tactflow.vision.markers.lattice import pitch_of
from tactflow.vision.types import Markers, MarkerStatus

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]

LENGTH: Final = 1.5
"""Correlation length of the field, pitches. Kernel and length are those that predict the markers of nine real
recordings best, each marker from all others (leave-one-out likelihood); on four other recordings the best
length is 1.4 (docs/flow.md)."""
NUGGET: Final = 1e-5
"""Variance added to each marker's, relative to the field's: it keeps the matrix well conditioned. Markers
known to 0.015 px in a field of 5 px have as much. Chosen by hand."""
CELL: Final = 0.25
"""Spacing of the grid, pitches. Chosen by hand."""
MOST_CELLS: Final = 2500
"""Cells of a grid at most; where a quarter of the pitch would make more, the spacing is larger. Chosen by
hand."""
MANY: Final = 400
"""Cells of a region's bounding box from which on a grid with twice the spacing will do: such a region is five
pitches wide or more, and the field varies over one and a half. Chosen by hand."""
OUTLINE: Final = 4.0
"""How uncertain a contact's outline is: the square of its error times the length over which it errs alike,
px^3; 0.5 px over 16 px. Measured on 22 simulated recordings, by what it does to the mean."""
BLOCK: Final = 32
"""Points whose kernel with all markers is computed at once, so that what is computed in between stays in the
caches. Chosen by time, of 16 to 128."""
FEWEST: Final = 3
"""Markers that must be seen for a field. Chosen by hand."""
OVERSHOOT: Final = 0.5
"""How much farther gel may have moved than any marker that is seen, pitches. Chosen by hand."""
POOR: Final = 3.0
"""Times the median standard error from which on a marker's own error has its weight. Chosen by hand."""
_TRACKED: Final = int(MarkerStatus.TRACKED)


class Grid(NamedTuple):
    """A regular grid over the frame: (rows, columns) of cells, the centre of the first, the spacing, px."""

    shape: tuple[int, int]
    first: tuple[float, float]
    spacing: float

    @property
    def points(self) -> FloatArray:
        """(rows, columns, 2) float64: x and y of every cell's centre, px."""
        rows, columns = self.shape
        x = self.first[0] + self.spacing * np.arange(columns)
        y = self.first[1] + self.spacing * np.arange(rows)
        return np.stack(np.meshgrid(x, y), axis=-1)

    def coarser(self) -> Grid:
        """Every other row and column, from the first on. It may reach half a cell less far."""
        rows, columns = self.shape
        return Grid(((rows + 1) // 2, (columns + 1) // 2), self.first, 2 * self.spacing)


class Samples(NamedTuple):
    """A grid of cells over which the field is summed.

    place : (5,) float64, see `sample_region`. to_markers : (rows, columns, N) float64, the kernel between
        cells and markers.
    between : (rows, 2 columns - 1) float64, the kernel between two cells, by how many rows and columns they
        are apart, 0 columns in the middle.
    """

    grid: Grid
    place: FloatArray
    to_markers: FloatArray
    between: FloatArray


class Gradient(NamedTuple):
    """How a part of the gel is turned, pressed apart and sheared: its displacement gradient.

    dx, dy : (du/dx, dv/dx) and (du/dy, dv/dy), 1: what x and y at rest change the displacement (u, v) by.
    dx_stderr, dy_stderr : of each of their components, 1.
    """

    dx: tuple[float, float]
    dy: tuple[float, float]
    dx_stderr: float
    dy_stderr: float

    @property
    def growth(self) -> tuple[float, float]:
        """The nearest similarity as a complex number, less 1: (spread, turn from +x to +y)."""
        return (self.dx[0] + self.dy[1]) / 2, (self.dx[1] - self.dy[0]) / 2

    @property
    def shear(self) -> tuple[float, float]:
        """What no turn and no spread explains: (du/dx - dv/dy, du/dy + dv/dx), 1."""
        return self.dx[0] - self.dy[1], self.dy[0] + self.dx[1]

    @property
    def stderr(self) -> float:
        """Standard error of each part of `growth`, and half of that of each part of `shear`."""
        return math.hypot(self.dx_stderr, self.dy_stderr) / 2


class GelMotion(NamedTuple):
    """How a part of the gel has moved as a whole.

    mean : (dx, dy), px: the integral of the displacement over the part, over its area at rest.
    stderr : of each component of the mean, px, for a region whose outline is exact.
    outline_stderr : what the outline of a contact adds to that, (dx, dy), px.
    spread : RMS by which each component of the displacement differs from the mean within the part, px.
    gradient : of the affine motion that is nearest to the displacement; None for a part too small to tell.
    residual : RMS of what mean, turn and spread leave, px; None where gradient is None.
    unknown : share of what the mean could be that the markers leave open, 0 to 1: how far they are away.
    """

    mean: tuple[float, float]
    stderr: float
    outline_stderr: tuple[float, float]
    spread: float
    gradient: Gradient | None
    residual: float | None
    unknown: float


class FieldModel:
    """Displacement fields of one reference.

    Parameters
    ----------
    origin : (N, 2) float64, markers in the reference, px.
    size : (width, height) of the frame, px.

    Raises
    ------
    ValueError : origin is not (N, 2) with N >= 3, or size is not positive.

    Notes
    -----
    With K the kernel between markers, Q = (K + nugget)^-1 and z the displacements, the field at X is
    k(X) Q z. A marker that is not seen is left out by Schur's complement instead of another inversion: Q is
    replaced by Q - Q_S (Q_SS)^-1 Q_S', which is the same as putting the marker where the others expect it.
    One that is seen poorly has its variance added in the same way (Woodbury).

    The kernel says how the field varies from place to place relative to its own variance s^2. That is
    estimated where it is asked for: markers near by are each predicted from all others, and s^2 makes the
    errors of these predictions as large as they should be (Rasmussen and Williams, "Gaussian Processes for
    Machine Learning", 2006, eq. 5.12: one inverse gives all leave-one-out errors).

    Examples
    --------
    >>> x, y = np.meshgrid(np.arange(20.0, 300, 40), np.arange(20.0, 400, 40))
    >>> origin = np.column_stack([x.ravel(), y.ravel()])
    >>> status, stderr = np.zeros(len(origin), np.uint8), np.full(len(origin), 0.02)
    >>> field = FieldModel(origin, (300, 400))(Markers(origin, origin + [2.0, -1.0], status, stderr))
    >>> mask = np.zeros((400, 300), np.uint8)
    >>> mask[150:220, 100:180] = 255
    >>> [round(value, 2) for value in field.motion(mask).mean]
    [2.0, -1.0]
    """

    def __init__(self, origin: FloatArray, size: tuple[int, int]) -> None:
        if origin.ndim != 2 or origin.shape[1] != 2 or len(origin) < FEWEST:
            raise ValueError(f"required an origin of shape (N, 2) with N >= {FEWEST}, got {origin.shape}")
        if min(size) < 1:
            raise ValueError(f"required a size of at least 1 x 1 px, got {size}")
        self.origin = np.array(origin, np.float64)
        self.pitch = max(pitch_of(self.origin), 1.0)
        self._length = LENGTH * self.pitch
        kernel = self._kernel(self.origin)
        self.inverse: FloatArray = np.asarray(
            np.linalg.inv(kernel + NUGGET * np.eye(len(origin))), np.float64
        )
        self.rest = np.ascontiguousarray(self.origin.T)
        """(2, N), x and y of each marker in the reference, px."""
        grid = _grid(size, self.pitch)
        self._margin = OVERSHOOT * self.pitch + grid.spacing
        self.fine, self.coarse = self._samples(grid), self._samples(grid.coarser())
        """For small and for large regions. Both are fixed to the frame, so that what is told of a region does
        not depend on where its bounding box begins."""

    def _samples(self, grid: Grid) -> Samples:
        """What the loops need to know of a grid."""
        (rows, columns), spacing = grid.shape, grid.spacing
        side = 2 * round((spacing - 1) / 2) + 1
        place = np.array([*grid.first, spacing, self._margin, side])
        to_markers = self._kernel(grid.points.reshape(-1, 2)).reshape(rows, columns, -1)
        down, across = np.mgrid[:rows, 1 - columns : columns] * spacing
        return Samples(grid, place, to_markers, matern(np.hypot(down, across) / self._length))

    def _kernel(self, points: FloatArray) -> FloatArray:
        """(M, N), the kernel between points (M, 2), px, and the markers."""
        kernel = np.empty((len(points), len(self.origin)))
        for first in range(0, len(points), BLOCK):
            x, y = points[first : first + BLOCK].T[:, :, None] - self.origin.T[:, None]
            kernel[first : first + BLOCK] = matern(np.sqrt(x * x + y * y) / self._length)
        return kernel

    @cached_property
    def weights(self) -> FloatArray:
        """(cells, N): how much each marker counts in each cell where all are seen."""
        return self.fine.to_markers.reshape(-1, len(self.origin)) @ self.inverse

    def __call__(self, markers: Markers) -> DisplacementField | None:
        """The field of one frame; None where fewer than three markers are seen.

        Raises ValueError if there are not as many markers as in the reference.
        """
        if markers.position.shape != self.origin.shape:
            raise ValueError(f"required {len(self.origin)} markers, got {len(markers.position)}")
        seen = markers.status == _TRACKED
        errors = np.asarray(markers.stderr, np.float64)[seen]
        if len(errors) < FEWEST:
            return None
        errors.sort()
        # What is unknown, infinite or NaN, comes last.
        known = len(errors) if math.isfinite(errors[-1]) else int(errors.searchsorted(np.inf))
        return DisplacementField(self, markers, seen, float(errors[known // 2]) if known else 0.0)


class DisplacementField:
    """The displacement of the gel everywhere, in one frame. What is not asked for is not computed.

    Coordinates are those of the gel at rest: `displacement[row, column]` is how far the bit of gel has moved
    that was at `grid.points[row, column]` in the reference frame.

    model : of the reference. markers : of the frame. seen : (N,) bool, those that were seen, three or more.
    noise : median standard error of a marker, px; 0 where none is known.

    grid : where the field is told.
    """

    def __init__(self, model: FieldModel, markers: Markers, seen: NDArray[np.bool_], noise: float) -> None:
        self.grid, self.noise = model.fine.grid, noise
        self._model, self._seen = model, seen
        position = np.ascontiguousarray(markers.position, np.float64)
        stderr = np.ascontiguousarray(markers.stderr, np.float64)
        self._planes = np.empty((6, len(seen)))
        removed = np.empty_like(model.inverse)
        count = weigh_markers(
            position, model.rest, seen, stderr, noise, POOR * noise, model.inverse, self._planes, removed
        )
        self._removed = removed[:count].copy()

    @cached_property
    def displacement(self) -> FloatArray:
        """(rows, columns, 2) float64, px."""
        return np.asarray(self._model.fine.to_markers @ self._planes[COEFFICIENTS].T)

    @cached_property
    def stderr(self) -> FloatArray:
        """(rows, columns) float64, standard error of each component of `displacement`, px."""
        kernel = self._model.fine.to_markers.reshape(-1, len(self._seen))
        weights = self._model.weights - kernel @ self._removed.T @ self._removed
        unknown = np.maximum(1 - np.einsum("gn,gn->g", weights, kernel), 0)
        squares = self._scale(kernel) * unknown + (weights * weights) @ self._planes[VARIANCE]
        return np.asarray(np.sqrt(squares).reshape(self.grid.shape))

    def motion(self, mask: NDArray[np.uint8], box: Sequence[int] | None = None) -> GelMotion | None:
        """How the gel inside a region has moved, each bit of it counted by its area at rest.

        mask : (H, W) uint8, 255 inside, else 0, in the current frame: what counts is where the gel is now.
        box : (left, top, width, height) of the region, px, where it is known.
        Returns None for a region without a cell. Raises ValueError if mask is not (H, W) uint8.
        """
        check_mask(mask, 0)
        box = box or cv2.boundingRect(mask)
        model, many = self._model, MANY * self.grid.spacing**2
        samples = model.fine if box[2] * box[3] < many else model.coarse
        window, cells = self._cells(mask, box, samples)
        spacing = samples.grid.spacing
        # Between region and markers, and how much each marker counts.
        kernel, counts = np.zeros((3, len(model.origin))), np.empty((3, len(model.origin)))
        sums = np.zeros(26)
        sum_region(cells, samples.to_markers, window, spacing, samples.between, sums, kernel)
        sum_markers(kernel, model.inverse, self._removed, self._planes, counts, sums)
        numbers = sums.tolist()
        return _motion(numbers, spacing) if numbers[0] > 0 else None

    def part(self, mask: NDArray[np.uint8]) -> Part | None:
        """The cells of the gel that are in a region now, (H, W) uint8, 255 inside; None if there are none."""
        check_mask(mask, 0)
        window, cells = self._cells(mask, cv2.boundingRect(mask), self._model.fine)
        top, left, rows, columns = window.tolist()
        inside = cells[SHARE, : rows * columns]
        total = float(inside.sum())
        return Part(inside.reshape(rows, columns), total, (top, left)) if total > 0 else None

    def _cells(
        self, mask: NDArray[np.uint8], box: Sequence[int], samples: Samples
    ) -> tuple[NDArray[np.int64], FloatArray]:
        """The cells around a region that lies in a box, px: window and cells of `sample_region`."""
        left, top, width, height = box
        place, to_markers = samples.place, samples.to_markers
        window, cells = np.empty(4, np.int64), np.empty((6, math.prod(samples.grid.shape)))
        covered = np.asarray(cv2.integral(mask[top : top + height, left : left + width]), np.int32)
        sample_region(covered, left, top, place, self._planes, to_markers, window, cells)
        return window, cells

    def _scale(self, kernel: FloatArray) -> FloatArray:
        """(M,) px^2: variance of the field near places whose kernels with the markers are (M, N)."""
        squares = (self._planes[COEFFICIENTS] ** 2).sum(axis=0) * self._planes[PRECISION]
        return np.asarray(kernel @ squares / np.maximum(kernel @ self._seen, 1e-12))


class Part(NamedTuple):
    """A part of the gel: the cells of a window of the grid, so many rows and columns of them.

    inside : (rows, columns), how much of each cell belongs to the part, 0 to 1. cells : their sum.
    begin : row and column of the grid where the window begins.
    """

    inside: FloatArray
    cells: float
    begin: tuple[int, int]


def matern(distance: FloatArray) -> FloatArray:
    """The Matern kernel of order 5/2 of distances in correlation lengths: 1 at 0.

    >>> float(matern(np.array(0.0)))
    1.0
    """
    scaled = math.sqrt(5) * distance
    return np.asarray((1 + scaled + scaled * scaled / 3) * np.exp(-scaled))


def _grid(size: tuple[int, int], pitch: float) -> Grid:
    """A grid in the middle of a frame of (width, height), px."""
    width, height = size
    spacing = max(CELL * pitch, math.sqrt(width * height / MOST_CELLS))
    columns, rows = math.ceil(width / spacing), math.ceil(height / spacing)
    first = (width - 1 - spacing * (columns - 1)) / 2, (height - 1 - spacing * (rows - 1)) / 2
    return Grid((rows, columns), first, spacing)


def _motion(sums: list[float], spacing: float) -> GelMotion:
    """The motion of a region from sums over its cells, and over the markers, see `loops`.

    spacing : of the cells, px.
    """
    cells, u, v, xx, xy, yy, xu, xv, yu, yv, squares, at_x, at_y = sums[:13]
    prior, scale, told, noise = sums[13:17], sums[17], sums[18:22], sums[22:]
    left = max(prior[0] - told[0], 0.0)
    # An outline that is d too far out at s adds (m(s) - mean) d ds / area. Across it, the share of a cell
    # falls from 1 to 0 within its width: share (1 - share) is 1 / 6 for a whole side.
    unit = OUTLINE * 6 * spacing / (cells * spacing * spacing) ** 2
    # Where no cell is at the outline, rounding leaves 0 or less.
    outline = math.sqrt(max(unit * at_x, 0.0)), math.sqrt(max(unit * at_y, 0.0))
    stderr, spread = math.sqrt(scale * left + noise[0]), math.sqrt(squares / 2)
    determinant = xx * yy - xy * xy
    # A single cell has the second moment spacing^2 / 12 along each axis: too small to have slopes.
    if determinant <= (xx + yy) * spacing * spacing / 12:
        return GelMotion((u, v), stderr, outline, spread, None, None, left / prior[0])
    x, y, z = yy / determinant, -xy / determinant, xx / determinant
    unknown = [left, prior[1] - told[1], prior[2] - told[2], prior[3] - told[3]]
    dx_stderr = math.sqrt(scale * max(_square(unknown, x, y), 0.0) + _square(noise, x, y))
    dy_stderr = math.sqrt(scale * max(_square(unknown, y, z), 0.0) + _square(noise, y, z))
    dx, dy = (x * xu + y * yu, x * xv + y * yv), (y * xu + z * yu, y * xv + z * yv)
    gradient = Gradient(dx, dy, dx_stderr, dy_stderr)
    growth, turn = gradient.growth
    rest = squares - 2 * (growth * (xu + yv) + turn * (xv - yu)) + (growth**2 + turn**2) * (xx + yy)
    residual = math.sqrt(max(rest, 0.0))
    return GelMotion((u, v), stderr, outline, spread, gradient, residual, left / prior[0])


def _square(form: list[float], x: float, y: float) -> float:
    """The square of a vector by a form, of which the last three numbers are xx, xy and yy."""
    return x * x * form[1] + 2 * x * y * form[2] + y * y * form[3]
