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
from tactflow.vision.flow.loops import sample_region, sum_markers, sum_region, weigh_markers
from tactflow.vision.markers.family import pitch_of
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
"""Cells of a region from which on every other one, along each axis, stands for its neighbours: such a region
is five pitches wide or more, and the field varies over one and a half. Chosen by hand."""
OUTLINE: Final = 4.0
"""How uncertain a contact's outline is: the square of its error times the length over which it errs alike,
px^3; 0.5 px over 16 px. Measured on 22 simulated recordings, by what it does to the mean."""
FEWEST: Final = 3
"""Markers that must be seen for a field. Chosen by hand."""
OVERSHOOT: Final = 0.5
"""How much farther gel may have moved than any marker that is seen, pitches. Chosen by hand."""
POOR: Final = 3.0
"""Times the median standard error from which on a marker's own error has its weight. Chosen by hand."""
_TRACKED: Final = int(MarkerStatus.TRACKED)
_POOR: Final = 1
"""Doubt of a marker that is seen, but poorly; see `weigh_markers`."""


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
        self.grid = _grid(size, self.pitch)
        spacing = self.grid.spacing
        sides = [2 * round((step * spacing - 1) / 2) + 1 for step in (1, 2)]
        self.place = np.array([*self.grid.first, spacing, OVERSHOOT * self.pitch + spacing, *sides])
        """(6,), see `sample_region`."""
        self._length = LENGTH * self.pitch
        kernel = self._kernel(self.origin)
        self.inverse: FloatArray = np.asarray(
            np.linalg.inv(kernel + NUGGET * np.eye(len(origin))), np.float64
        )
        self.precision = 0.5 / np.diagonal(self.inverse)
        """(N,): 1 over twice the variance of each marker given all others, relative to the field's."""
        self.rest = np.ascontiguousarray(self.origin.T)
        """(2, N), x and y of each marker in the reference, px."""
        rows, columns = self.grid.shape
        self.to_markers = self._kernel(self.grid.points.reshape(-1, 2)).reshape(rows, columns, -1)
        """(rows, columns, N), the kernel between cells and markers."""
        down, across = np.mgrid[:rows, 1 - columns : columns] * self.grid.spacing
        between = matern(np.hypot(down, across) / self._length)
        self.between = {1: between, 2: np.ascontiguousarray(between[::2, (columns - 1) % 2 :: 2])}
        """Kernel between two cells, by how many rows and columns they are apart, 0 columns in the middle: of
        all cells, and of every other row and column."""

    def _kernel(self, points: FloatArray) -> FloatArray:
        """(M, N), the kernel between points (M, 2), px, and the markers."""
        offset = points[:, None] - self.origin
        return matern(np.sqrt(np.einsum("mnk,mnk->mn", offset, offset)) / self._length)

    @cached_property
    def weights(self) -> FloatArray:
        """(cells, N): how much each marker counts in each cell where all are seen."""
        return self.to_markers.reshape(-1, len(self.origin)) @ self.inverse

    def __call__(self, markers: Markers) -> DisplacementField | None:
        """The field of one frame; None where fewer than three markers are seen.

        Raises ValueError if there are not as many markers as in the reference.
        """
        if markers.position.shape != self.origin.shape:
            raise ValueError(f"required {len(self.origin)} markers, got {len(markers.position)}")
        seen = markers.status == _TRACKED
        if np.count_nonzero(seen) < FEWEST:
            return None
        return DisplacementField(self, markers, seen)


class _Update(NamedTuple):
    """What the inverse of a kernel matrix loses where less is known of S markers: rows.T @ lost, (S, N)."""

    rows: FloatArray
    lost: FloatArray

    def taken(self, vectors: FloatArray) -> FloatArray:
        """What vectors (m, N) lose in their products with the inverse, (m, N)."""
        return np.asarray(vectors @ self.rows.T @ self.lost)


