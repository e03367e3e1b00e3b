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

from tactflow.vision.arrays import Flags, Floats, Indices, Mask, Points, check_mask
from tactflow.vision.flow.gel_motion import GelMotion, RegionSums, Uncertainty, share_cells, sum_pairs
from tactflow.vision.markers.lattice import pitch_of
from tactflow.vision.types import Markers, MarkerStatus

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
FEWEST: Final = 3
"""Markers that must be seen for a field. Chosen by hand."""
OVERSHOOT: Final = 0.5
"""How much farther gel may have moved than any marker that is seen, pitches. Chosen by hand."""
POOR: Final = 3.0
"""Times the median standard error from which on a marker's own error has its weight. Chosen by hand."""
_LEAST: Final = 1e-5
"""Precision of a marker given all others, 1, at least: one that no other is near. Chosen by hand."""
_NOWHERE: Final = 1e-12
"""Sum of the kernel between a place and all markers, at least, to divide by. Chosen by hand."""
_TRACKED: Final = int(MarkerStatus.TRACKED)


class Grid(NamedTuple):
    """A regular grid over the frame: (rows, columns) of cells, the centre of the first, the spacing, px."""

    shape: tuple[int, int]
    first: tuple[float, float]
    spacing: float

    @property
    def points(self) -> Floats:
        """(rows, columns, 2) float64: x and y of every cell's centre, px."""
        rows, columns = self.shape
        x = self.first[0] + self.spacing * np.arange(columns)
        y = self.first[1] + self.spacing * np.arange(rows)
        return np.stack(np.meshgrid(x, y), axis=-1)

    def range(self, axis: int, least: float, most: float) -> slice:
        """Columns (axis 0) or rows (1) from one coordinate to another, px, and one more on each side."""
        begin, end = ((edge - self.first[axis]) / self.spacing for edge in (least, most))
        count = self.shape[1 - axis]
        return slice(min(max(int(begin), 0), count), min(max(int(end + 2), 0), count))

    def coarser(self) -> Grid:
        """Every other row and column, from the first on. It may reach half a cell less far."""
        rows, columns = self.shape
        return Grid(((rows + 1) // 2, (columns + 1) // 2), self.first, 2 * self.spacing)


class Samples(NamedTuple):
    """A grid of cells over which the field is summed.

    points : (rows, columns, 2) float64, x and y of every cell's centre, px.
    to_markers : (rows, columns, N) float64, the kernel between cells and markers.
    between : (2 rows - 1, 2 columns - 1) float64, the kernel between two cells, by how many rows and columns
    they are apart; 0 in the middle.
    """

    grid: Grid
    points: Floats
    to_markers: Floats
    between: Floats


class Cells(NamedTuple):
    """The cells whose gel may be in a region now, a rectangle of a grid.

    part : rows and columns of the grid. share : (r, c) float64, how much of each is in the region, 0 to 1.
    displacement : (r, c, 2) float64, px.
    """

    part: tuple[slice, slice]
    share: Floats
    displacement: Floats


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
        self._length = LENGTH * self.pitch
        kernel = self._kernel(self.origin)
        self.inverse: Floats = np.asarray(np.linalg.inv(kernel + NUGGET * np.eye(len(origin))), np.float64)
        grid = _grid(size, self.pitch)
        self.fine, self.coarse = self._samples(grid), self._samples(grid.coarser())
        """For small and for large regions. Both are fixed to the frame, so that what is said of a region does
        not depend on where its bounding box begins."""

    def _samples(self, grid: Grid) -> Samples:
        points, (rows, columns) = grid.points, grid.shape
        to_markers = self._kernel(points.reshape(-1, 2)).reshape(rows, columns, -1)
        down, across = np.mgrid[1 - rows : rows, 1 - columns : columns] * grid.spacing
        return Samples(grid, points, to_markers, matern(np.hypot(down, across) / self._length))

    def _kernel(self, points: Points) -> Floats:
        """(M, N), the kernel between points (M, 2), px, and the markers."""
        x, y = points.T[:, :, None] - self.origin.T[:, None]
        return matern(np.sqrt(x * x + y * y) / self._length)

    @cached_property
    def weights(self) -> Floats:
        """(cells, N): how much each marker counts in each cell where all are seen."""
        return self.fine.to_markers.reshape(-1, len(self.origin)) @ self.inverse

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
        self._model, self._seen = model, seen
        errors = np.sort(markers.stderr[seen])
        # What is unknown, infinite or NaN, comes last.
        known = int(np.isfinite(errors).sum())
        self.noise = float(errors[known // 2]) if known else 0.0
        self._moved: Floats = np.where(seen[:, None], markers.position - model.origin, 0.0)
        stderr = np.where(seen & np.isfinite(markers.stderr), markers.stderr, self.noise)
        self._variance: Floats = stderr * stderr
        self._coefficients: Floats = model.inverse @ self._moved
        precision, count = np.diag(model.inverse), len(seen)
        energy = float((self._coefficients * self._moved).sum())
        self._removed: Floats = np.zeros((0, count))
        """(S, N): the inverse is less by their squares, removed.T @ removed."""
        out = np.flatnonzero(~seen | (stderr > POOR * self.noise))
        if len(out):
            rows, poor = model.inverse[out], seen[out]
            # First without all that are left out, for the variance of the field to compare errors with.
            removed = _factors(rows, out, np.zeros(len(out)))
            if poor.any():
                left = energy - float(((removed @ self._moved) ** 2).sum())
                scale = left / (2 * (count - len(out))) if len(out) < count else 0.0
                removed = _factors(rows, out, np.where(poor, scale / self._variance[out], 0.0))
            self._removed = removed
            self._coefficients = self._coefficients - removed.T @ (removed @ self._moved)
            precision = precision - (removed * removed).sum(axis=0)
        self._precision: Floats = np.where(seen, 0.5 / np.maximum(precision, _LEAST), 0.0)
        """(N,): 1 over twice the precision of each marker given all others, relative; 0 where unseen."""

    @cached_property
    def displacement(self) -> Floats:
        """(rows, columns, 2) float64, px."""
        return np.asarray(self._model.fine.to_markers @ self._coefficients)

    @cached_property
    def _variances(self) -> Floats:
        """(N,): twice the field's variance near each marker, by its error when predicted from the others."""
        return np.asarray((self._coefficients**2).sum(axis=1) * self._precision)

    @cached_property
    def stderr(self) -> Floats:
        """(rows, columns) float64, standard error of each component of `displacement`, px."""
        kernel = self._model.fine.to_markers.reshape(-1, len(self._seen))
        weights = self._model.weights - kernel @ self._removed.T @ self._removed
        unknown = np.maximum(1 - np.einsum("gn,gn->g", weights, kernel), 0)
        scale = kernel @ self._variances / np.maximum(kernel @ self._seen, _NOWHERE)
        squares = scale * unknown + (weights * weights) @ self._variance
        return np.asarray(np.sqrt(squares).reshape(self.grid.shape))

    def share(self, mask: Mask) -> Floats:
        """(rows, columns), how much of the gel of each cell is in a region now, 0 to 1.

        mask : (H, W) uint8, 255 inside, else 0. Raises ValueError if it is not.
        """
        check_mask(mask)
        shares, cells = np.zeros(self.grid.shape), self._cells(mask, cv2.boundingRect(mask), self._model.fine)
        shares[cells.part] = cells.share
        return shares

    def motion(self, mask: Mask) -> GelMotion | None:
        """How the gel inside a region has moved, each bit of it counted by its area at rest.

        mask : (H, W) uint8, 255 inside, else 0, in the current frame: what counts is where the gel is now.
        Returns None for a region without a cell. Raises ValueError if mask is not (H, W) uint8.
        """
        check_mask(mask)
        box = cv2.boundingRect(mask)
        large = box[2] * box[3] >= MANY * self.grid.spacing**2
        samples = self._model.coarse if large else self._model.fine
        cells = self._cells(mask, box, samples)
        if not cells.share.any():
            return None
        region = RegionSums(cells.share, samples.points[cells.part], cells.displacement, samples.grid.spacing)
        return region.motion(self._uncertainty(region.basis, cells.part, samples))

    def _cells(self, mask: Mask, box: Sequence[int], samples: Samples) -> Cells:
        """The cells of a grid whose gel may be in a region. box : left, top, width and height of that, px."""
        left, top, width, height = box
        grid, moved = samples.grid, np.ascontiguousarray(self._moved.T)
        (least_x, least_y), (most_x, most_y) = moved.min(axis=1).tolist(), moved.max(axis=1).tolist()
        margin = OVERSHOOT * self._model.pitch + self.grid.spacing
        part = (
            grid.range(1, top - most_y - margin, top + height - least_y + margin),
            grid.range(0, left - most_x - margin, left + width - least_x + margin),
        )
        displacement = samples.to_markers[part] @ self._coefficients
        places = samples.points[part] + displacement - (left, top)
        covered = np.asarray(cv2.integral(mask[top : top + height, left : left + width]), np.int32)
        share = np.empty(places.shape[:2])
        share_cells(covered, places, 2 * round((grid.spacing - 1) / 2) + 1, share)
        return Cells(part, share, displacement)

    def _uncertainty(self, basis: Floats, part: tuple[slice, slice], samples: Samples) -> Uncertainty:
        """How well sums over cells are known. basis : (3, r, c), weights of three such sums."""
        to_region = (basis.transpose(1, 0, 2) @ samples.to_markers[part]).sum(axis=0)
        weights = to_region @ self._model.inverse - (to_region @ self._removed.T) @ self._removed
        prior = np.zeros((3, 3))
        sum_pairs(basis, samples.between, prior)
        field_variance = to_region[0] @ self._variances / max(to_region[0] @ self._seen, _NOWHERE)
        unseen = prior - weights @ to_region.T
        noise = (weights * self._variance) @ weights.T
        return Uncertainty(max(unseen[0, 0], 0.0) / prior[0, 0], field_variance * unseen, noise)


def _factors(rows: Floats, columns: Indices, more: Floats) -> Floats:
    """(S, N): F with F.T @ F = rows.T @ C^-1 @ rows, where C is some columns of `rows`, (S, N), and `more`,
    (S,), on its diagonal."""
    return np.asarray(np.linalg.solve(np.linalg.cholesky(rows[:, columns] + np.diag(more)), rows))


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
