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
from scipy.spatial.distance import cdist

from tactflow.vision.arrays import Flags, Floats, Indices, Mask, Points, check_mask
from tactflow.vision.compiled import kernel
from tactflow.vision.markers.lattice import pitch_of
from tactflow.vision.types import Markers, MarkerStatus

CORRELATION_LENGTH_PITCHES: Final = 1.5
"""Correlation length of the field, pitches. Kernel and length are those that predict the markers of nine real
recordings best, each marker from all others (leave-one-out likelihood); on four other recordings the best
length is 1.4."""
NUGGET_VARIANCE: Final = 1e-5
"""Variance added to each marker's, relative to the field's: it keeps the matrix well conditioned. Markers
known to 0.015 px in a field of 5 px have as much. Chosen by hand."""
CELL_PITCHES: Final = 0.25
"""Spacing of the grid, pitches. Chosen by hand."""
MAX_CELLS: Final = 2500
"""Cells of a grid at most; where a quarter of the pitch would make more, the spacing is larger. Chosen by
hand."""
COARSE_GRID_CELLS: Final = 400
"""A region whose bounding box has this many cells or more is summed over a grid with twice the spacing: it is
at least five pitches wide, and the field varies over one and a half. Chosen by hand."""
OUTLINE_STDERR_RADII: Final = 1 / 3
"""Standard error of a contact's outline, over the radius of a disc of the same area. Gel that a wrong outline
includes or leaves out moves otherwise than the contact. On labelled frames of nine labs, 71 % of the
components of the mean lie within one standard error of those inside outlines by eye, and 94 % within two
(`lab/mean_flow.py`)."""
MIN_MARKERS: Final = 3
"""Tracked markers that a field needs. Chosen by hand."""
MAX_OVERSHOOT_PITCHES: Final = 0.5
"""How much farther the gel may have moved than any tracked marker, pitches. Chosen by hand."""
POOR_STDERR_RATIO: Final = 3.0
"""A marker whose standard error exceeds the median by this factor has less weight. Chosen by hand."""
PARTIAL_SHARE_TOLERANCE: Final = 1e-9
"""Sum of share (1 - share) over the cells of a region, up to which all of them are whole: rounding errors."""
_TRACKED: Final = int(MarkerStatus.TRACKED)
_MIN_PRECISION: Final = 1e-5
"""Smallest precision of a marker given all others that is divided by: that of an isolated marker, 1."""
_MIN_KERNEL_SUM: Final = 1e-12
"""Smallest sum of the kernel to all markers that is divided by."""


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


class Samples(NamedTuple):
    """A grid of cells over which the field is summed.

    Attributes
    ----------
    to_markers : (rows, columns, N) float64, the kernel between cells and markers.
    between : (2 rows - 1, 2 columns - 1) float64, the kernel between two cells, by how many rows and
        columns they are apart; 0 in the middle.
    """

    grid: Grid
    to_markers: Floats
    between: Floats