class DisplacementField:
    """The displacement of the gel everywhere, in one frame. What is not asked for is not computed.

    Coordinates are those of the gel at rest: `displacement[row, column]` is how far the bit of gel has moved
    that was at `grid.points[row, column]` in the reference frame.

    model : of the reference. markers : of the frame. seen : (N,) bool, those that were seen, three or more.

    grid : where the field is told. noise : median standard error of a marker, px; 0 where none is known.
    """

    def __init__(self, model: FieldModel, markers: Markers, seen: NDArray[np.bool_]) -> None:
        self.grid = model.grid
        self._model, self._seen = model, seen
        stderr = np.ascontiguousarray(markers.stderr, np.float64)
        ordered = np.sort(stderr[seen & np.isfinite(stderr)])
        self.noise = float(ordered[len(ordered) // 2]) if len(ordered) else 0.0
        position = np.ascontiguousarray(markers.position, np.float64)
        # x and y apart: sums along contiguous rows. What is not seen counts as unmoved until it is left out.
        self._moved, self._coefficients = np.empty((2, len(seen))), np.empty((2, len(seen)))
        self._variance, doubt = np.empty(len(seen)), np.empty(len(seen), np.uint8)
        doubtful = weigh_markers(
            position,
            model.rest,
            seen,
            stderr,
            self.noise,
            POOR * self.noise,
            model.inverse,
            self._moved,
            self._variance,
            doubt,
            self._coefficients,
        )
        self._update: _Update | None = None
        if doubtful:
            left_out = np.flatnonzero(doubt)
            self._leave_out(left_out, doubt[left_out] == _POOR)

    def _leave_out(self, left_out: IntArray, poor: NDArray[np.bool_]) -> None:
        """Take markers (S,) out of the field, those that are `poor` (S,) only as far as their errors ask."""
        rows = self._model.inverse[left_out]
        own, theirs = rows[:, left_out], self._coefficients[:, left_out]
        # Of few markers; a third of the time of NumPy's, nothing of which is in the caches.
        _, middle = cv2.invert(own)
        sure = len(self._seen) - len(left_out)
        if sure and poor.any():
            # The variance of the field without all of them is what their own is to be compared with.
            left = np.vdot(self._moved, self._coefficients) - np.vdot(theirs, theirs @ middle)
            certainty = np.where(poor, left / (2 * sure) / self._variance[left_out], 0.0)
            _, middle = cv2.invert(own + np.diag(certainty))
        self._update = _Update(rows, np.asarray(middle, np.float64) @ rows)
        self._coefficients = self._coefficients - theirs @ self._update.lost

    @cached_property
    def displacement(self) -> FloatArray:
        """(rows, columns, 2) float64, px."""
        return np.asarray(self._model.to_markers @ self._coefficients.T)

    @cached_property
    def stderr(self) -> FloatArray:
        """(rows, columns) float64, standard error of each component of `displacement`, px."""
        kernel = self._model.to_markers.reshape(-1, len(self._seen))
        weights = self._model.weights
        if self._update is not None:
            weights = weights - self._update.taken(kernel)
        unknown = np.maximum(1 - np.einsum("gn,gn->g", weights, kernel), 0)
        squares = self._scale(kernel) * unknown + (weights * weights) @ self._variance
        return np.asarray(np.sqrt(squares).reshape(self.grid.shape))

    def motion(self, mask: NDArray[np.uint8], box: Sequence[int] | None = None) -> GelMotion | None:
        """How the gel inside a region has moved, each bit of it counted by its area at rest.

        mask : (H, W) uint8, 0 or 255 inside, in the current frame: what counts is where the gel is now.
        box : (left, top, width, height) of the region, px, where it is known.
        Returns None for a region without a cell. Raises ValueError if mask is not (H, W) uint8.
        """
        check_mask(mask, 0)
        cells = self._cells(mask, box or cv2.boundingRect(mask), MANY * self.grid.spacing**2)
        if cells is None:
            return None
        model, step = self._model, int(cells.window[2])
        spacing = step * self.grid.spacing
        sums, weights = np.zeros(26), np.empty((3, cells.inside.size))
        kernel, counts = np.zeros((2, 3, len(model.origin)))
        between = model.between[step]
        sum_region(
            cells.inside, cells.moved, model.to_markers, cells.window, spacing, between, sums, weights, kernel
        )
        numbers = sums.tolist()
        if numbers[0] == 0:
            return None
        update = self._update or _Update(model.inverse[:0], model.inverse[:0])
        sum_markers(
            kernel,
            model.inverse,
            *update,
            self._coefficients,
            self._precision,
            self._variance,
            counts,
            sums,
        )
        return _motion(sums.tolist(), spacing)

    def part(self, mask: NDArray[np.uint8]) -> Part | None:
        """The cells of the gel that are in a region now, (H, W) uint8; None where there are none."""
        check_mask(mask, 0)
        cells = self._cells(mask, cv2.boundingRect(mask), math.inf)
        total = 0.0 if cells is None else float(cells.inside.sum())
        if cells is None or total == 0:
            return None
        top, left, _, rows, columns = cells.window.tolist()
        return Part(cells.inside.reshape(rows, columns), total, (top, left))

    def _cells(self, mask: NDArray[np.uint8], box: Sequence[int], many: float) -> _Cells | None:
        """The cells around a region; of a region in a box of `many` px^2 every other one."""
        left, top, width, height = box
        if width == 0:
            return None
        model, (rows, columns) = self._model, self.grid.shape
        window = np.empty(5, np.int64)
        inside, moved = np.empty(rows * columns), np.empty((rows * columns, 2))
        sample_region(
            np.asarray(cv2.integral(mask[top : top + height, left : left + width]), np.int32),
            left,
            top,
            model.place,
            many,
            self._moved,
            model.to_markers,
            self._coefficients,
            window,
            inside,
            moved,
        )
        count = int(window[3] * window[4])
        return _Cells(window, inside[:count], moved[:count]) if count else None

    @cached_property
    def _precision(self) -> FloatArray:
        """(N,), see `sum_markers`."""
        if self._update is None:
            return self._model.precision
        rows, lost = self._update
        left = 0.5 / self._model.precision - (rows * lost).sum(axis=0)
        return np.asarray(np.where(self._seen, 0.5 / np.maximum(left, NUGGET), 0.0))

    def _scale(self, kernel: FloatArray) -> FloatArray:
        """(M,) px^2: variance of the field near places whose kernels with the markers are (M, N)."""
        squares = (self._coefficients * self._coefficients).sum(axis=0) * self._precision
        return np.asarray(kernel @ squares / np.maximum(kernel @ self._seen, 1e-12))


class Part(NamedTuple):
    """A part of the gel: the cells of a window of the grid, so many rows and columns of them.

    inside : (rows, columns), how much of each cell belongs to the part, 0 to 1. cells : their sum.
    begin : row and column of the grid where the window begins.
    """

    inside: FloatArray
    cells: float
    begin: tuple[int, int]


class _Cells(NamedTuple):
    """Cells around a region: window, inside and moved as `sample_region` fills them."""

    window: NDArray[np.int64]
    inside: FloatArray
    moved: FloatArray


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


def _inverse(
    xx: float, xy: float, yy: float, spacing: float
) -> tuple[tuple[float, float], tuple[float, float]] | None:
    """The inverse of a part's second moments, px^-2; None for a part too small to have slopes.

    spacing : of its cells, px: a single one has the second moment spacing^2 / 12 along each axis.
    """
    determinant = xx * yy - xy * xy
    if determinant <= (xx + yy) * spacing * spacing / 12:
        return None
    return (yy / determinant, -xy / determinant), (-xy / determinant, xx / determinant)


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
    outline = math.sqrt(unit * at_x), math.sqrt(unit * at_y)
    gradient = residual = None
    inverse = _inverse(xx, xy, yy, spacing)
    if inverse is not None:
        dx, dy = ((p * xu + q * yu, p * xv + q * yv) for p, q in inverse)
        unknown = [scale * max(_square(prior, at) - _square(told, at), 0.0) for at in inverse]
        errors = [math.sqrt(part + _square(noise, at)) for part, at in zip(unknown, inverse, strict=True)]
        gradient = Gradient(dx, dy, *errors)
        spread, turn = gradient.growth
        rest = squares - 2 * (spread * (xu + yv) + turn * (xv - yu)) + (spread**2 + turn**2) * (xx + yy)
        residual = math.sqrt(max(rest, 0.0))
    stderr = math.sqrt(scale * left + noise[0])
    return GelMotion((u, v), stderr, outline, math.sqrt(squares / 2), gradient, residual, left / prior[0])


def _square(form: list[float], at: tuple[float, float]) -> float:
    """The square of a vector by a form, of which the last three numbers are xx, xy and yy."""
    x, y = at
    return x * x * form[1] + 2 * x * y * form[2] + y * y * form[3]
