"""Where marks are that are not seen: a quadratic fit to the displacements around them."""

from __future__ import annotations

from typing import Final

import numpy as np

from tactflow.vision.arrays import Flags, Floats, Indices
from tactflow.vision.markers.lattice import nearest

NEIGHBOURS: Final = 24
"""Marks around a mark that a fit uses, at most: the two rings of a square grid, 8 + 16."""

WEIGHT_SIGMA: Final = 1.1
"""Width of the Gaussian by which a mark's weight falls with its distance, pitches: 0.66 at one pitch. Chosen
by hand."""

LEAST_WEIGHT: Final = 0.02
"""Weight below which a mark does not count, which is 3.1 pitches away. Chosen by hand."""

LEAST_SUPPORT: Final = 0.6
"""Sum of the weights of the seen marks around a mark that is placed: one neighbour is enough. Below, the mark
is lost."""

RIDGE: Final = np.diag([1e-9, 0.05, 0.05, 0.3, 0.3, 0.3])
"""Ridge of the fit's coefficients 1, x, y, x^2, x y, y^2. It turns a quadratic fit into a plane, and a plane
into a mean, where there is too little to fit it. Chosen by hand."""


class Interpolator:
    """Places marks by those around them.

    origin : (N, 2) float64, marks in the reference, px. pitch : px.

    Examples
    --------
    >>> x, y = np.meshgrid(np.arange(5.0), np.arange(5.0))
    >>> origin = 10 * np.column_stack([x.ravel(), y.ravel()])
    >>> position = origin + 3
    >>> found = np.ones(25, bool)
    >>> found[12], position[12] = False, 0.0
    >>> placed = Interpolator(origin, 10.0).place(position, found)
    >>> placed.tolist(), (position[12] - origin[12]).round(2).tolist()
    ([12], [3.0, 3.0])
    """

    def __init__(self, origin: Floats, pitch: float) -> None:
        self._origin, self._pitch = origin, pitch
        self._around, self._weight = surroundings(origin, pitch)

    def place(self, position: Floats, found: Flags, share: float = 0.0) -> Indices:
        """Place the marks that are not found, where enough of those around them are.

        position : (N, 2) float64, px, finite, changed in place. found : (N,) bool.
        share : of the weight of all marks around, that those found have at least, 0 to 1.
        Returns the numbers of the marks that are placed; the positions of others stay.
        """
        missing = np.flatnonzero(~found)
        around = self._around[missing]
        weight = self._weight[missing] * found[around]
        offset = (self._origin[around] - self._origin[missing][:, None]) / self._pitch
        moved = (position - self._origin)[around]
        x, y = offset[..., 0], offset[..., 1]
        basis = np.empty((*x.shape, 6))
        for number, term in enumerate((1.0, x, y, x * x, x * y, y * y)):
            basis[..., number] = term
        weighted = (basis * weight[:, :, None]).transpose(0, 2, 1)
        fitted = np.linalg.solve(weighted @ basis + RIDGE, weighted @ moved)[:, 0]
        total = weight.sum(axis=1)
        supported = (total > LEAST_SUPPORT) & (total > share * self._weight[missing].sum(axis=1))
        placed = np.asarray(missing[supported], np.int64)
        position[placed] = self._origin[placed] + fitted[supported]
        return placed


def surroundings(origin: Floats, pitch: float) -> tuple[Indices, Floats]:
    """For each mark up to 24 nearest others, and their weights: two (N, n) arrays."""
    away, near = nearest(origin, NEIGHBOURS)
    weight = np.exp(-(away**2) / (2 * (WEIGHT_SIGMA * pitch) ** 2))
    weight[weight < LEAST_WEIGHT] = 0.0
    return near, weight
