"""How a part of the gel has moved as a whole: sums over cells of the gel that lie in a region."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.arrays import Floats
from tactflow.vision.compiled import kernel

OUTLINE: Final = 4.0
"""How uncertain a contact's outline is: the square of its error times the length over which it errs alike,
px^3; 0.5 px over 16 px. Measured on 22 simulated recordings, by what it does to the mean."""


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


class Uncertainty(NamedTuple):
    """How well sums of the displacement over cells, with the weights of `RegionSums.basis`, are known.

    unknown : share of what the mean could be that the markers leave open, 0 to 1.
    left : (3, 3) float64, covariance that they leave of the field, px^2. noise : (3, 3) float64, that of
    their own errors, px^2.
    """

    unknown: float
    left: Floats
    noise: Floats

    def stderr(self, mean: float, x: float, y: float) -> float:
        """Standard error of a linear combination of the mean and the two other sums, px."""
        variance = 0.0
        for covariance in (self.left, self.noise):
            (one, _, _), (_, xx, xy), (_, _, yy) = covariance.tolist()
            variance += max(mean * mean * one + x * x * xx + 2 * x * y * xy + y * y * yy, 0.0)
        return math.sqrt(variance)


class RegionSums:
    """Sums over cells of the gel, weighted by their share in a region.

    share : (r, c) float64, how much of each cell is in the region, 0 to 1; not all 0. place : (r, c, 2)
    float64, at rest, px. displacement : (r, c, 2) float64, px. spacing : of the cells, px.

    basis : (3, r, c) float64, the share of each cell, in sum 1, and that times x and y from the middle.
    """

    def __init__(self, share: Floats, place: Floats, displacement: Floats, spacing: float) -> None:
        self._spacing, self._total = spacing, float(share.sum())
        weight = (share / self._total).reshape(1, -1)
        values = np.ascontiguousarray(np.concatenate([place, displacement], axis=2).reshape(-1, 4).T)
        means = (weight * values).sum(axis=1, keepdims=True)
        values = values - means
        weighted = weight * values
        self.basis: Floats = np.concatenate([weight, weighted[:2]]).reshape(3, *share.shape)
        self._mean: Floats = means[2:, 0]
        self._second: Floats = weighted @ values.T
        self._at_outline: Floats = (values[2:] ** 2) @ (share * (1 - share)).ravel()

    def motion(self, uncertainty: Uncertainty) -> GelMotion:
        """The motion of the region. uncertainty : of the sums of the displacement that `basis` weighs."""
        spacing = self._spacing
        (xx, xy, xu, xv), (_, yy, yu, yv), (*_, uu, _), (*_, vv) = self._second.tolist()
        (u, v), at_outline = self._mean.tolist(), self._at_outline.tolist()
        # An outline that is d too far out at s adds (m(s) - mean) d ds / area. Across it, the share of a cell
        # falls from 1 to 0 within its width: share (1 - share) is 1 / 6 for a whole side.
        unit = OUTLINE * 6 * spacing / (self._total * spacing * spacing) ** 2
        motion = GelMotion(
            mean=(u, v),
            stderr=uncertainty.stderr(1.0, 0.0, 0.0),
            # Where no cell is at the outline, rounding leaves 0 or less.
            outline_stderr=(
                math.sqrt(max(unit * at_outline[0], 0.0)),
                math.sqrt(max(unit * at_outline[1], 0.0)),
            ),
            spread=math.sqrt((uu + vv) / 2),
            gradient=None,
            residual=None,
            unknown=uncertainty.unknown,
        )
        determinant = xx * yy - xy * xy
        # A single cell has the second moment spacing^2 / 12 along each axis: too small to have slopes.
        if determinant <= (xx + yy) * spacing * spacing / 12:
            return motion
        x, y, z = yy / determinant, -xy / determinant, xx / determinant
        dx, dy = (x * xu + y * yu, x * xv + y * yv), (y * xu + z * yu, y * xv + z * yv)
        gradient = Gradient(dx, dy, uncertainty.stderr(0.0, x, y), uncertainty.stderr(0.0, y, z))
        growth, turn = gradient.growth
        rest = uu + vv - 2 * (growth * (xu + yv) + turn * (xv - yu)) + (growth**2 + turn**2) * (xx + yy)
        return motion._replace(gradient=gradient, residual=math.sqrt(max(rest, 0.0)))


@kernel("void(int32[:, ::1], float64[:, :, ::1], int64, float64[:, ::1])")
def share_cells(covered: NDArray[np.int32], places: Floats, side: int, shares: Floats) -> None:
    """How much of the square around each place lies in a region; a pixel that it cuts counts by its part.

    covered : (h + 1, w + 1), sums over the pixels above and to the left in a window of a mask with 255
    inside. They may overflow: differences are right. places : (r, c, 2), px of the window. side : of the
    square, px. shares : (r, c), filled, 0 to 1.
    """
    height, width = covered.shape[0] - 1, covered.shape[1] - 1
    for i in range(shares.shape[0]):
        for j in range(shares.shape[1]):
            x, y, total = places[i, j, 0] + 0.5 - 0.5 * side, places[i, j, 1] + 0.5 - 0.5 * side, 0.0
            if -side < x < width and -side < y < height:
                column, row = math.floor(x), math.floor(y)
                for down in range(2):
                    top, bottom = max(row + down, 0), min(row + down + side, height)
                    for across in range(2):
                        left, right = max(column + across, 0), min(column + across + side, width)
                        upper = covered[top, right] - covered[top, left]
                        inside = np.int32(covered[bottom, right] - covered[bottom, left] - upper)
                        total += abs(1 - down - (y - row)) * abs(1 - across - (x - column)) * inside
            shares[i, j] = total / (255.0 * side * side)


@kernel("void(float64[:, :, ::1], float64[:, ::1], float64[:, ::1])")
def sum_pairs(basis: Floats, between: Floats, sums: Floats) -> None:
    """Sums over all pairs of cells of the kernel between them, weighted by both.

    basis : (3, r, c), weights. between : (odd, odd), the kernel between two cells, by how many rows and
    columns they are apart; 0 in the middle. sums : (3, 3) of 0, filled for the first weights, and for the
    two others.
    """
    ones, across, down = basis[0], basis[1], basis[2]
    for row in range(basis.shape[1]):
        for other in range(row + 1):
            # In the cell's own row, each pair comes twice.
            times = 1.0 if row == other else 2.0
            for column in range(basis.shape[2]):
                if ones[other, column] == 0:
                    continue
                near = between[between.shape[0] // 2 + other - row, between.shape[1] // 2 - column :]
                one = x = y = 0.0
                for k in range(basis.shape[2]):
                    one += ones[row, k] * near[k]
                    x += across[row, k] * near[k]
                    y += down[row, k] * near[k]
                sums[0, 0] += times * ones[other, column] * one
                sums[1, 1] += times * across[other, column] * x
                sums[1, 2] += times * (across[other, column] * y + down[other, column] * x) / 2
                sums[2, 2] += times * down[other, column] * y
    sums[2, 1] = sums[1, 2]
