"""How the picture of a contact has moved: registration of the change of light, by Gauss-Newton.

The outline, shading and texture of an object move with it. The markers are left out, since they move with the
gel.

The covariance of a motion is that of least squares with considered parameters: the unevenness of the lamps is
not estimated, but its possible effect on the estimate counts. So the motion of a straight cable along itself,
which only its shading could show, stays as uncertain as the prior.

References
----------
J. Immerkaer, "Fast noise variance estimation", Computer Vision and Image Understanding 1996.
S. Baker, I. Matthews, "Lucas-Kanade 20 years on: a unifying framework", IJCV 2004, for the gradients of the
template.
B. D. Tapley, B. E. Schutz, G. H. Born, "Statistical orbit determination", 2004, ch. 6, for considered
parameters.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.arrays import MAD_TO_SIGMA, ColorImage, Floats, Floats32, Indices, Mask
from tactflow.vision.compiled import kernel
from tactflow.vision.geometry.downsample import cell_means

CELL_PX: Final = 4
"""Side of the cells over which the light is averaged, processed px."""
MARGIN_CELLS: Final = 2
"""Cells around a contact that belong to its picture, so that the outline stands out from the gel at rest."""
MAX_CELLS: Final = 500
"""Largest number of cells of a template: neighbours share their errors, so that more only cost time."""
MIN_CELLS: Final = 30
"""Smallest number of cells of a template."""
PATCH_COUNT: Final = 25
"""Approximate number of patches of a template, whose errors are independent; those of cells are not."""
ROUNDING_VARIANCE: Final = 1 / 6
"""Variance of the difference of two rounded grey levels."""
GRADIENT_VARIANCE_RATIO: Final = 3 / 16
"""Variance of a gradient over that of the light."""
LIGHT_STDDEV: Final = 0.05
"""Relative standard deviation of the effect of place and turn on the light of a contact: by how much it is
brighter at the RMS radius, and how much of one channel shows in another."""
MIN_INFORMATION: Final = 1e-6
"""Smallest information on a motion, so that it has an inverse."""
MAX_STEPS: Final = 12
"""Largest number of steps of Gauss-Newton."""
MIN_STEP_CELLS: Final = 0.05
"""Step at which the iteration ends, cells: the next one would be several times smaller."""
MIN_VISIBLE_SHARE: Final = 0.4
"""Smallest share of a template's cells that the picture must show."""
MAX_RESIDUAL: Final = 0.6
"""Residual, relative to the contrast of the picture, above which it shows something else."""


def light_change(unmarked: ColorImage, untouched: ColorImage, markers: Mask | None) -> Floats32:
    """(h, w, 4) float32: change of light in cells, grey levels, and 1 where no marker covers the cell, or 0.

    unmarked : (H, W, 3), without markers. untouched : (h, w, 3), `cells` of the gel. markers : (H, W), 255 on
    them; None: none.
    """
    light = cv2.subtract(cells(unmarked), untouched, dtype=cv2.CV_32F)
    hidden = np.zeros(light.shape[:2], np.uint8) if markers is None else cells(markers)
    return np.asarray(cv2.merge((light, (hidden == 0).astype(np.float32))), np.float32)


