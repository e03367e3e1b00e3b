"""The rigid motion between two imprints of an object, by Gauss-Newton.

Three things are compared, each weighted by its own variance: the normals, the mean height, and the gel under
the contact, which sticks to the object. Normals alone do not see how a ball turns; the gel does.

References
----------
H.-J. Huang, M. Kaess, W. Yuan, "NormalFlow: Fast, Robust, and Accurate Contact-Based Object 6DoF Pose
Tracking With Vision-Based Tactile Sensors", RA-L 2025, for normals and mean height; W. A. Fuller,
"Measurement Error Models", 1987, for gradients that are noisy themselves.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from tactflow.vision.arrays import Flags, Floats, Indices
from tactflow.vision.pose.imprint import BLOCKS, PATCH, Imprint, Template
from tactflow.vision.pose.rigid import rigid, vector

STEPS: Final = 12
"""Steps of Gauss-Newton at most."""
CONVERGED: Final = 1e-4
"""Step after which it ends, mm and radians."""
FREE: Final = np.array([10.0, 10.0, 10.0, 1.0, 1.0, 1.0])
"""Standard deviation of a motion of which nothing is seen, mm and radians."""
NORMAL_NOISE: Final = 0.02
"""Standard deviation of what is common to the normals of a patch, 1 degree: weighs the parts before residuals
are known. Normals on other sensors of a kind err by 1 to 4 degrees, most of it alike in both imprints."""
HEIGHT_NOISE: Final = 0.005
"""Standard deviation of the change of mean height, mm, beside that from the scale of heights."""
FEWEST: Final = 12
"""Points of the template that both imprints must show."""


class Gel(NamedTuple):
    """Where the same bits of gel are in two frames.

    before, now : (M, 2), mm. share : (M,), how they count; the sum is 1. variance : of each coordinate of
    their mean displacement, mm^2. overlap : share of the gel in contact now that was before.
    """

    before: Floats
    now: Floats
    share: Floats
    variance: float
    overlap: float


class Alignment(NamedTuple):
    """A motion from a template to an imprint.

    motion : (4, 4), about the template's centre, mm. covariance : (6, 6), see `rigid`. overlap : share of the
    present contact that both show. misfit : sum of squares of the normals' differences, in units of their
    expected variances. residual : RMS difference of a normal's component. signal : standard deviation of the
    same over the template.
    """

    motion: Floats
    covariance: Floats
    overlap: float
    misfit: float
    residual: float
    signal: float


class _Part(NamedTuple):
    """Derivatives (M, 6), residuals (M,) and weights (M,)."""

    by: Floats
    error: Floats
    weight: Floats


def align(template: Template, now: Imprint, start: Floats, gel: Gel | None) -> Alignment | None:
    """The motion from a template to an imprint; None where they do not overlap.

    start : (4, 4), a first guess, about the template's centre.
    """
    motion = start
    anchored = [] if gel is None else [_anchored(template, now, gel)]
    for _ in range(STEPS):
        shown, normals, height = _seen(template, now, motion)
        if np.count_nonzero(shown) < FEWEST:
            return None
        parts = [normals, height, *(_gel_part(gel, points, motion) for gel, points in anchored)]
        information, gradient = np.diag(FREE**-2.0), vector(motion) / FREE**2
        for by, error, weight in parts:
            information += (by.T * weight) @ by
            gradient += by.T @ (weight * error)
        step = np.linalg.solve(information, -gradient)
        motion = motion @ rigid(step)
        if np.abs(step).max() < CONVERGED:
            break
    misfit = float(normals.weight @ normals.error**2)
    naive = (normals.by.T * normals.weight) @ normals.by
    noise = max(misfit, float(normals.weight.sum()) * NORMAL_NOISE**2)
    honest = _efficiency(normals, template.blocks[shown]) * _without_noise(naive, noise, template)
    return Alignment(
        motion,
        np.asarray(np.linalg.inv(information - naive + honest), np.float64),
        np.count_nonzero(shown) * template.every / now.area,
        misfit,
        math.sqrt(misfit / normals.weight.sum()),
        math.sqrt(template.normals[:, :2].var(axis=0).mean()),
    )


def _seen(template: Template, now: Imprint, motion: Floats) -> tuple[Flags, _Part, _Part]:
    """Which points (N,) both show; their normals and their mean height, in the template's axes."""
    turn, shift = motion[:3, :3], motion[:3, 3]
    moved = template.points @ turn.T + shift
    planes = now.at(moved[:, :2] + template.center[:2])
    shown = planes[:, 3] > 0
    nx, ny, height, weight = planes[shown].T
    share = template.weights[shown] * weight
    share /= max(float(share.sum()), 1e-9)
    across = np.column_stack([nx, ny, np.sqrt(np.maximum(1 - nx * nx - ny * ny, 0))]) @ turn[:, :2]
    patches = min(BLOCKS**2, np.count_nonzero(shown) * template.every / PATCH**2)
    normals = _Part(
        template.by_normal[:, shown].reshape(-1, 6),
        (across - template.normals[shown, :2]).T.ravel(),
        np.tile(share * patches / NORMAL_NOISE**2, 2),
    )
    height = height - template.center[2]
    before = template.points[shown, 2]
    back = (np.column_stack([moved[shown, :2], height]) - shift) @ turn[:, 2] - before
    variance = HEIGHT_NOISE**2 + (now.error * float(share @ (height - before))) ** 2
    by_height = share @ template.by_height[shown]
    return shown, normals, _Part(by_height[None], np.array([share @ back]), np.array([1 / variance]))


def _anchored(template: Template, now: Imprint, gel: Gel) -> tuple[Gel, tuple[Floats, Floats]]:
    """(M, 3) before and now, mm from the template's centre, at the mean height of both contacts: how the gel
    strains from the rim to the deepest point is not known."""
    before, after = (
        np.column_stack([places, np.full(len(places), gel.share @ imprint.at(places)[:, 2])])
        for imprint, places in ((template.imprint, gel.before), (now, gel.now))
    )
    return gel, (before - template.center, after - template.center)


def _gel_part(gel: Gel, points: tuple[Floats, Floats], motion: Floats) -> _Part:
    before, now = points
    error = ((now - motion[:3, 3]) @ motion[:3, :2]) - before[:, :2]
    by = np.zeros((2, len(before), 6))
    by[0, :, 0] = by[1, :, 1] = -1
    by[0, :, 4], by[0, :, 5] = -before[:, 2], before[:, 1]
    by[1, :, 3], by[1, :, 5] = before[:, 2], -before[:, 0]
    return _Part(by.reshape(-1, 6), error.T.ravel(), np.tile(gel.share / gel.variance, 2))


def _efficiency(normals: _Part, blocks: Indices) -> float:
    """Information of the normals over what their weights say, at most 1, from how far the sums over patches
    scatter."""
    weighted = (normals.weight * normals.error).reshape(2, -1)
    sums = np.stack([np.bincount(blocks, axis) for axis in weighted])
    expected = float(normals.weight.sum())
    return expected / max(float((sums**2).sum()), expected)


def _without_noise(information: Floats, misfit: float, template: Template) -> Floats:
    """Information (6, 6) less what the noise of the template's own gradients adds: where a surface is smooth,
    noise alone would seem to hold it in place. Half of the misfit is the template's."""
    patch = PATCH * math.sqrt(float(np.prod(template.imprint.cell)))
    values, axes = np.linalg.eigh(information - misfit / (2 * patch**2) * template.levers)
    return np.asarray((axes * np.maximum(values, 0)) @ axes.T)
