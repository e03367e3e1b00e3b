"""Imprint of an object: normals and heights of the gel in contact."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import cv2
import numpy as np

from tactflow.vision.arrays import Floats, Floats32, Indices, Mask
from tactflow.vision.pose.rigid import skew
from tactflow.vision.types import Scale

CELL_PX: Final = 3
"""Processed px per cell. With 2, edges are placed to 0.01 mm instead of 0.02, in half as much time again;
with 4, they turn by 0.26 degrees in error instead of 0.19."""
MARGIN_CELLS: Final = 2
"""Cells around a contact that are needed for gradients."""
MAX_CELLS: Final = 300
"""Largest number of cells of a template: neighbours share their errors, so that more only cost time."""
LIFT_OFF_DEPTH_FRACTION: Final = 0.3
"""Fraction of the greatest depth at which a gel leaves the object, between a thin layer (0) and a half-space
(0.5, Hertz). Shallower gel does not count, and gel twice as deep counts in full: the gel around a rolling
ball moves as if the ball slid. With 0.2, the error for such balls is 18 degrees instead of 2."""
RIM_CELLS: Final = 2.0
"""Width of the rim of a contact, cells, in which cells count less; the outermost, whose gradient includes
cells outside, does not count."""
PATCHES_PER_SIDE: Final = 5
"""Patches along each side of a contact, within which the errors of normals are common."""
MIN_PATCH_CELLS: Final = 2.0
"""Smallest side of such a patch, cells: that over which the gradients of heights and normals are averaged."""


class Imprint(NamedTuple):
    """The surface under a contact, in cells of `CELL_PX` x `CELL_PX` px.

    Attributes
    ----------
    planes : (h, w, 4) float32: x and y of the unit normal out of the gel, height above the untouched gel,
        mm (<= 0), weight in [0, 1], 0 outside the contact.
    first : (2,), x and y of the centre of the first cell, mm.
    cell : (2,), mm.
    area : cells with a weight.
    height : mean, mm.
    error : relative standard error of heights and slopes.
    """

    planes: Floats32
    first: Floats
    cell: Floats
    area: int
    height: float
    error: float


def imprint_of(heights: Floats32, mask: Mask, scale: Scale, error: float) -> Imprint | None:
    """The imprint in a frame; None without a cell in contact.

    heights : (H, W) float32, how far the gel is pushed in, mm. mask : (H, W) uint8, 255 in contact. error :
    relative standard error of the heights.
    """
    left, top, width, height = cv2.boundingRect(mask)
    left, top = (max(side // CELL_PX - MARGIN_CELLS, 0) * CELL_PX for side in (left, top))
    columns = min(width // CELL_PX + 2 * MARGIN_CELLS + 1, (mask.shape[1] - left) // CELL_PX)
    rows = min(height // CELL_PX + 2 * MARGIN_CELLS + 1, (mask.shape[0] - top) // CELL_PX)
    if min(rows, columns) < 2 * MARGIN_CELLS:
        return None
    part, size = (slice(top, top + rows * CELL_PX), slice(left, left + columns * CELL_PX)), (columns, rows)
    inside = np.zeros((rows + 2, columns + 2), np.uint8)
    inside[1:-1, 1:-1] = cv2.resize(mask[part], size, interpolation=cv2.INTER_AREA) == 255
    distance = cv2.distanceTransform(inside, cv2.DIST_L2, 3)[1:-1, 1:-1]
    cell = np.array([scale.x, scale.y]) * CELL_PX
    depth = np.asarray(cv2.resize(heights[part], size, interpolation=cv2.INTER_AREA), np.float32)
    across, down = _gradient(depth, cell)
    length = np.sqrt(across * across + down * down + 1)
    clings = np.clip(depth / max(LIFT_OFF_DEPTH_FRACTION * float(depth.max()), 1e-9) - 1, 0, 1)
    weight = np.clip((distance - 1) / RIM_CELLS, 0, 1) ** 2 * clings
    planes = np.asarray(cv2.merge((across / length, down / length, -depth, weight)), np.float32)
    area = int(np.count_nonzero(weight))
    middle = (CELL_PX - 1) / 2
    first = np.array(scale.point((left + middle, top + middle)))
    if not area:
        return None
    sunk = cv2.mean(depth, inside[1:-1, 1:-1])[0]
    return Imprint(planes, first, cell, area, -float(sunk), error)


def _gradient(values: Floats32, cell: Floats) -> tuple[Floats32, Floats32]:
    """Change of values (h, w) to the right and down, per mm, (h, w) each."""
    scale = 1 / (8 * cell)
    border = cv2.BORDER_REPLICATE
    across = cv2.Sobel(values, cv2.CV_32F, 1, 0, ksize=3, scale=scale[0], borderType=border)
    down = cv2.Sobel(values, cv2.CV_32F, 0, 1, ksize=3, scale=scale[1], borderType=border)
    return np.asarray(across, np.float32), np.asarray(down, np.float32)


class Template(NamedTuple):
    """An imprint that others are compared with; lengths in mm from `center`.

    Attributes
    ----------
    imprint : it.
    center : (3,), mean of its points.
    every : cells per point.
    points : (N, 6): where each is, x and y of its normal, its weight.
    blocks : (N,), the patch of each.
    by : (N, 3, 6): derivatives of x and y of each point's normal, and of its height, by a small motion.
    signal : standard deviation of x and y of the normals.
    levers : (6, 6), mean square displacement of the points along the gel by a small motion.
    """

    imprint: Imprint
    center: Floats
    every: int
    points: Floats
    blocks: Indices
    by: Floats
    signal: float
    levers: Floats


def template_of(imprint: Imprint) -> Template:
    """Prepare an imprint."""
    planes, cell = imprint.planes, imprint.cell
    rows, columns = np.nonzero(planes[..., 3])
    every = -(-len(rows) // MAX_CELLS)
    rows, columns = rows[::every], columns[::every]
    nx, ny, height, weights = planes[rows, columns].T.astype(np.float64)
    normals = np.column_stack([nx, ny, np.sqrt(1 - nx * nx - ny * ny)])
    points = np.column_stack([imprint.first + cell * np.column_stack([columns, rows]), height])
    center = points.mean(axis=0)
    points -= center
    moved = np.zeros((len(rows), 6, 3))
    moved[:, :3] = np.eye(3)
    moved[:, 3:] = skew(points)
    along = moved[..., :2]
    by = np.empty((len(rows), 3, 6))
    for axis in (0, 1):
        gradient = _gradient(np.ascontiguousarray(planes[..., axis]), cell)
        by[:, axis] = sum(along[..., k] * gradient[k][rows, columns, None] for k in (0, 1))
    by[:, :2, 3:] -= skew(normals)[..., :2].swapaxes(1, 2)
    by[:, 2] = (along @ (-normals[:, :2] / normals[:, 2:])[..., None])[..., 0] - moved[..., 2]
    weighted = along.swapaxes(1, 2).reshape(-1, 6)
    levers = (weighted.T * np.repeat(weights / weights.sum(), 2)) @ weighted
    blocks = _part(rows) * PATCHES_PER_SIDE + _part(columns)
    signal = math.sqrt(normals[:, :2].var(axis=0).mean())
    table = np.column_stack([points, normals[:, :2], weights])
    return Template(imprint, center, every, table, blocks, by, signal, levers)


def _part(places: Indices) -> Indices:
    """In which of `PATCHES_PER_SIDE` equal parts of their range each place lies."""
    low = places.min()
    return np.asarray(PATCHES_PER_SIDE * (places - low) // (places.max() - low + 1))
