"""Merge the patches of all keyframes into one surface.

References
----------
R. Kolluri, "Provably good moving least squares", SODA 2005: the surface is where the weighted mean of the
distances from the tangent planes of nearby points is 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tactflow.vision.arrays import Floats, Indices
from tactflow.vision.pose.align import HEIGHT_STDDEV_MM
from tactflow.vision.pose.rigid import inverse, skew

from .graph import Graph
from .keyframes import MIN_COSINE, Keyframe

NEIGHBOURS: Final = 32
"""Largest number of points that are averaged: those of ten patches, three each."""
REACH_CELLS: Final = 1.0
"""Standard deviation of the weights along the surface, cells: what one cell averages already."""
BLOCK_POINTS: Final = 10_000
"""Points that are moved at once, so that a large surface does not take much memory."""
STEPS: Final = 2
"""Steps of each point towards the surface; the second moves it by less than a tenth of the first."""


@dataclass(frozen=True)
class Points:
    """Points of a surface, in the axes of the object; lengths in mm.

    Attributes
    ----------
    place, normal : (N, 3); normals point out of the object.
    weight : (N,), > 0.
    error : (N,), standard error along the normal.
    shift : (N,), standard error along the surface.
    """

    place: Floats
    normal: Floats
    weight: Floats
    error: Floats
    shift: Floats

    def __len__(self) -> int:
        return len(self.place)

    def at(self, which: Indices | NDArray[np.bool_]) -> Points:
        """Some of the points."""
        return Points(*(getattr(self, field.name)[which] for field in fields(self)))


def patch(keyframe: Keyframe, pose: Floats, slope_error: float, covariance: Floats) -> Points:
    """What a keyframe shows of the object.

    pose : (4, 4), from the object to the sensor. slope_error : see `Graph`. covariance : (7, 7), of both.
    """
    imprint = keyframe.imprint
    rows, columns = np.nonzero(imprint.planes[..., 3])
    across, down, height, weight = imprint.planes[rows, columns].T.astype(np.float64)
    place = np.column_stack([imprint.first + imprint.cell * np.column_stack([columns, rows]), height])
    place[:, 2] *= 1 + slope_error
    # The object's surface looks towards the gel.
    upright = np.sqrt(np.maximum(1 - across**2 - down**2, 1e-6)) / (1 + slope_error)
    normal = -np.column_stack([across, down, upright])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    # (N, 3, 7): how the errors of the pose and of the slopes move each point.
    moves = np.zeros((len(place), 3, 7))
    moves[:, :, :3], moves[:, :, 3:6], moves[:, 2, 6] = -np.eye(3), skew(place), height
    along = np.einsum("ni,nij->nj", normal, moves)
    deviation = np.einsum("ni,ij,nj->n", along, covariance, along)
    total = np.einsum("nki,ij,nkj->n", moves, covariance, moves)
    back = inverse(pose)
    return Points(
        place @ back[:3, :3].T + back[:3, 3],
        normal @ back[:3, :3].T,
        weight,
        np.sqrt(deviation + HEIGHT_STDDEV_MM**2),
        np.sqrt(np.maximum(total - deviation, 0)),
    )


def merged(keyframes: Sequence[Keyframe], graph: Graph) -> Points:
    """The surface that all keyframes show together, a point in each cell of it.

    Patches are averaged with the inverse variances of their places. Since these have causes in common, such
    as the calibration, the mean has no smaller variance than they have on average; the scatter of the patches
    about it is added.
    """
    patches = []
    for index, (keyframe, pose) in enumerate(zip(keyframes, graph.poses, strict=True)):
        patches.append(patch(keyframe, pose, graph.slope_error, graph.covariance(index)))
    points = _joined(patches)
    cell = float(np.mean(keyframes[0].imprint.cell))
    places, normals = _per_cell(points.place, points.normal, cell)
    tree = cKDTree(points.place)
    for _ in range(STEPS):
        starts = range(0, len(places), BLOCK_POINTS)
        blocks = [slice(start, start + BLOCK_POINTS) for start in starts]
        found = _joined([_averaged(tree, points, places[one], normals[one], cell) for one in blocks])
        places, normals = found.place, found.normal
    kept = _one_per_cell(found.place, cell)
    return found.at(kept[found.weight[kept] > 0])


def _joined(parts: Sequence[Points]) -> Points:
    names = [field.name for field in fields(Points)]
    return Points(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def _averaged(tree: cKDTree, points: Points, places: Floats, normals: Floats, cell: float) -> Points:
    """Move places (M, 3) along their normals (M, 3) to the surface of nearby points."""
    _, near = tree.query(places, k=min(NEIGHBOURS, len(points)), workers=1)
    near = near.reshape(len(places), -1)
    away = places[:, None] - points.place[near]
    planes = points.normal[near]
    distance = np.einsum("nki,nki->nk", away, planes)
    along = np.sum(away * away, axis=2) - distance**2
    facing = np.einsum("nki,ni->nk", planes, normals)
    weight = points.weight[near] / points.error[near] ** 2
    weight *= np.exp(-along / (2 * (REACH_CELLS * cell) ** 2)) * (facing > MIN_COSINE)
    total = np.maximum(weight.sum(axis=1), 1e-30)
    share = weight / total[:, None]
    mean = np.sum(share * distance, axis=1)
    scatter = np.sum(share * (distance - mean[:, None]) ** 2, axis=1)
    normal = np.einsum("nk,nki->ni", share, planes)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    variance = np.sum(share * points.error[near] ** 2, axis=1) + scatter * np.sum(share**2, axis=1)
    shift = np.sqrt(np.sum(share * points.shift[near] ** 2, axis=1))
    seen = np.sum(points.weight[near] * (weight > 0), axis=1)
    return Points(places - mean[:, None] * normal, normal, seen, np.sqrt(variance), shift)


def _per_cell(places: Floats, normals: Floats, cell: float) -> tuple[Floats, Floats]:
    """Means of places and normals, (M, 3) each, over cubes of a cell; both sides of a thin object apart."""
    side = np.argmax(np.abs(normals), axis=1)
    sign = np.sign(np.take_along_axis(normals, side[:, None], axis=1)).astype(int)
    keys = np.concatenate([np.floor(places / cell).astype(int), side[:, None] * sign, sign], axis=1)
    _, cube, count = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    sums = [np.zeros((len(count), 3)) for _ in range(2)]
    for total, values in zip(sums, (places, normals), strict=True):
        np.add.at(total, cube.ravel(), values)
    return sums[0] / count[:, None], sums[1] / np.linalg.norm(sums[1], axis=1, keepdims=True)


def _one_per_cell(places: Floats, cell: float) -> Indices:
    """Indices of one place in each cube of a cell."""
    _, first = np.unique(np.floor(places / cell).astype(int), axis=0, return_index=True)
    return np.asarray(first, np.int64)
