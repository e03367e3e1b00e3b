"""The rigid motion between two imprints of an object, by Gauss-Newton.

The normals, the mean height, and the gel under the contact, which sticks to the object, are compared, each
weighted by its variance. Normals alone do not show how a ball turns; the gel does.

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

from tactflow.vision.arrays import Floats, Floats32, Indices
from tactflow.vision.compiled import kernel
from tactflow.vision.pose.imprint import MIN_PATCH_CELLS, PATCHES_PER_SIDE, Imprint, Template
from tactflow.vision.pose.rigid import rigid, vector

MAX_STEPS: Final = 12
"""Largest number of steps of Gauss-Newton."""
MIN_STEP_STDERRS: Final = 0.3
"""Length of the last step, in standard errors: it need not be tested."""
MOTION_PRIOR_STDDEV: Final = np.array([10.0, 10.0, 10.0, 1.0, 1.0, 1.0])
"""Prior standard deviation of a motion, mm and radians."""
PRIOR_ROWS: Final = np.column_stack([np.diag(1 / MOTION_PRIOR_STDDEV), np.zeros(6)])
"""(6, 7): rows of the system, see `_Comparison`, for the prior; errors are 0."""
NORMAL_STDDEV_RAD: Final = 0.02
"""Standard deviation of the common error of the normals of a patch, 1 degree: weights the parts before
residuals are known. Normals on other sensors of a kind err by 1 to 4 degrees, mostly alike in both
imprints."""
HEIGHT_STDDEV_MM: Final = 0.005
"""Standard deviation of the change of mean height, mm, in addition to that from the scale of heights."""
MIN_POINTS: Final = 12
"""Smallest number of points of the template that both imprints show."""


class Gel(NamedTuple):
    """The best rigid motion in the plane of the gel that is in contact in two frames.

    Attributes
    ----------
    before, now : its middle, x + iy, mm.
    turn : radians.
    variance : of each coordinate of `now`, mm^2.
    spread : mean square distance of the gel from its middle, mm^2; the variance of `turn` is variance /
        spread.
    overlap : share of the gel in contact now that was in contact before.
    """

    before: complex
    now: complex
    turn: float
    variance: float
    spread: float
    overlap: float


class Alignment(NamedTuple):
    """A motion from a template to an imprint.

    Attributes
    ----------
    motion : (4, 4), about the template's centre, mm.
    covariance : (6, 6), see `rigid`.
    overlap : share of the present contact that both show.
    misfit : sum of squares of the normals' differences, over their expected variances.
    residual : RMS difference of a normal's component.
    """

    motion: Floats
    covariance: Floats
    overlap: float
    misfit: float
    residual: float


class _Comparison(NamedTuple):
    """Imprints at one motion.

    Attributes
    ----------
    shown : number of points that both show.
    error, weight : (N, 2), (N,), of their normals.
    by_normals : (6, 6), their information.
    system : (7, 7), normal equations: the sum of the outer products of rows of six derivatives and an
        error, over standard deviations. So it holds the information (6, 6), the gradient (6,), and in the
        corner the sum of squares.
    """

    shown: int
    error: Floats
    weight: Floats
    by_normals: Floats
    system: Floats


def align(template: Template, now: Imprint, start: Floats, gel: Gel | None) -> Alignment | None:
    """The motion from a template to an imprint; None where they do not overlap.

    start : (4, 4), a first guess, about the template's centre.
    """
    # Rounding errors of a matrix that is passed from frame to frame would add up.
    motion = rigid(vector(start))
    found = _compared(template, now, motion, gel)
    if found is None:
        return None
    scale = 1.0
    for _ in range(MAX_STEPS):
        information = found.system[:6, :6]
        step = np.asarray(scale * np.linalg.solve(information, -found.system[:6, 6]), np.float64)
        tried = motion @ rigid(step)
        if step @ information @ step < MIN_STEP_STDERRS**2:
            motion = tried
            break
        better = _compared(template, now, tried, gel)
        if better is None or better.system[6, 6] > found.system[6, 6]:
            # The step is too long for a linear change of the normals.
            scale /= 2
        else:
            motion, found, scale = tried, better, 1.0
    total = float(found.weight.sum())
    misfit = float(found.weight @ (found.error**2).sum(axis=1))
    noise = max(misfit, 2 * total * NORMAL_STDDEV_RAD**2)
    honest = _efficiency(found, template.blocks) * _without_noise(found.by_normals, noise, template)
    return Alignment(
        motion,
        np.asarray(np.linalg.inv(found.system[:6, :6] - found.by_normals + honest), np.float64),
        found.shown * template.every / now.area,
        misfit,
        math.sqrt(misfit / (2 * total)),
    )


def _compared(template: Template, now: Imprint, motion: Floats, gel: Gel | None) -> _Comparison | None:
    """Both imprints at a motion; None where they do not overlap."""
    count = len(template.points)
    error, weight = np.zeros((count, 2)), np.zeros(count)
    normals, height, totals = np.zeros((7, 7)), np.zeros(8), np.zeros(2)
    first = now.first - template.center[:2]
    compare_points(
        now.planes, first, now.cell, motion, template.points, template.by, template.center[2],
        error, weight, normals, height, totals,
    )  # fmt: skip
    shown, mean = int(totals[0]), height / totals[1] if totals[1] else height
    if shown < MIN_POINTS:
        return None
    patches = min(PATCHES_PER_SIDE**2, shown * template.every / MIN_PATCH_CELLS**2)
    unit = patches / (NORMAL_STDDEV_RAD**2 * totals[1])
    normals *= unit
    weight *= unit
    rows = np.empty((7 if gel is None else 10, 7))
    rows[:6] = PRIOR_ROWS
    rows[:6, 6] = vector(motion) / MOTION_PRIOR_STDDEV
    rows[6] = mean[:7] / math.hypot(HEIGHT_STDDEV_MM, now.error * mean[7])
    if gel is not None:
        rows[7:] = _gel_rows(template, now, gel, motion)
    return _Comparison(shown, error, weight, normals[:6, :6], normals + rows.T @ rows)


@kernel
def compare_points(
    planes: Floats32,
    first: Floats,
    cell: Floats,
    motion: Floats,
    points: Floats,
    by: Floats,
    middle: float,
    error: Floats,
    weight: Floats,
    normals: Floats,
    height: Floats,
    totals: Floats,
) -> None:
    """Compare an imprint with the points of a template at a motion (4, 4).

    planes, cell : of the imprint. first : (2,), its first cell from the centre of the template, mm. points,
    by : of the template. middle : height of its centre, mm.
    error : (N, 2) of 0, filled: of the normals. weight : (N,) of 0, filled. Both stay 0 where the imprint
        does not show a point.
    normals : (7, 7) of 0, filled: the system of the normals, see `_Comparison`, by these weights.
    height, totals : (8,) and (2,) of 0, to which sums over weighted points are added: of the derivatives of
        the height, of its error, and of how far points have sunk; how many points are shown, their weights.
    """
    turn, shift = motion[:3, :3], motion[:3, 3]
    moved = points[:, :3] @ turn[:2].T
    at = (moved + shift[:2] - first) / cell
    high, wide = planes.shape[0] - 1, planes.shape[1] - 1
    those = np.flatnonzero(((at >= 0) & (at < (wide, high))).all(axis=1))
    left, top = at[those].astype(int).T
    right, low = (at[those] - np.column_stack([left, top])).T[:, :, None]
    above = (1 - right) * planes[top, left] + right * planes[top, left + 1]
    below = (1 - right) * planes[top + 1, left] + right * planes[top + 1, left + 1]
    seen = (1 - low) * above + low * below
    share = points[those, 5] * seen[:, 3]
    those, seen, share = those[share > 0], seen[share > 0], share[share > 0]
    upright = np.sqrt(np.maximum(1 - (seen[:, :2] ** 2).sum(axis=1), 0))
    error[those] = np.column_stack([seen[:, :2], upright]) @ turn[:, :2] - points[those, 3:5]
    weight[those] = share
    rows = np.concatenate([by[those, :2], error[those][:, :, None]], axis=2)
    normals += np.einsum("n,nki,nkj->ij", share, rows, rows)
    depth = seen[:, 2] - middle - shift[2]
    height[:6] += share @ by[those, 2]
    height[6] += share @ (np.column_stack([moved[those], depth]) @ turn[:, 2] - points[those, 2])
    height[7] += share @ (depth - points[those, 2])
    totals += len(those), share.sum()


def _gel_rows(template: Template, now: Imprint, gel: Gel, motion: Floats) -> Floats:
    """(3, 7): rows of the system for the gel, at the mean height of both contacts, since its strain from the
    rim to the deepest point is not known."""
    turn = motion[:3, :3]
    x, y, z = np.array([gel.before.real, gel.before.imag, template.imprint.height]) - template.center
    after = np.array([gel.now.real, gel.now.imag, now.height]) - template.center
    right, down = (after - motion[:3, 3]) @ turn[:, :2] - (x, y)
    yaw = math.atan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])
    lever, turned = math.sqrt(gel.spread), math.remainder(yaw - gel.turn, math.tau)
    rows = [[-1, 0, 0, 0, -z, y, right], [0, -1, 0, z, 0, -x, down], [0, 0, 0, 0, 0, lever, lever * turned]]
    return np.array(rows) / math.sqrt(gel.variance)


def _efficiency(found: _Comparison, blocks: Indices) -> float:
    """Information of the normals over that by their weights, at most 1, from the scatter of sums over
    patches."""
    weighted = found.weight[:, None] * found.error
    squares = sum(float((np.bincount(blocks, axis) ** 2).sum()) for axis in weighted.T)
    expected = 2 * float(found.weight.sum())
    return expected / max(squares, expected)


def _without_noise(information: Floats, misfit: float, template: Template) -> Floats:
    """Information (6, 6) less that of the noise in the template's gradients, which would seem to hold a
    smooth surface in place. Half of the misfit is the template's."""
    patch = MIN_PATCH_CELLS * math.sqrt(float(np.prod(template.imprint.cell)))
    values, axes = np.linalg.eigh(information - misfit / (2 * patch**2) * template.levers)
    return np.asarray((axes * np.maximum(values, 0)) @ axes.T)
