"""How the picture of a contact has moved: registration of the change of light, by Gauss-Newton.

What an object does to the light of the gel moves with the object: its outline, its shading, its texture. The
markers are left out, since they move with the gel.

References
----------
S. Baker, I. Matthews, "Lucas-Kanade 20 years on: a unifying framework", IJCV 2004, for the gradients of the
template.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import cv2
import numpy as np

from tactflow.vision.arrays import ColorImage, Flags, Floats, Floats32, Mask

CELL: Final = 4
"""Processed px per side of a cell, over which the light is averaged."""
MARGIN: Final = 2
"""Cells around a contact that belong to its picture: the outline shows against the gel at rest."""
MOST: Final = 500
"""Cells of a template at most: neighbours share their errors, and more of them cost time alone."""
FEWEST: Final = 30
"""Cells of a template at least."""
PATCHES: Final = 25
"""Independent errors of a template: those of neighbouring cells are common."""
NOISE: Final = 1.0
"""Standard deviation of what is common to a patch and no motion, grey levels, at least."""
UNEVEN: Final = 0.05
"""How unevenly the lamps light the gel around a contact, relative: what moves becomes brighter or darker."""
ELSE: Final = 0.2
"""Part of a growth or a change of contrast that the picture shows in other ways: a cable that is pressed
harder grows across, but not along."""
STEPS: Final = 12
"""Steps of Gauss-Newton at most."""
CONVERGED: Final = 0.01
"""Step after which it ends, cells."""
KNOWN: Final = 0.999
"""Weight of a picture from which on no marker has part in it."""
SEEN: Final = 0.4
"""Share of a template's cells that the picture must show."""
UNLIKE: Final = 0.6
"""Residual relative to the contrast of the picture from which on a picture shows something else."""


def light_change(unmarked: ColorImage, untouched: Floats32, markers: Mask | None) -> Floats32:
    """(h, w, 4) float32: change of light in cells, grey levels, and 1 where no marker covers the cell, or 0.

    unmarked : (H, W, 3), without markers. untouched : of `cells`. markers : (H, W), 255 on them; None: none.
    """
    change = np.ones((*untouched.shape[:2], 4), np.float32)
    change[..., :3] = cells(unmarked)
    change[..., :3] -= untouched
    if markers is not None:
        change[..., 3] = cells(markers) == 0
    return change


def cells(picture: ColorImage | Mask) -> Floats32:
    """(h, w, ...) float32, means over cells; what is left over at the right and below is not looked at."""
    rows, columns = picture.shape[0] // CELL, picture.shape[1] // CELL
    whole = picture[: rows * CELL, : columns * CELL]
    return np.asarray(cv2.resize(whole, (columns, rows), interpolation=cv2.INTER_AREA), np.float32)


class Template(NamedTuple):
    """The picture of a contact, with which later ones are compared; lengths in cells.

    center : (2,), mean of its cells. radius : RMS distance from it. away : (N, 2) float32, from the centre.
    light : (N, 3) float32, grey levels. by : (3 N, 5) float32, what a small motion, and a gain, change the
    difference by. power : (5, 5), by.T @ by. contrast : standard deviation of the light.
    """

    center: Floats
    radius: float
    away: Floats32
    light: Floats32
    by: Floats32
    power: Floats
    contrast: float

    @property
    def place(self) -> complex:
        """Its centre, x + iy, px."""
        return complex(*(self.center * CELL + (CELL - 1) / 2).tolist())


class Registration(NamedTuple):
    """A motion from a template to a picture.

    motion : (5,), shift (x, y) of the centre, turn from +x to +y and growth, as far as they move the cells at
    the RMS radius, cells; relative change of the contrast. covariance : (5, 5). residual : standard
    deviation of the difference over that of the change of light. seen : share of the template's cells.
    fresh : part of the variance that the next frame does not share.
    """

    motion: Floats
    covariance: Floats
    residual: float
    seen: float
    fresh: float


