"""How the picture of a contact has moved: registration of the change of light, by Gauss-Newton.

What an object does to the light of the gel moves with the object: its outline, its shading, its texture. The
markers are left out, since they move with the gel.

References
----------
S. Baker, I. Matthews, "Lucas-Kanade 20 years on: a unifying framework", IJCV 2004, for the gradients of the
template; H. White, "A heteroskedasticity-consistent covariance matrix estimator", Econometrica 1980, with
sums over patches, whose errors are common, for the covariance.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import cv2
import numpy as np

from tactflow.vision.arrays import ColorImage, Floats, Floats32, Indices, Mask

CELL: Final = 4
"""Processed px per side of a cell, over which the light is averaged."""
MARGIN: Final = 2
"""Cells around a contact that belong to its picture: the outline shows against the gel at rest."""
MOST: Final = 700
"""Cells of a template at most: neighbours share their errors, and more of them cost time alone."""
FEWEST: Final = 30
"""Cells of a template at least."""
PATCHES: Final = 5
"""Patches along each side of a template within which errors are taken for common."""
NOISE: Final = 1.0
"""Standard deviation of what is common to a patch and no motion, grey levels, at least."""
STEPS: Final = 12
"""Steps of Gauss-Newton at most."""
CONVERGED: Final = 0.01
"""Step after which it ends, cells."""
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

    center : (2,), mean of its cells. radius : RMS distance from it. away : (N, 2), cells, from the centre.
    light : (N, 3), grey levels. by : (N, 3, 5), what a small motion, and a gain, change the difference by.
    patches : (N,), the patch of each cell.
    """

    center: Floats
    radius: float
    away: Floats
    light: Floats
    by: Floats
    patches: Indices

    @property
    def place(self) -> Floats:
        """(2,), its centre, px."""
        return self.center * CELL + (CELL - 1) / 2


class Registration(NamedTuple):
    """A motion from a template to a picture.

    motion : (5,), shift (x, y) of the centre, turn from +x to +y and growth, as far as they move the cells at
    the RMS radius, cells; relative change of the contrast. covariance : (5, 5). residual : RMS difference,
    over the standard deviation of the change of light. seen : share of the template's cells.
    """

    motion: Floats
    covariance: Floats
    residual: float
    seen: float


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
    away = np.column_stack([columns, rows]).astype(np.float64)
    center = away.mean(axis=0)
    away -= center
    radius = math.sqrt((away * away).sum(axis=1).mean())
    light = change[..., :3]
    dx, dy = (
        cv2.Sobel(light, cv2.CV_32F, *axis, ksize=3, scale=1 / 8)[rows, columns] for axis in ((1, 0), (0, 1))
    )
    x, y = (away / radius).T[:, :, None]
    values = light[rows, columns].astype(np.float64)
    by = np.stack([dx, dy, x * dy - y * dx, x * dx + y * dy, -values], axis=-1)
    patches = _part(rows) * PATCHES + _part(columns)
    return Template(center, radius, away, values, by, patches)


def _part(places: Indices) -> Indices:
    """In which of `PATCHES` equal parts of their range each place lies."""
    low = places.min()
    return np.asarray(PATCHES * (places - low) // (places.max() - low + 1))


def register(
    template: Template, change: Floats32, start: Floats, expected: Floats, spread: Floats
) -> Registration | None:
    """The motion from a template to a picture; None where the picture does not show it.

    change : of `light_change`. start : (5,), first guess. expected, spread : (5,), mean and standard
    deviation of what is known beforehand; it decides where the picture tells nothing.
    """
    motion, prior = start, np.diag(spread**-2.0)
    for _ in range(STEPS):
        light, shown = _light_at(template, change, motion)
        count = float(shown.sum())
        if count < max(SEEN * len(shown), FEWEST):
            return None
        error = light - (1 + motion[4]) * template.light
        by = template.by * shown[:, None, None]
        power = float(np.vdot(error, error * shown[:, None])) / (3 * count)
        # As many independent errors as there are patches.
        weight = min(PATCHES**2 / count, 1.0) / max(power, NOISE**2)
        information = weight * np.tensordot(by, template.by, ([0, 1], [0, 1])) + prior
        gradient = weight * np.tensordot(by, error, ([0, 1], [0, 1])) + prior @ (motion - expected)
        step = -np.linalg.solve(information, gradient)
        turn = motion[2] / template.radius
        cos, sin = math.cos(turn), math.sin(turn)
        step[:2] = cos * step[0] - sin * step[1], sin * step[0] + cos * step[1]
        motion = motion + step
        if np.abs(step[:4]).max() < CONVERGED:
            break
    signal = float(np.sqrt(template.light[shown > 0].var(axis=0).mean()))
    residual = math.sqrt(power) / max(signal * (1 + motion[4]), 1e-3)
    if residual > UNLIKE:
        return None
    sums = _sums(weight * np.einsum("nci,nc->ni", by, error), template.patches)
    inverse = np.linalg.inv(information)
    covariance = inverse @ (sums.T @ sums + prior) @ inverse
    return Registration(motion, np.asarray(covariance, np.float64), residual, count / len(shown))


def _light_at(template: Template, change: Floats32, motion: Floats) -> tuple[Floats, Floats]:
    """(N, 3) and (N,): the light where the template's cells are after a motion, and 1 where it is known."""
    turn, growth = motion[2:4] / template.radius
    scale = math.exp(growth)
    cos, sin = scale * math.cos(turn), scale * math.sin(turn)
    places = template.away @ np.array([[cos, sin], [-sin, cos]]) + template.center + motion[:2]
    x, y = np.ascontiguousarray(places.T[:, :, None], np.float32)
    seen = cv2.remap(change, x, y, cv2.INTER_LINEAR)[:, 0].astype(np.float64)
    return seen[:, :3], (seen[:, 3] > 0.999).astype(np.float64)


def _sums(values: Floats, patches: Indices) -> Floats:
    """(PATCHES^2, K): sums of values (N, K) over patches."""
    return np.stack([np.bincount(patches, column, PATCHES**2) for column in values.T], axis=1)
