"""The force on the whole gel, from the displacement of its dots.

The force that an object exerts on a linear elastic gel is a linear functional of the displacement of its
surface, wherever and with whatever shape it touches. Dots show the displacement along the picture. The one
into the gel shows as spread, since gels are nearly incompressible. Large strains add terms of second order.
So the force is a polynomial of second degree, without a constant, in the displacement on a fixed grid over
the picture. The grid makes it independent of which dots are found.

References
----------
J. R. Barber, Elasticity (2010), ch. 34: Betti's reciprocal theorem, and how it gives the resultant force.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from tactflow.vision.arrays import Flags, Floats
from tactflow.vision.flow.displacement_field import MIN_MARKERS, DisplacementField, FieldModel
from tactflow.vision.types import Markers, MarkerStatus, Scale

GRID_CELLS: Final = 16
"""Cells along the longer side of the picture: a few for each dot of the coarsest lattices (a FingerVision has
seven along the longer side), so that the outline of the dots is followed."""
SECOND_ORDER: Final = 0.1
"""Expected size of the terms of second order, relative to the linear ones at a typical load: the strain of a
pressed gel, about a tenth."""
MIN_TRACKED_SHARE: Final = 0.5
"""Smallest share of dots that must be tracked: without a majority, most of the field is extrapolated."""


def displacement(model: FieldModel, markers: Markers, scale: Scale, size: tuple[int, int]) -> Floats | None:
    """(S, 2) float64, mm: displacement of the gel at the S centres of the grid's cells.

    None where too few markers are tracked. model : of the reference of these markers. size : (width, height)
    of the processed frame, px.

    >>> x, y = np.meshgrid(np.arange(20.0, 160, 20), np.arange(20.0, 120, 20))
    >>> origin = np.column_stack([x.ravel(), y.ravel()])
    >>> markers = Markers(origin, origin + [2.0, 0.0], np.zeros(35, np.uint8), np.full(35, 0.01))
    >>> scale = Scale(0.1, 0.1, (0.0, 0.0), (0.0, 0.0))
    >>> displacement(FieldModel(origin, (160, 120)), markers, scale, (160, 120))[87].round(2).tolist()
    [0.2, 0.0]
    """
    tracked = np.count_nonzero(markers.status == int(MarkerStatus.TRACKED))
    if tracked < max(MIN_TRACKED_SHARE * len(markers.status), MIN_MARKERS):
        return None
    field: DisplacementField | None = model(markers)
    return None if field is None else field.at(_grid(size)) * (scale.x, scale.y)


def between_dots(origin: Floats, size: tuple[int, int]) -> Flags:
    """(S,) bool: which cells of the grid lie in the convex hull of the dots at rest.

    Beyond it the displacement is extrapolated: it repeats the outermost dots, and would count them several
    times over. origin : (N, 2) float64, px, N >= 3. size : (width, height) of the processed frame, px.

    >>> dots = np.array([[0.0, 0.0], [80.0, 0.0], [0.0, 119.0], [80.0, 119.0]])
    >>> between_dots(dots, (160, 120)).mean().tolist()
    0.5
    """
    inside = np.zeros(size[::-1], np.uint8)
    cv2.fillConvexPoly(inside, cv2.convexHull(np.rint(origin).astype(np.int32)), 1)
    x, y = np.rint(_grid(size)).astype(np.intp).T
    return np.asarray(inside[y, x] > 0)


def _grid(size: tuple[int, int]) -> Floats:
    """(S, 2) float64, px: x and y of the centres of cells that divide a frame (width, height), px."""
    side = max(size) / GRID_CELLS
    columns, rows = (max(1, round(length / side)) for length in size)
    x = (np.arange(columns) + 0.5) * size[0] / columns - 0.5
    y = (np.arange(rows) + 0.5) * size[1] / rows - 0.5
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def polynomial_terms(scores: Floats) -> Floats:
    """(n, k + k (k + 1) / 2): linear and quadratic terms of (n, k) scores of typical length 1.

    Quadratic terms are weighted so that the scalar product of two rows is p + (SECOND_ORDER p)^2, where p is
    the scalar product of the scores.

    >>> polynomial_terms(np.array([[1.0, 2.0]])).round(3).tolist()
    [[1.0, 2.0, 0.1, 0.283, 0.4]]
    """
    first, second = np.triu_indices(scores.shape[1])
    weights = SECOND_ORDER * np.where(first == second, 1.0, np.sqrt(2.0))
    return np.hstack([scores, weights * scores[:, first] * scores[:, second]])


@dataclass(frozen=True, eq=False, slots=True)
class FieldForce:
    """The force as a polynomial in the displacement field.

    modes : (k, 2 S) float64, 1/mm: the scores are their products with the displacement at S cells, (x, y) of
        the first cell, then of the second. weights : (k + k (k + 1) / 2, 3) float64, N, of the terms in
        x, y and z; a column of NaN for a component that is not known.

    Raises ValueError if the shapes do not match.

    >>> model = FieldForce(np.array([[1.0, 0.0]]), np.array([[2.0, np.nan, 0.0], [0.0, np.nan, 10.0]]))
    >>> model(np.array([[0.5, 0.0]])).round(3).tolist()
    [1.0, nan, 0.25]
    """

    modes: Floats
    weights: Floats

    def __post_init__(self) -> None:
        k = len(self.modes)
        if self.modes.ndim != 2 or self.weights.shape != (k + k * (k + 1) // 2, 3):
            raise ValueError(
                f"required modes (k, 2 S) and weights (k + k (k + 1) / 2, 3), got {self.modes.shape} and "
                f"{self.weights.shape}"
            )

    def __call__(self, moved: Floats) -> Floats:
        """(3,) float64, N. moved : (S, 2) float64, mm, see `displacement`.

        Raises ValueError for another S.
        """
        cells = self.modes.shape[1] // 2
        if len(moved) != cells:
            raise ValueError(
                f"required the displacement of {cells} cells, got {len(moved)}: calibrate the force again, "
                "as the grid or the shape of the frame has changed"
            )
        scores = self.modes @ moved.ravel()
        return np.asarray(polynomial_terms(scores[None])[0] @ self.weights)
