"""The displacement field of the gel between its markers, and how the gel inside a contact moves as a whole.

Both displacement components are taken for independent Gaussian processes over the gel at rest (kriging), with
a Matern kernel of order 5/2. Markers of one reference have one kernel matrix, so that it is inverted once; a
frame then costs matrix products. Everything that is asked of the field is linear in the displacements of the
markers, so that each answer has a standard error in closed form.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property, lru_cache
from typing import Final, NamedTuple

import cv2
import numpy as np

from tactflow.vision.arrays import Flags, Floats, Mask, Points, check_mask
from tactflow.vision.flow.loops import COEFFICIENTS, PRECISION, VARIANCE, sum_region, weigh_markers
from tactflow.vision.markers.lattice import pitch_of
from tactflow.vision.types import Markers, MarkerStatus

LENGTH: Final = 1.5
"""Correlation length of the field, pitches. Kernel and length are those that predict the markers of nine real
recordings best, each marker from all others (leave-one-out likelihood); on four other recordings the best
length is 1.4."""
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
OUTLINE: Final = 1 / 3
"""Standard error of a contact's outline, over the radius of a disc of the same area. Gel that a wrong outline
includes or leaves out moves otherwise than the contact. On labelled frames of nine labs, 71 % of the
components of the mean lie within one standard error of those inside outlines by eye, and 94 % within two
(`benchmarks/mean_flow.py`)."""
FEWEST: Final = 3
"""Markers that must be seen for a field. Chosen by hand."""
OVERSHOOT: Final = 0.5
"""How much farther gel may have moved than any marker that is seen, pitches. Chosen by hand."""
POOR: Final = 3.0
"""Times the median standard error from which on a marker's own error has its weight. Chosen by hand."""
_TRACKED: Final = int(MarkerStatus.TRACKED)
SIDE: Final = 4
"""Of `Samples.place`: the side of the square that counts around a cell, px."""