class Gradient(NamedTuple):
    """How a part of the gel is turned, pressed apart and sheared: its displacement gradient.

    Attributes
    ----------
    dx, dy : (du/dx, dv/dx) and (du/dy, dv/dy), 1: gradient of the displacement (u, v).
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

    Attributes
    ----------
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
        if origin.ndim != 2 or origin.shape[1] != 2 or len(origin) < MIN_MARKERS:
            raise ValueError(
                f"required an origin of shape (N, 2) with N >= {MIN_MARKERS}, got {origin.shape}"
            )
        if min(size) < 1:
            raise ValueError(f"required a size of at least 1 x 1 px, got {size}")
        self.origin: Points = np.array(origin, np.float64)
        self.pitch = max(pitch_of(self.origin), 1.0)
        self._length = CORRELATION_LENGTH_PITCHES * self.pitch
        kernel = self._kernel(self.origin)
        self.inverse: Floats = np.asarray(
            np.linalg.inv(kernel + NUGGET_VARIANCE * np.eye(len(origin))), np.float64
        )
        self.precision: Floats = np.diagonal(self.inverse).copy()
        """(N,), of each marker given all others, relative to the field's."""
        width, height = size
        spacing = max(CELL_PITCHES * self.pitch, math.sqrt(width * height / MAX_CELLS))
        columns, rows = math.ceil(width / spacing), math.ceil(height / spacing)
        first = (width - 1 - spacing * (columns - 1)) / 2, (height - 1 - spacing * (rows - 1)) / 2
        self.margin = MAX_OVERSHOOT_PITCHES * self.pitch + spacing
        """How much farther a cell may have moved than any tracked marker, px."""
        self.grid = Grid((rows, columns), first, spacing)
        """Fixed to the frame, so that the motion of a region does not depend on where its bounding box
        begins."""

    @cached_property
    def fine(self) -> Samples:
        """For small regions."""
        return self._samples(self.grid)

    @cached_property
    def coarse(self) -> Samples:
        """For large regions: every other row and column of the grid."""
        (rows, columns), first, spacing = self.grid
        return self._samples(Grid(((rows + 1) // 2, (columns + 1) // 2), first, 2 * spacing))

    def _samples(self, grid: Grid) -> Samples:
        rows, columns = grid.shape
        to_markers = self._kernel(grid.points.reshape(-1, 2)).reshape(rows, columns, -1)
        down, across = np.mgrid[1 - rows : rows, 1 - columns : columns] * grid.spacing
        return Samples(grid, to_markers, matern(np.hypot(down, across) / self._length))

    def _kernel(self, points: Points) -> Floats:
        """(M, N), the kernel between points (M, 2), px, and the markers."""
        distance = cdist(points, self.origin)
        distance /= self._length
        return matern(distance)

    def __call__(self, markers: Markers) -> DisplacementField | None:
        """The field of one frame; None where fewer than three markers are seen.

        Raises ValueError if there are not as many markers as in the reference.
        """
        if markers.position.shape != self.origin.shape:
            raise ValueError(f"required {len(self.origin)} markers, got {len(markers.position)}")
        seen = markers.status == _TRACKED
        return DisplacementField(self, markers, seen) if np.count_nonzero(seen) >= MIN_MARKERS else None


class DisplacementField:
    """The displacement of the gel everywhere, in one frame. Computed lazily.

    Coordinates are those of the gel at rest: `displacement[row, column]` is how far the bit of gel has moved
    that was at `grid.points[row, column]` in the reference frame.

    Parameters
    ----------
    model : of the reference.
    markers : of the frame.
    seen : (N,) bool, those that are tracked, three or more.

    Attributes
    ----------
    grid : where the field is known.
    noise : median standard error of a marker, px; 0 where none is known.
    """

    def __init__(self, model: FieldModel, markers: Markers, seen: Flags) -> None:
        self.grid = model.grid
        self._asked: tuple[Mask, GelMotion | None] | None = None
        self._shared: tuple[Mask, Floats] | None = None
        self._model, self._seen = model, seen
        known = seen & np.isfinite(markers.stderr)
        errors = np.sort(markers.stderr[known])
        self.noise = float(errors[len(errors) // 2]) if len(errors) else 0.0
        self._variance = np.square(np.where(known, markers.stderr, self.noise))
        self._moved = np.where(seen[:, None], markers.position - model.origin, 0.0)
        doubtful = ~seen | (self._variance > (POOR_STDERR_RATIO * self.noise) ** 2)
        chosen = np.flatnonzero(doubtful)
        self._left_out: Floats = model.inverse[chosen]
        """(S, N): rows of the inverse of markers that are not seen, or seen poorly."""
        self._removed = self._left_out
        information = model.precision
        if len(chosen):
            self._removed = self._without(chosen, 0.0)
            if seen[chosen].any():
                # The variance of the field, to which theirs is compared, is estimated from all others.
                moved = self._moved[~doubtful]
                scale = float(np.vdot(moved, self._weights(self._moved.T).T[~doubtful])) / moved.size
                self._removed = self._without(chosen, scale)
            information = information - (self._left_out * self._removed).sum(axis=0)
        self._coefficients = self._weights(self._moved.T).T
        self._precision = np.where(seen, 0.5 / np.maximum(information, _MIN_PRECISION), 0.0)

    def _without(self, chosen: Indices, scale: float) -> Floats:
        """(S, N): the inverse of this frame is that of the model less left_out.T @ these rows.

        chosen : (S,), markers. scale : variance of the field, px^2, with which those of them that are seen
        keep some weight; 0: none.
        """
        precision = scale * self._seen[chosen] / np.maximum(self._variance[chosen], 1e-300)
        return np.asarray(np.linalg.solve(self._left_out[:, chosen] + np.diag(precision), self._left_out))

    def _weights(self, kernel: Floats) -> Floats:
        """(M, N): weights of the markers in M values of the field, whose kernel to the markers is (M, N)."""
        weights = np.asarray(kernel @ self._model.inverse)
        if len(self._left_out):
            weights -= (kernel @ self._left_out.T) @ self._removed
        return weights

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
        """(...,): variance of the field, px^2, near places whose kernel to the markers is (..., N)."""
        variances = np.square(self._coefficients).sum(axis=1) * self._precision
        return np.asarray(kernel @ variances / np.maximum(kernel @ self._seen, _MIN_KERNEL_SUM))

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
            places, box = self.grid.points + self.displacement, cv2.boundingRect(mask)
            self._shared = mask, _covered(mask, box, places, self.grid.spacing)
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
        box = cv2.boundingRect(mask)
        large = box[2] * box[3] >= COARSE_GRID_CELLS * self.grid.spacing**2
        samples = self._model.coarse if large else self._model.fine
        rows, columns = self._near(box, samples.grid)
        moved = samples.to_markers[rows, columns] @ self._coefficients
        share = _covered(mask, box, samples.grid.points[rows, columns] + moved, samples.grid.spacing)
        total = float(share.sum())
        if not total:
            return None
        products, prior, to_region = np.zeros((7, 7)), np.zeros((3, 3)), np.zeros((3, len(self._seen)))
        sum_cells(
            share / total,
            moved,
            samples.grid.spacing,
            samples.to_markers[rows],
            columns.start,
            samples.between,
            products,
            to_region,
            prior,
        )
        weights = self._weights(to_region)
        unknown, noise = prior - weights @ to_region.T, (weights * self._variance) @ weights.T
        unknown_share = max(float(unknown[0, 0] / prior[0, 0]), 0.0)
        unknown *= self._scale(to_region[0])
        # Where all cells are whole, the picture shows none of the region's outline.
        outline = (
            OUTLINE_STDERR_RADII if total - float(np.vdot(share, share)) > PARTIAL_SHARE_TOLERANCE else 0.0
        )
        return _fit(products, unknown, noise, unknown_share, outline, samples.grid.spacing)

    def _near(self, box: Sequence[int], grid: Grid) -> tuple[slice, slice]:
        """Rows and columns of the cells whose gel may be in a box (left, top, width, height)."""
        slices, margin = [], self._model.margin
        extent = zip(self._moved.min(axis=0).tolist(), self._moved.max(axis=0).tolist(), strict=True)
        for axis, (least, most) in enumerate(extent):
            low = (box[axis] - most - margin - grid.first[axis]) / grid.spacing
            high = (box[axis] + box[axis + 2] - least + margin - grid.first[axis]) / grid.spacing
            cells = grid.shape[1 - axis]
            start = min(max(int(low), 0), cells - 1)
            slices.append(slice(start, min(max(int(high) + 2, start + 1), cells)))
        return slices[1], slices[0]


@kernel
def sum_cells(
    weight: Floats,
    moved: Floats,
    spacing: float,
    to_markers: Floats,
    first_column: int,
    between: Floats,
    products: Floats,
    to_region: Floats,
    prior: Floats,
) -> None:
    """Weighted sums over the cells of a region, of seven values v of each cell.

    These are 1; the way (x, y) to the cell from the centroid, px; its motion (x, y), px; and the change of
    the motion (x, y) along that way, px.

    weight : (r, c), with the sum 1. moved : (r, c, 2). spacing : of the cells, px. to_markers : (r, C, N), of
    `Samples`, from column `first_column` on. between : of `Samples`.
    products : (7, 7) of 0, filled with the sums of v_i v_j. to_region : (3, N) of 0, filled with the sums of
    v_i times the kernel to each marker, for the first three. prior : (3, 3) of 0, filled with the sums of v_i
    v_j over pairs of cells, times the kernel between the two.
    """
    rows, columns = (np.asarray(each) for each in np.indices(weight.shape))
    way = np.stack([columns - (weight * columns).sum(), rows - (weight * rows).sum()])
    # Differences of neighbours, one-sided at the border of the region.
    change = np.zeros_like(moved)
    for axis, steps in ((1, way[0]), (0, way[1])):
        if weight.shape[axis] > 1:
            change += steps[:, :, None] * np.gradient(moved, axis=axis)
    values = np.stack(
        [np.ones_like(weight), *(spacing * way), *np.moveaxis(moved, 2, 0), *np.moveaxis(change, 2, 0)]
    )
    inside = weight > 0
    v, w = values[:, inside], weight[inside]
    products += (v * w) @ v.T
    near = to_markers[:, first_column : first_column + weight.shape[1]][inside]
    to_region += (v[:3] * w) @ near
    y, x = rows[inside], columns[inside]
    middle_y, middle_x = between.shape[0] // 2, between.shape[1] // 2
    pairs = between[middle_y + y[:, None] - y, middle_x + x - x[:, None]]
    prior += (v[:3] * w) @ pairs @ (v[:3] * w).T


def _fit(
    products: Floats, unknown: Floats, noise: Floats, unknown_share: float, outline: float, spacing: float
) -> GelMotion:
    """The affine motion nearest to those of the cells of a region.

    products : of `sum_cells`. unknown, noise : (3, 3), covariance of the sums of the motion times 1, x and y:
    what the markers leave unknown, and what their own errors add, px^2. unknown_share : see `GelMotion`.
    outline : standard error of the outline, over the radius. spacing : of the cells, px.
    """
    # A region that grows by a small part of its radius adds that part of the mean change outwards to the mean
    # (Gauss's theorem).
    _, _, _, u, v, outwards_u, outwards_v = products[0].tolist()
    squares = max(products[3, 3] + products[4, 4] - u * u - v * v, 0.0)
    stderr = math.sqrt(max(unknown[0, 0], 0.0) + noise[0, 0])
    outline_stderr = outline * abs(outwards_u), outline * abs(outwards_v)
    motion = GelMotion((u, v), stderr, outline_stderr, math.sqrt(squares / 2), None, None, unknown_share)
    (xx, xy, xu, xv), (_, yy, yu, yv) = products[1:3, 1:5].tolist()
    determinant = xx * yy - xy * xy
    # A single cell has the second moment spacing^2 / 12 along each axis: too small to have slopes.
    if determinant <= (xx + yy) * spacing**2 / 12:
        return motion
    x, y, z = yy / determinant, -xy / determinant, xx / determinant
    forms = unknown[1:, 1:].tolist(), noise[1:, 1:].tolist()
    dx_stderr, dy_stderr = (
        math.sqrt(max(_square(forms[0], *row), 0.0) + _square(forms[1], *row)) for row in ((x, y), (y, z))
    )
    dx, dy = (x * xu + y * yu, x * xv + y * yv), (y * xu + z * yu, y * xv + z * yv)
    gradient = Gradient(dx, dy, dx_stderr, dy_stderr)
    growth, turn = gradient.growth
    rest = squares - 2 * (growth * (xu + yv) + turn * (xv - yu)) + (growth**2 + turn**2) * (xx + yy)
    return motion._replace(gradient=gradient, residual=math.sqrt(max(rest, 0.0)))


def _square(form: Sequence[Sequence[float]], x: float, y: float) -> float:
    """The square of a vector by a symmetric form (2, 2)."""
    return x * x * form[0][0] + 2 * x * y * form[0][1] + y * y * form[1][1]


def _covered(mask: Mask, box: Sequence[int], places: Floats, spacing: float) -> Floats:
    """(r, c), how much of the square around each place (r, c, 2), px, lies in a mask, 0 to 1.

    box : (left, top, width, height), bounding box of the mask. spacing : of the places, px; the side of the
    squares is the nearest odd number.
    """
    side = 2 * round((spacing - 1) / 2) + 1
    left, top = max(box[0] - side, 0), max(box[1] - side, 0)
    part = mask[top : box[1] + box[3] + side, left : box[0] + box[2] + side]
    means = cv2.blur(part, (side, side), borderType=cv2.BORDER_CONSTANT)
    now = (places - (left, top)).astype(np.float32)
    shares = cv2.remap(means, now, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)  # type: ignore[call-overload]
    return np.asarray(shares, np.float64) / 255


def matern(distance: Floats) -> Floats:
    """The Matern kernel of order 5/2 of distances in correlation lengths, which are overwritten: 1 at 0.

    New memory for each step would take most of the time.

    >>> float(matern(np.array(0.0)))
    1.0
    """
    scaled = distance
    scaled *= -math.sqrt(5)
    kernel = np.asarray(scaled / 3)
    kernel -= 1
    kernel *= scaled
    kernel += 1
    kernel *= np.exp(scaled, out=scaled)
    return kernel