def cells(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(h, w, ...): means over cells of a picture (H, W, ...)."""
    return cell_means(picture, CELL_PX)


class Template(NamedTuple):
    """The picture of a contact, with which later ones are compared; lengths in cells.

    Attributes
    ----------
    center : (2,), mean of its cells.
    radius : RMS distance from it.
    moments : (2, 2), second moments of the cells.
    away : (N, 2) float32, from the centre.
    patches : (N,) int64, to which each cell belongs, in order.
    light : (N, 3) float32, grey levels.
    by : (N, 3, 5) float32, derivatives of the difference by a small motion and by a gain.
    power : (5, 5), sum of the products of `by`.
    lamps : (5, 5), covariance of the sum of `by` times the effect of the lamps.
    contrast : standard deviation of the light.
    noise : variance of the difference of the light of two pictures.
    """

    center: Floats
    radius: float
    moments: Floats
    away: Floats32
    patches: Indices
    light: Floats32
    by: Floats32
    power: Floats
    lamps: Floats
    contrast: float
    noise: float

    @property
    def place(self) -> complex:
        """Its centre, x + iy, px."""
        return complex(*(self.center * CELL_PX + (CELL_PX - 1) / 2).tolist())


class Registration(NamedTuple):
    """A motion from a template to a picture.

    Attributes
    ----------
    motion : (5,), shift (x, y) of the centre, turn from +x to +y and growth, as far as they move the cells
        at the RMS radius, cells; relative change of the contrast.
    covariance : (5, 5).
    error : (N, 3) float32, how the light differs then, grey levels, 0 where it is not seen.
    residual : standard deviation of the difference over that of the change of light.
    seen : share of the template's cells.
    """

    motion: Floats
    covariance: Floats
    error: Floats32
    residual: float
    seen: float


def template_of(change: Floats32, mask: Mask) -> Template | None:
    """Prepare the picture of a contact; None where it is too small.

    change : of `light_change`. mask : (H, W), 255 in contact.
    """
    inside = cv2.dilate(cells(mask), np.ones((2 * MARGIN_CELLS + 1, 2 * MARGIN_CELLS + 1), np.uint8))
    inside[change[..., 3] == 0] = 0
    inside[[0, -1]] = inside[:, [0, -1]] = 0
    rows, columns = np.nonzero(inside > 127)
    if len(rows) < MIN_CELLS:
        return None
    side = max(round(math.sqrt(len(rows) / PATCH_COUNT)), 1)
    every = -(-len(rows) // MAX_CELLS)
    rows, columns = rows[::every], columns[::every]
    patches = np.unique(rows // side * len(change[0]) + columns // side, return_inverse=True)[1]
    order = np.argsort(patches)
    rows, columns, patches = rows[order], columns[order], patches[order]
    places = np.column_stack([columns, rows])
    center = places.mean(axis=0)
    away = (places - center).astype(np.float32)
    moments = np.asarray(away.T @ away, np.float64) / len(away)
    radius = math.sqrt(np.trace(moments))
    light = np.ascontiguousarray(change[..., :3])
    dx, dy = (
        cv2.Sobel(light, cv2.CV_32F, *axis, ksize=3, scale=1 / 8)[rows, columns] for axis in ((1, 0), (0, 1))
    )
    x, y = (away / np.float32(radius)).T[:, :, None]
    values = light[rows, columns]
    by = np.stack([dx, dy, x * dy - y * dx, x * dx + y * dy, -values], axis=-1)
    flat = by.reshape(-1, 5)
    # Of each channel, a slope over x and over y, and a part of every channel.
    slopes = [by[:, channel].T @ (place * values)[:, [channel]] for place in (x, y) for channel in range(3)]
    mixtures = [by[:, channel].T @ values for channel in range(3)]
    lamps = LIGHT_STDDEV * np.hstack([*slopes, *mixtures]).astype(np.float64)
    return Template(
        center,
        radius,
        moments,
        away,
        patches,
        values,
        by,
        power=np.asarray(flat.T @ flat, np.float64),
        lamps=lamps @ lamps.T,
        contrast=float(np.sqrt(values.var(axis=0).mean())),
        noise=_noise(light),
    )


def _noise(light: Floats32) -> float:
    """Variance of the difference of two pictures like this one (h, w, 3), from Immerkaer's differences, which
    are 0 for a smooth picture: most of the gel is untouched."""
    line = np.array([1.0, -2.0, 1.0])
    # Neighbours are alike: every other one is enough.
    differences = np.abs(cv2.sepFilter2D(light, cv2.CV_32F, line, line)[1:-1:2, 1:-1:2])
    return max(2 * (MAD_TO_SIGMA * float(np.median(differences))) ** 2 / 36, ROUNDING_VARIANCE)


def register(
    template: Template, change: Floats32, start: Floats, expected: Floats, spread: Floats
) -> Registration | None:
    """The motion from a template to a picture; None where the picture does not show it.

    change : of `light_change`. start : (5,), first guess. expected, spread : (5,), mean and standard
    deviation of the prior, which decides where the picture has no information.
    """
    motion, prior = start, np.diag(spread**-2.0)
    error, sums, turned = np.empty_like(template.light), np.empty(10), np.eye(5)
    independent = 3 * (int(template.patches[-1]) + 1)
    for _ in range(MAX_STEPS):
        turn, growth = (motion[2:4] / template.radius).tolist()
        cos, sin = math.cos(turn), math.sin(turn)
        warp = np.array([*(math.exp(growth) * np.array([cos, sin])), *(template.center + motion[:2])])
        count = compare_light(
            change,
            warp,
            1 + motion[4],
            template.away,
            template.light,
            template.by,
            template.patches,
            error,
            sums,
        )
        if count < max(MIN_VISIBLE_SHARE * len(error), MIN_CELLS):
            return None
        power, alike = (sums[5:7] / (3 * count)).tolist()
        variance = max(power, alike * independent / max(independent - 5, 1), template.noise)
        information = template.power * (count / len(error) / variance)
        # Gradients are those of the template, which has turned since.
        turned[:2, :2] = [[cos, -sin], [sin, cos]]
        gradient = sums[:5] / variance + turned.T @ prior @ (motion - expected)
        step = -turned @ np.linalg.solve(information + prior, gradient)
        motion = motion + step
        if np.abs(step[:4]).max() < MIN_STEP_CELLS:
            break
    # A flicker of the lamps changes all cells alike: it does not count.
    unlike = math.sqrt(max(power - float(np.square(sums[7:] / count).mean()), 0.0))
    residual = unlike / max(template.contrast * (1 + float(motion[4])), 1e-3)
    if residual > MAX_RESIDUAL:
        return None
    # Gradients of noise carry no information, and those of what differs are wrong.
    gradients = 3 * count * GRADIENT_VARIANCE_RATIO / variance * np.diag([1.0, 1.0, 1.0, 1.0, 0.0])
    values, axes = np.linalg.eigh(information - template.noise * gradients)
    known = (axes * np.maximum(values, MIN_INFORMATION)) @ axes.T
    known = known @ np.linalg.solve(known + power * gradients + template.lamps / variance**2, known)
    covariance = np.linalg.inv(known + prior)
    covariance, known = (turned @ part @ turned.T for part in (covariance, known))
    motion = expected + covariance @ known @ (motion - expected)
    return Registration(motion, covariance, error, residual, count / len(error))


def shows(template: Template, change: Floats32) -> bool:
    """Whether a picture shows enough of a template's cells, where they are, to be compared: markers that have
    moved may cover them.

    change : of `light_change`.
    """
    free = change[..., 3] >= 1
    free[:-1, :-1] &= free[1:, :-1] & free[:-1, 1:] & free[1:, 1:]
    columns, rows = np.rint(template.away + template.center).astype(np.int64).T
    count = np.count_nonzero(free[rows, columns])
    return bool(count >= max(MIN_VISIBLE_SHARE * len(rows), MIN_CELLS))


@kernel
def compare_light(
    change: Floats32,
    warp: Floats,
    gain: float,
    away: Floats32,
    light: Floats32,
    by: Floats32,
    patches: Indices,
    error: Floats32,
    sums: Floats,
) -> int:
    """Difference of the light of a picture and a template that has moved; returns the number of visible
    cells, which neither the border nor a marker cuts.

    change : (h, w, 4), of `light_change`. warp : (4,): scale times cosine and sine of the turn, and where the
    centre is, cells. gain : factor of the light. away, light, by, patches : of a template.
    error : (N, 3), filled: picture less template, 0 where not visible. sums : (10,), filled: `by` times the
    error; its square; the squares of its sums over patches; the error of each channel.
    """
    x = warp[0] * away[:, 0] - warp[1] * away[:, 1] + warp[2]
    y = warp[1] * away[:, 0] + warp[0] * away[:, 1] + warp[3]
    high, wide = change.shape[0] - 1, change.shape[1] - 1
    inside = np.flatnonzero((x >= 0) & (x < wide) & (y >= 0) & (y < high))
    column, row = x[inside].astype(int), y[inside].astype(int)
    corners = [[change[row + k, column + j] for j in (0, 1)] for k in (0, 1)]
    shown = np.min([corner[:, 3] for line in corners for corner in line], axis=0) >= 1
    (upper, upper_right), (lower, lower_right) = ([corner[shown, :3] for corner in line] for line in corners)
    seen = inside[shown]
    right, down = (x[inside] - column)[shown, None], (y[inside] - row)[shown, None]
    above, below = upper + right * (upper_right - upper), lower + right * (lower_right - lower)
    rest = above + down * (below - above) - gain * light[seen]
    error[:] = 0
    error[seen] = rest
    sums[:5] = np.einsum("nck,nc->k", by[seen].astype(np.float64), rest)
    sums[5] = (rest * rest).sum()
    totals = np.zeros((int(patches.max(initial=0)) + 1, 3))
    np.add.at(totals, patches[seen], rest)
    sums[6] = (totals * totals).sum()
    sums[7:] = rest.sum(axis=0)
    return len(seen)