class Grid(NamedTuple):
    """A regular grid over the frame: (rows, columns) of cells, the centre of the first, the spacing, px."""

    shape: tuple[int, int]
    first: tuple[float, float]
    spacing: float

    @property
    @lru_cache(maxsize=8)  # noqa: B019
    def points(self) -> Floats:
        """(rows, columns, 2) float64: x and y of every cell's centre, px. Not to be changed."""
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

    place : (5,) float64, see `sum_region`. to_markers : (rows, columns, N) float64,
    the kernel between cells and markers. between : (2 rows - 1, 2 columns - 1) float64, the kernel between
    two cells, by how many rows and columns they are apart; 0 in the middle."""

    grid: Grid
    place: Floats
    to_markers: Floats
    between: Floats


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

    def __init__(self, origin: Points, size: tuple[int, int]) -> None:
        if origin.ndim != 2 or origin.shape[1] != 2 or len(origin) < FEWEST:
            raise ValueError(f"required an origin of shape (N, 2) with N >= {FEWEST}, got {origin.shape}")
        if min(size) < 1:
            raise ValueError(f"required a size of at least 1 x 1 px, got {size}")
        self.origin: Points = np.array(origin, np.float64)
        self.pitch = max(pitch_of(self.origin), 1.0)
        self.rest: Floats = np.ascontiguousarray(self.origin.T)
        """(2, N), x and y of each marker in the reference, px."""
        self._length = LENGTH * self.pitch
        kernel = self._kernel(self.origin)
        self.inverse: Floats = np.asarray(np.linalg.inv(kernel + NUGGET * np.eye(len(origin))), np.float64)
        grid = _grid(size, self.pitch)
        self._margin = OVERSHOOT * self.pitch + grid.spacing
        self.fine, self.coarse = self._samples(grid), self._samples(grid.coarser())
        """For small and for large regions. Both are fixed to the frame, so that what is said of a region does
        not depend on where its bounding box begins."""

    def _samples(self, grid: Grid) -> Samples:
        rows, columns = grid.shape
        to_markers = self._kernel(grid.points.reshape(-1, 2)).reshape(rows, columns, -1)
        down, across = np.mgrid[1 - rows : rows, 1 - columns : columns] * grid.spacing
        side = 2 * round((grid.spacing - 1) / 2) + 1
        place = np.array([*grid.first, grid.spacing, self._margin, side])
        return Samples(grid, place, to_markers, matern(np.hypot(down, across) / self._length))

    def _kernel(self, points: Points) -> Floats:
        """(M, N), the kernel between points (M, 2), px, and the markers."""
        x, y = points.T[:, :, None] - self.origin.T[:, None]
        return matern(np.sqrt(x * x + y * y) / self._length)

    def __call__(self, markers: Markers) -> DisplacementField | None:
        """The field of one frame; None where fewer than three markers are seen.

        Raises ValueError if there are not as many markers as in the reference.
        """
        if markers.position.shape != self.origin.shape:
            raise ValueError(f"required {len(self.origin)} markers, got {len(markers.position)}")
        seen = markers.status == _TRACKED
        return DisplacementField(self, markers, seen) if np.count_nonzero(seen) >= FEWEST else None


class DisplacementField:
    """The displacement of the gel everywhere, in one frame. What is not asked for is not computed.

    Coordinates are those of the gel at rest: `displacement[row, column]` is how far the bit of gel has moved
    that was at `grid.points[row, column]` in the reference frame.

    model : of the reference. markers : of the frame. seen : (N,) bool, those that were seen, three or more.

    grid : where the field is known. noise : median standard error of a marker, px; 0 where none is known.
    """

    def __init__(self, model: FieldModel, markers: Markers, seen: Flags) -> None:
        self.grid = model.fine.grid
        self._asked: tuple[Mask, GelMotion | None] | None = None
        self._shared: tuple[Mask, Floats] | None = None
        self._model, self._seen = model, seen
        position = np.ascontiguousarray(markers.position, np.float64)
        stderr = np.ascontiguousarray(markers.stderr, np.float64)
        errors = np.sort(stderr[seen])
        # What is unknown, infinite or NaN, comes last.
        known = len(errors) if math.isfinite(errors[-1]) else int(errors.searchsorted(np.inf))
        self.noise = float(errors[known // 2]) if known else 0.0
        self._planes, removed = np.empty((6, len(seen))), np.empty_like(model.inverse)
        largest = POOR * self.noise
        count = weigh_markers(
            position, model.rest, seen, stderr, self.noise, largest, model.inverse, self._planes, removed
        )
        self._removed: Floats = removed[:count].copy()
        """(S, N): the inverse is less by their squares, removed.T @ removed."""

    @cached_property
    def displacement(self) -> Floats:
        """(rows, columns, 2) float64, px."""
        return np.asarray(self._model.fine.to_markers @ self._planes[COEFFICIENTS].T)

    @cached_property
    def stderr(self) -> Floats:
        """(rows, columns) float64, standard error of each component of `displacement`, px."""
        kernel = self._model.fine.to_markers.reshape(-1, len(self._seen))
        weights = kernel @ self._model.inverse - kernel @ self._removed.T @ self._removed
        unknown = np.maximum(1 - np.einsum("gn,gn->g", weights, kernel), 0)
        variances = (self._planes[COEFFICIENTS] ** 2).sum(axis=0) * self._planes[PRECISION]
        scale = kernel @ variances / np.maximum(kernel @ self._seen, 1e-12)
        squares = scale * unknown + (weights * weights) @ self._planes[VARIANCE]
        return np.asarray(np.sqrt(squares).reshape(self.grid.shape))

    def at(self, rest: Points) -> Floats:
        """(M, 2) float64, px: displacement of the gel that rests at points (M, 2), px; beyond the grid, that
        at its border."""
        places = ((rest - self.grid.first) / self.grid.spacing).astype(np.float32)
        x, y = np.ascontiguousarray(places.T[:, :, None])
        moved = cv2.remap(self.displacement, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(moved[:, 0], np.float64)

    def share(self, mask: Mask) -> Floats:
        """(rows, columns), how much of the gel of each cell is in a region now, 0 to 1. Not to be changed.

        mask : (H, W) uint8, 255 inside, else 0. Raises ValueError if it is not.
        """
        if self._shared is None or self._shared[0] is not mask:
            self._shared = mask, self._share(mask)
        return self._shared[1]

    def _share(self, mask: Mask) -> Floats:
        check_mask(mask)
        side = int(self._model.fine.place[SIDE])
        left, top, width, height = cv2.boundingRect(mask)
        left, top = max(left - side, 0), max(top - side, 0)
        part = mask[top : top + height + 2 * side, left : left + width + 2 * side]
        covered = cv2.blur(part, (side, side), borderType=cv2.BORDER_CONSTANT)
        now = (self.grid.points + self.displacement - (left, top)).astype(np.float32)
        shares = cv2.remap(covered, now, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)  # type: ignore[call-overload]
        return np.asarray(shares, np.float64) / 255

    def motion(self, mask: Mask) -> GelMotion | None:
        """How the gel inside a region has moved, each bit of it counted by its area at rest.

        mask : (H, W) uint8, 255 inside, else 0, in the current frame: what counts is where the gel is now.
        Returns None for a region without a cell. Raises ValueError if mask is not (H, W) uint8.
        """
        if self._asked is None or self._asked[0] is not mask:
            self._asked = mask, self._summed(mask)
        return self._asked[1]

    def _summed(self, mask: Mask) -> GelMotion | None:
        check_mask(mask)
        box = cv2.boundingRect(mask)
        large = box[2] * box[3] >= MANY * self.grid.spacing**2
        samples = self._model.coarse if large else self._model.fine
        sums = self._sums(mask, box, samples)
        return _motion(sums.tolist(), samples.grid.spacing) if sums[0] > 0 else None

    def _sums(self, mask: Mask, box: Sequence[int], samples: Samples) -> Floats:
        """Sums over a region in a box, see `sum_region`."""
        left, top, width, height = box
        sums = np.zeros(27)
        covered = np.asarray(cv2.integral(mask[top : top + height, left : left + width]), np.int32)
        model = self._model
        sum_region(
            covered,
            left,
            top,
            samples.place,
            self._planes,
            samples.to_markers,
            samples.between,
            model.inverse,
            self._removed,
            sums,
        )
        return sums


def matern(distance: Floats) -> Floats:
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
    """The motion of a region. sums : of `sum_region`. spacing : of the cells, px."""
    _, u, v, xx, xy, yy, xu, xv, yu, yv, squares, outwards_x, outwards_y, partial = sums[:14]
    prior, scale, known, noise = sums[14:18], sums[18], sums[19:23], sums[23:]
    left = max(prior[0] - known[0], 0.0)
    # A region that is larger by a small part adds as much of its mean slope outwards, times the way from its
    # middle, to the mean (Gauss's theorem). Where all cells are whole, the picture has none of its outline.
    larger = OUTLINE if partial > 1e-9 else 0.0
    outline = larger * abs(outwards_x), larger * abs(outwards_y)
    stderr, spread = math.sqrt(scale * left + noise[0]), math.sqrt(squares / 2)
    determinant = xx * yy - xy * xy
    # A single cell has the second moment spacing^2 / 12 along each axis: too small to have slopes.
    if determinant <= (xx + yy) * spacing * spacing / 12:
        return GelMotion((u, v), stderr, outline, spread, None, None, left / prior[0])
    x, y, z = yy / determinant, -xy / determinant, xx / determinant
    unknown = [before - after for before, after in zip(prior[1:], known[1:], strict=True)]
    dx_stderr = math.sqrt(scale * max(_square(unknown, x, y), 0.0) + _square(noise[1:], x, y))
    dy_stderr = math.sqrt(scale * max(_square(unknown, y, z), 0.0) + _square(noise[1:], y, z))
    dx, dy = (x * xu + y * yu, x * xv + y * yv), (y * xu + z * yu, y * xv + z * yv)
    gradient = Gradient(dx, dy, dx_stderr, dy_stderr)
    growth, turn = gradient.growth
    rest = squares - 2 * (growth * (xu + yv) + turn * (xv - yu)) + (growth**2 + turn**2) * (xx + yy)
    return GelMotion((u, v), stderr, outline, spread, gradient, math.sqrt(max(rest, 0.0)), left / prior[0])


def _square(form: Sequence[float], x: float, y: float) -> float:
    """The square of a vector by a symmetric form (xx, xy, yy)."""
    return x * x * form[0] + 2 * x * y * form[1] + y * y * form[2]
