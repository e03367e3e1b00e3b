"""The displacement field of the gel between its markers, and how the gel inside a contact moves as a whole.

Both displacement components are taken for independent Gaussian processes over the gel at rest (kriging), with
a Matern kernel of order 5/2. Markers of one reference have one kernel matrix, so that it is inverted once; a
frame then costs matrix products. Everything that is asked of the field is linear in the displacements of the
markers, so that each answer has a standard error in closed form.
"""

from __future__ import annotations

import math
from functools import cached_property, lru_cache
from typing import Final, NamedTuple

import cv2
import numpy as np

from tactflow.vision.arrays import Flags, Floats, Mask, Points, check_mask
from tactflow.vision.compiled import kernel
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
LEAST_INFORMATION: Final = 1e-5
"""Precision of a marker given all others, 1, at least: one that no other is near. Chosen by hand."""
NOWHERE: Final = 1e-12
"""Sum of the kernel to all markers, at least, to divide by. Chosen by hand."""
WHOLE: Final = 1e-3
"""Cells that are partly in a region, at least, for it to have an outline; rounding makes fewer. Chosen by hand."""


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

    def block(self, low: Floats, high: Floats) -> tuple[slice, slice]:
        """Rows and columns, two at least, of the cells between two points (x, y), px, and one beyond."""
        most = np.array(self.shape[::-1])
        first = np.clip((low - self.first) // self.spacing, 0, most - 2).astype(int)
        stop = np.clip((high - self.first) // self.spacing + 2, first + 2, most).astype(int)
        return slice(first[1], stop[1]), slice(first[0], stop[0])


class Samples(NamedTuple):
    """A grid of cells over which the field is summed.

    to_markers : (rows, columns, N) float64, the kernel between cells and markers. between : (2 rows - 1, 2
    columns - 1) float64, the kernel between two cells, by how many rows and columns they are apart; 0 in the
    middle.
    """

    grid: Grid
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
        self._length = LENGTH * self.pitch
        kernel = self._kernel(self.origin)
        self.inverse: Floats = np.asarray(np.linalg.inv(kernel + NUGGET * np.eye(len(origin))), np.float64)
        grid = _grid(size, self.pitch)
        self.margin = OVERSHOOT * self.pitch + grid.spacing
        """How much farther a cell may have moved than any marker that is seen, px."""
        self.fine, self.coarse = self._samples(grid), self._samples(grid.coarser())
        """For small and for large regions. Both are fixed to the frame, so that what is said of a region does
        not depend on where its bounding box begins."""

    def _samples(self, grid: Grid) -> Samples:
        rows, columns = grid.shape
        to_markers = self._kernel(grid.points.reshape(-1, 2)).reshape(rows, columns, -1)
        down, across = np.mgrid[1 - rows : rows, 1 - columns : columns] * grid.spacing
        return Samples(grid, to_markers, matern(np.hypot(down, across) / self._length))

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
        known = seen & np.isfinite(markers.stderr)
        errors = np.sort(markers.stderr[known])
        self.noise = float(errors[len(errors) // 2]) if len(errors) else 0.0
        self._variance = np.where(known, markers.stderr, self.noise) ** 2
        self._moved = np.where(seen[:, None], markers.position - model.origin, 0.0)
        self._removed = np.empty((0, len(seen)))
        """(S, N): the inverse is less by their squares, removed.T @ removed."""
        poor = seen & (self._variance > (POOR * self.noise) ** 2)
        doubtful = ~seen | poor
        if doubtful.any():
            self._removed = self._without(doubtful, 0.0)
        if poor.any():
            # Their variance is compared with that of the field, which all others tell.
            moved = self._moved[~doubtful]
            scale = float(np.vdot(moved, self._weights(self._moved.T).T[~doubtful])) / moved.size
            self._removed = self._without(doubtful, scale)
        self._coefficients = self._weights(self._moved.T).T
        information = np.diagonal(model.inverse) - np.square(self._removed).sum(axis=0)
        self._precision = np.where(seen, 0.5 / np.maximum(information, LEAST_INFORMATION), 0.0)

    def _without(self, doubtful: Flags, scale: float) -> Floats:
        """(S, N): what `_removed` is without these markers (N,), by Cholesky's factors.

        scale : variance of the field, px^2, for those of them that are seen; 0 leaves them out, too.
        """
        chosen = np.flatnonzero(doubtful)
        rows = self._model.inverse[chosen]
        share = np.where(self._seen[chosen], scale / np.maximum(self._variance[chosen], 1e-300), 0.0)
        return np.asarray(np.linalg.solve(np.linalg.cholesky(rows[:, chosen] + np.diag(share)), rows))

    def _weights(self, kernel: Floats) -> Floats:
        """(M, N): how much each marker counts in what has these kernels (M, N) with the markers."""
        return np.asarray(kernel @ self._model.inverse - kernel @ self._removed.T @ self._removed)

    @cached_property
    def displacement(self) -> Floats:
        """(rows, columns, 2) float64, px."""
        return np.asarray(self._model.fine.to_markers @ self._coefficients)

    @cached_property
    def stderr(self) -> Floats:
        """(rows, columns) float64, standard error of each component of `displacement`, px."""
        kernel = self._model.fine.to_markers.reshape(-1, len(self._seen))
        weights = self._weights(kernel)
        unknown = np.maximum(1 - np.einsum("gn,gn->g", weights, kernel), 0)
        squares = self._scale(kernel) * unknown + (weights * weights) @ self._variance
        return np.asarray(np.sqrt(squares).reshape(self.grid.shape))

    def _scale(self, kernel: Floats) -> Floats:
        """(...,): variance of the field, px^2, near what has these kernels (..., N) with the markers."""
        variances = np.square(self._coefficients).sum(axis=1) * self._precision
        return np.asarray(kernel @ variances / np.maximum(kernel @ self._seen, NOWHERE))

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
            check_mask(mask)
            self._shared = mask, _covered(mask, self.grid.points + self.displacement, self.grid.spacing)
        return self._shared[1]

    def motion(self, mask: Mask) -> GelMotion | None:
        """How the gel inside a region has moved, each bit of it counted by its area at rest.

        mask : (H, W) uint8, 255 inside, else 0, in the current frame: what counts is where the gel is now.
        Returns None for a region without a cell. Raises ValueError if mask is not (H, W) uint8.
        """
        if self._asked is None or self._asked[0] is not mask:
            check_mask(mask)
            self._asked = mask, self._motion(mask)
        return self._asked[1]

    def _motion(self, mask: Mask) -> GelMotion | None:
        x, y, width, height = cv2.boundingRect(mask)
        large = width * height >= MANY * self.grid.spacing**2
        samples = self._model.coarse if large else self._model.fine
        low = np.array([x, y]) - self._moved.max(axis=0) - self._model.margin
        high = np.array([x + width, y + height]) - self._moved.min(axis=0) + self._model.margin
        block = samples.grid.block(low, high)
        points, kernel = samples.grid.points[block], samples.to_markers[block]
        moved = kernel @ self._coefficients
        share = _covered(mask, points + moved, samples.grid.spacing)
        if not share.any():
            return None
        weight = share / share.sum()
        # Mean and gradient are the least-squares fit of 1, x and y, from the middle of the region.
        terms = np.ones((*share.shape, 3))
        terms[..., 1:] = points - weight.ravel() @ points.reshape(-1, 2)
        weighted = weight[..., None] * terms
        unknown, noise, left = self._covariances(weighted, kernel, samples.between)
        motion = _fit(terms, weighted, moved, unknown, noise, left, samples.grid.spacing)
        # A region that is larger by a small part adds as much of its mean slope outwards, times the way from
        # its middle, to the mean (Gauss's theorem). Where all cells are whole, the picture has none of its
        # outline.
        if np.vdot(share, 1 - share) < WHOLE:
            return motion
        outline = OUTLINE * np.abs(_outwards(moved, weighted[..., 1:])) / samples.grid.spacing
        return motion._replace(outline_stderr=(float(outline[0]), float(outline[1])))

    def _covariances(self, weighted: Floats, kernel: Floats, between: Floats) -> tuple[Floats, Floats, float]:
        """Covariances of weighted sums over cells of the field: (3, 3), of what the markers leave unknown, and
        (3, 3), of what their own errors add, px^2; share of the first sum's variance that they leave unknown.

        weighted : (r, c, 3), weights of each cell. kernel : (r, c, N), between cells and markers. between : of
        `Samples`.
        """
        to_markers, prior = (weighted.swapaxes(1, 2) @ kernel).sum(axis=0), np.zeros((3, 3))
        sum_pairs(np.ascontiguousarray(np.moveaxis(weighted, -1, 0)), between, prior)
        weights = self._weights(to_markers)
        unknown = prior - weights @ to_markers.T
        noise = (weights * self._variance) @ weights.T
        return self._scale(to_markers[0]) * unknown, noise, max(float(unknown[0, 0] / prior[0, 0]), 0.0)


@kernel("void(float64[:, :, ::1], float64[:, ::1], float64[:, ::1])")
def sum_pairs(weights: Floats, between: Floats, sums: Floats) -> None:
    """Covariance of weighted sums over cells of the field: sums over all pairs of cells.

    weights : (K, r, c). between : of `Samples`. sums : (K, K) of 0, filled. As matrix products or convolutions,
    this would take several times as long.
    """
    count, rows, columns = weights.shape
    for row in range(rows):
        for column in range(columns):
            if weights[0, row, column] == 0:
                continue
            for k in range(rows):
                near = between[between.shape[0] // 2 + row - k, between.shape[1] // 2 - column :]
                for i in range(count):
                    total = 0.0
                    for n in range(columns):
                        total += weights[i, k, n] * near[n]
                    for j in range(count):
                        sums[i, j] += total * weights[j, row, column]


def _fit(
    terms: Floats, weighted: Floats, moved: Floats, unknown: Floats, noise: Floats, left: float, spacing: float
) -> GelMotion:
    """The affine motion that is nearest to the motions (r, c, 2) of cells.

    terms : (r, c, 3), 1 and the way from the middle of the region, px. weighted : the same, times the weight of
    each cell. unknown, noise, left : of `DisplacementField._covariances`. spacing : of the cells, px.
    """
    weight, columns = weighted[..., 0].ravel(), weighted.reshape(-1, 3).T
    moments, sums = columns @ terms.reshape(-1, 3), columns @ moved.reshape(-1, 2)
    rest = (moved - sums[0]).reshape(-1, 2)
    mean, squares = (float(sums[0, 0]), float(sums[0, 1])), float(weight @ np.square(rest).sum(axis=1))
    stderr = math.sqrt(max(float(unknown[0, 0]), 0.0) + float(noise[0, 0]))
    motion = GelMotion(mean, stderr, (0.0, 0.0), math.sqrt(squares / 2), None, None, left)
    # A single cell has the second moment spacing^2 / 12 along each axis: too small to have slopes.
    second = moments[1:, 1:]
    if np.linalg.det(second) <= np.trace(second) * spacing**2 / 12:
        return motion
    inverse = np.linalg.inv(moments)
    (dx_u, dx_v), (dy_u, dy_v) = (inverse @ sums)[1:].tolist()
    variances = np.maximum(np.diag(inverse @ unknown @ inverse), 0) + np.diag(inverse @ noise @ inverse)
    gradient = Gradient((dx_u, dx_v), (dy_u, dy_v), *np.sqrt(variances[1:]).tolist())
    growth, turn = gradient.growth
    rest -= terms[..., 1:].reshape(-1, 2) @ [[growth, turn], [-turn, growth]]
    residual = math.sqrt(float(weight @ np.square(rest).sum(axis=1)))
    return motion._replace(gradient=gradient, residual=residual)


def _outwards(moved: Floats, ways: Floats) -> Floats:
    """(2,): sum of the changes of motions (r, c, 2) of cells along their ways (r, c, 2), in cells."""
    step = np.array([[-0.5, 0.0, 0.5]])
    across, down = (
        cv2.filter2D(moved, -1, kernel, borderType=cv2.BORDER_REPLICATE) for kernel in (step, step.T)
    )
    # At the border the neighbours are one cell apart, not two.
    across[:, [0, -1]] *= 2
    down[[0, -1]] *= 2
    return np.asarray((ways[..., :1] * across + ways[..., 1:] * down).sum(axis=(0, 1)))


def _covered(mask: Mask, places: Floats, spacing: float) -> Floats:
    """(r, c), how much of squares around places (r, c, 2), px, lies in a mask, 0 to 1.

    spacing : of the places, px; the sides of the squares are the nearest odd number.
    """
    side = 2 * round((spacing - 1) / 2) + 1
    left, top, width, height = cv2.boundingRect(mask)
    box = mask[top : top + height, left : left + width]
    wide = cv2.copyMakeBorder(box, side, side, side, side, cv2.BORDER_CONSTANT, value=0)
    covered = cv2.boxFilter(wide, cv2.CV_32F, (side, side), borderType=cv2.BORDER_CONSTANT)
    now = (places - (left - side, top - side)).astype(np.float32)
    shares = cv2.remap(covered, now, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)  # type: ignore[call-overload]
    return np.asarray(shares, np.float64) / 255


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
