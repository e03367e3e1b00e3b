"""The pose graph: where the object was in every keyframe, by least squares over measured motions.

References
----------
F. Lu, E. Milios, "Globally consistent range scan alignment for environment mapping", Autonomous Robots 1997;
T. D. Barfoot, "State Estimation for Robotics", 2017, ch. 9, for the Gauss-Newton step on rigid motions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import SuperLU, splu

from tactflow.vision.arrays import Floats, Indices
from tactflow.vision.pose.rigid import adjoint, inverse, rigid, skew, vector

from .keyframes import Edge

MAX_STEPS: Final = 20
"""Largest number of steps of Gauss-Newton; five are usual."""
MIN_STEP_STDERRS: Final = 0.01
"""Length of the last step, in standard errors."""
SMALL_RADIANS: Final = 1e-3
"""Angle below which a series with an error of its fourth power is used."""


@dataclass
class Graph:
    """Where the object was, and how wrong all slopes are.

    Slopes by the same calibration are wrong by the same factor, and so are all tilts. Where a loop is closed,
    this factor is found as well.

    Attributes
    ----------
    poses : N of (4, 4), mm: from the object to the sensor, in the axes of `Scale`. The object's own axes are
        those of the sensor in the keyframe `anchor`.
    slope_error : by how much all slopes and heights are too small, relative.
    edges : measured motions, N - 1 at least, that connect all keyframes.
    anchor : index of the keyframe whose pose is known.
    solver : factorised information (6 N - 5, 6 N - 5) of the errors e in true pose = rigid(e) @ pose of each
        keyframe but the anchor, mm and radians, and of `slope_error`.
    """

    poses: list[Floats]
    slope_error: float
    edges: list[Edge]
    anchor: int
    solver: SuperLU

    def covariance(self, *keyframes: int) -> Floats:
        """(6 K + 1, 6 K + 1): of the errors of the poses of K keyframes, and of `slope_error`."""
        places = np.concatenate([*(6 * index + np.arange(6) for index in keyframes), [6 * len(self.poses)]])
        known = (places // 6 == self.anchor) & (places < 6 * len(self.poses))
        rows = (places - 6 * (places > 6 * self.anchor + 5))[~known]
        unit = np.zeros((6 * len(self.poses) - 5, len(rows)))
        unit[rows, np.arange(len(rows))] = 1
        covariance = np.zeros((len(places), len(places)))
        covariance[np.ix_(~known, ~known)] = self.solver.solve(unit)[rows]
        return covariance

    def motion(self, before: int, now: int, covariance: Floats) -> Edge:
        """The motion between two keyframes, with the error that the slopes cause. covariance : of both."""
        motion = np.asarray(self.poses[now] @ inverse(self.poses[before]))
        by = _row(Edge(before, now, motion, np.eye(6), np.zeros(6)), self.poses, self.slope_error).by
        return Edge(before, now, motion, by @ covariance @ by.T, np.zeros(6))

    def contradiction(self, edge: Edge, covariance: Floats) -> float:
        """Squared distance of a new edge from this graph, in standard errors: chi squared with 6 degrees of
        freedom. covariance : of its keyframes."""
        row = _row(edge, self.poses, self.slope_error)
        expected = edge.covariance + row.by @ covariance @ row.by.T
        return float(row.error @ np.linalg.solve(expected, row.error))


class _Row(NamedTuple):
    """An edge at some poses: (6,) its error; (6, 13) its derivatives by the unknowns at these places."""

    error: Floats
    by: Floats
    places: Indices


def _row(edge: Edge, poses: Sequence[Floats], slope_error: float) -> _Row:
    motion = poses[edge.now] @ inverse(poses[edge.before])
    error = twist(motion @ inverse(edge.motion)) - slope_error * edge.by_slopes
    by = np.concatenate([-adjoint(motion), np.eye(6), -edge.by_slopes[:, None]], axis=1)
    part = np.arange(6)
    return _Row(error, by, np.concatenate([6 * edge.before + part, 6 * edge.now + part, [6 * len(poses)]]))


def twist(motion: Floats) -> Floats:
    """(6,): the logarithm of a motion (4, 4); for small ones the same as `vector`.

    Turns about a fixed axis are multiples of one twist, however large they are.
    """
    found = vector(motion)
    cross = skew(found[3:])
    angle = float(np.linalg.norm(found[3:]))
    part = 1 / 12 if angle < SMALL_RADIANS else (1 - angle / 2 / np.tan(angle / 2)) / angle**2
    return np.concatenate([(np.eye(3) - cross / 2 + part * cross @ cross) @ found[:3], found[3:]])


def spanning(edges: Sequence[Edge], anchor: int) -> list[Floats]:
    """First guesses of the poses: each from a neighbour's by one edge, beginning with the anchor.

    edges : N - 1 at least, that connect N keyframes.
    """
    steps: dict[int, list[tuple[int, Floats]]] = {anchor: []}
    for edge in edges:
        steps.setdefault(edge.before, []).append((edge.now, edge.motion))
        steps.setdefault(edge.now, []).append((edge.before, inverse(edge.motion)))
    poses, pending = {anchor: np.eye(4)}, [anchor]
    while pending:
        here = pending.pop()
        for there, motion in steps[here]:
            if there not in poses:
                poses[there] = motion @ poses[here]
                pending.append(there)
    return [poses[index] for index in range(len(poses))]


def optimised(
    poses: Sequence[Floats], edges: Sequence[Edge], anchor: int, slope_stderr: float, slope_error: float = 0.0
) -> Graph:
    """The most likely poses.

    poses, slope_error : N of (4, 4) and the relative error of slopes, first guesses; the pose of `anchor` is
        kept. edges : see `Graph`. slope_stderr : prior standard deviation of `slope_error`.
    """
    poses, size = list(poses), 6 * len(poses) + 1
    free = np.delete(np.arange(size), slice(6 * anchor, 6 * anchor + 6))
    for _ in range(MAX_STEPS):
        information, gradient = _normal_equations(poses, edges, slope_stderr, slope_error)
        solver = splu(information[free][:, free].tocsc())
        step = np.zeros(size)
        step[free] = -solver.solve(gradient[free])
        poses = [rigid(step[6 * k : 6 * k + 6]) @ pose for k, pose in enumerate(poses)]
        slope_error += step[-1]
        if step @ (information @ step) < MIN_STEP_STDERRS**2 * size:
            break
    return Graph(poses, float(slope_error), list(edges), anchor, solver)


def _normal_equations(
    poses: Sequence[Floats], edges: Sequence[Edge], slope_stderr: float, slope_error: float
) -> tuple[sparse.csr_array, Floats]:
    """Information (6 N + 1, 6 N + 1) and gradient (6 N + 1,) at these poses."""
    size = 6 * len(poses) + 1
    rows, columns, values = [np.array([size - 1])], [np.array([size - 1])], [np.array([slope_stderr**-2])]
    gradient = np.zeros(size)
    gradient[-1] = slope_error / slope_stderr**2
    for edge in edges:
        row = _row(edge, poses, slope_error)
        weighted = row.by.T @ np.linalg.inv(edge.covariance)
        gradient[row.places] += weighted @ row.error
        rows.append(np.repeat(row.places, len(row.places)))
        columns.append(np.tile(row.places, len(row.places)))
        values.append((weighted @ row.by).ravel())
    entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
    return sparse.csr_array(entries, shape=(size, size)), gradient