def template_of(change: Floats32, mask: Mask) -> Template | None:
    """Prepare the picture of a contact; None where it is too small.

    change : of `light_change`. mask : (H, W), 255 in contact.
    """
    inside = cv2.dilate(cells(mask), np.ones((2 * MARGIN + 1, 2 * MARGIN + 1), np.uint8))
    inside[change[..., 3] == 0] = 0
    inside[[0, -1]] = inside[:, [0, -1]] = 0
    rows, columns = np.nonzero(inside > 127)
    if len(rows) < FEWEST:
        return None
    every = -(-len(rows) // MOST)
    rows, columns = rows[::every], columns[::every]
    places = np.column_stack([columns, rows])
    center = places.mean(axis=0)
    away = (places - center).astype(np.float32)
    radius = math.sqrt((away * away).sum(axis=1).mean())
    light = change[..., :3]
    dx, dy = (
        cv2.Sobel(light, cv2.CV_32F, *axis, ksize=3, scale=1 / 8)[rows, columns] for axis in ((1, 0), (0, 1))
    )
    x, y = (away / np.float32(radius)).T[:, :, None]
    values = light[rows, columns]
    by = np.stack([dx, dy, x * dy - y * dx, x * dx + y * dy, -values], axis=-1).reshape(-1, 5)
    power = np.asarray(by.T @ by, np.float64)
    contrast = float(np.sqrt(values.var(axis=0).mean()))
    return Template(center, radius, away, values, by, power, contrast)


def register(
    template: Template, change: Floats32, start: Floats, expected: Floats, spread: Floats
) -> Registration | None:
    """The motion from a template to a picture; None where the picture does not show it.

    change : of `light_change`. start : (5,), first guess. expected, spread : (5,), mean and standard
    deviation of what is known beforehand; it decides where the picture tells nothing.
    """
    motion, prior = start, np.diag(spread**-2.0)
    for _ in range(STEPS):
        error, shown = _difference(template, change, motion)
        count = int(np.count_nonzero(shown))
        if count < max(SEEN * len(shown), FEWEST):
            return None
        power = float(np.vdot(error, error)) / (3 * count)
        shaded = UNEVEN + ELSE * (abs(float(motion[3])) / template.radius + abs(float(motion[4])))
        shaded = (shaded * template.contrast) ** 2
        # As many independent errors as there are patches.
        weight = min(PATCHES / count, 1.0) / (power + NOISE**2 + shaded)
        gradient = weight * (template.by.T @ error.ravel()) + prior @ (motion - expected)
        step = -np.linalg.solve(weight * count / len(shown) * template.power + prior, gradient)
        turn = motion[2] / template.radius
        cos, sin = math.cos(turn), math.sin(turn)
        step[:2] = cos * step[0] - sin * step[1], sin * step[0] + cos * step[1]
        motion = motion + step
        if np.abs(step[:4]).max() < CONVERGED:
            break
    # Lamps that flicker change all of it alike.
    unlike = math.sqrt(float(error[shown].var(axis=0).mean()))
    residual = unlike / max(template.contrast * (1 + float(motion[4])), 1e-3)
    if residual > UNLIKE:
        return None
    seen = template.by.reshape(-1, 3, 5)[shown].reshape(-1, 5)
    covariance = np.linalg.inv(weight * (seen.T @ seen) + prior)
    fresh = 1 - shaded / (power + NOISE**2 + shaded)
    return Registration(motion, np.asarray(covariance, np.float64), residual, count / len(shown), fresh)


def _difference(template: Template, change: Floats32, motion: Floats) -> tuple[Floats32, Flags]:
    """(N, 3) float32 and (N,): how the light where the template's cells are after a motion differs from its
    own, 0 where it is not known; where it is."""
    turn, growth = (motion[2:4] / template.radius).tolist()
    scale = math.exp(growth)
    cos, sin = scale * math.cos(turn), scale * math.sin(turn)
    x, y = template.away.T
    left, top = (template.center + motion[:2]).tolist()
    columns, rows = (cos * x - sin * y + left)[:, None], (sin * x + cos * y + top)[:, None]
    light = cv2.remap(change, columns, rows, cv2.INTER_LINEAR)[:, 0]
    shown = np.asarray(light[:, 3] > KNOWN)
    error = light[:, :3] - np.float32(1 + motion[4]) * template.light
    error[~shown] = 0
    return error, shown
