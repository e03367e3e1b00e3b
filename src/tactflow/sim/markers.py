"""Markers on the gel: their layout, and drawing with exact sub-pixel centres.

A marker is drawn by evaluating its blurred shape at each pixel's centre. Its edge is a logistic ramp of
`EDGE_BLUR_PX` standard deviation, similar to a Gaussian point spread function, and so smooth that sampling
shifts the centroid by less than 1e-3 px.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactflow.sim.settings import Settings

EDGE_BLUR_PX = 0.8
"""Standard deviation of the lens blur at a marker's edge, px. Chosen by hand."""
DARK_MARKER_ABSORPTION = 0.88
"""Fraction of light that a fresh dark marker absorbs. Chosen by hand."""
FIXED_POINT_STEPS = 64.0
"""Fixed-point steps per grey level: much finer than the noise, and 255 levels fit into 16 bits."""


@dataclass(frozen=True)
class Layout:
    """The markers printed on the gel.

    Attributes
    ----------
    rest : (N, 2) float64, positions on the untouched gel, px.
    contrast : (N,), 0 to 1, 1 for a fresh marker.
    group : (N,) int; markers of the same group never overlap.
    radii : (N,), px.
    pitch, radius : mean, px.
    """

    rest: NDArray[np.float64]
    contrast: NDArray[np.float64]
    group: NDArray[np.int64]
    radii: NDArray[np.float64]
    pitch: float
    radius: float


def layout(settings: Settings, size: tuple[int, int]) -> Layout:
    """A grid of markers, centred on a gel of size (width, height), px."""
    (columns, rows), (width, height) = settings.markers, size
    pitch = settings.pitch or min(width / ((columns or 10) + 0.7), height / ((rows or 8) + 0.7))
    rng = np.random.default_rng([settings.seed, 0x6D61])
    across = (np.arange(columns) - (columns - 1) / 2.0) * pitch + (width - 1) / 2.0
    down = (np.arange(rows) - (rows - 1) / 2.0) * pitch + (height - 1) / 2.0
    rest = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)
    # A random offset of a hundredth of a pitch, as in a real print, avoids special sub-pixel phases.
    rest = rest + rng.normal(0.0, 0.01, rest.shape) * pitch
    rest += np.clip(rng.normal(0.0, 1.0, rest.shape), -1.5, 1.5) * (settings.jitter * pitch)
    parity = np.stack(np.meshgrid(np.arange(columns) % 2, np.arange(rows) % 2), axis=-1).reshape(-1, 2)
    faded = rng.random(len(rest)) < settings.worn
    contrast = np.where(faded, rng.uniform(0.35, 0.8, len(rest)), 1.0)
    kept = rng.random(len(rest)) >= settings.missing
    group = (parity[:, 0] + 2 * parity[:, 1]).astype(np.int64)
    radius = settings.dot or 0.135 * pitch
    radii = radius * (1.0 + settings.sizes * rng.uniform(-1.0, 1.0, len(rest)))
    return Layout(rest[kept], contrast[kept], group[kept], radii[kept], pitch, radius)


def _ramp(inside: NDArray[np.float32]) -> NDArray[np.float32]:
    """Opacity at a distance inside a marker's edge, px; negative outside."""
    ramp = np.float32(0.5) + np.float32(0.5) * np.tanh(inside * np.float32(0.851 / EDGE_BLUR_PX))
    return np.asarray(ramp, np.float32)


def _coverage(
    x: NDArray[np.float32], y: NDArray[np.float32], r: NDArray[np.float32], shape: str
) -> NDArray[np.float32]:
    """Fraction of a pixel at offset (x, y), px, from a marker's centre that a marker of radius r covers."""
    if shape == "square":
        return _ramp(r - np.abs(x)) * _ramp(r - np.abs(y))
    if shape == "doubled":
        small = np.float32(0.72) * r
        left = _ramp(small - np.hypot(x + small, y))
        right = _ramp(small - np.hypot(x - small, y))
        return np.asarray(1 - (1 - left) * (1 - right), np.float32)
    return _ramp(r - np.hypot(x, y))


def half_patch(radius: float, shape: str, scale: float = 1.0) -> int:
    """Half the side of the square, px, outside which a marker is invisible."""
    extent = {"round": 1.0, "square": 1.4143, "doubled": 1.45}[shape]
    return int(np.ceil(radius * extent * scale + 5.0 * EDGE_BLUR_PX)) + 1


def draw(
    canvas: NDArray[np.int16],
    centers: NDArray[np.float64],
    strength: NDArray[np.float64],
    group: NDArray[np.int64],
    radii: NDArray[np.float64],
    *,
    half: int,
    shape: str = "round",
    bright: float | None = None,
    deform: NDArray[np.float64] | None = None,
) -> None:
    """Paint markers onto a padded canvas, in place.

    canvas : (H + 2 half, W + 2 half, 3) int16, grey levels times `FIXED_POINT_STEPS`. centers : (N, 2)
    positions without the padding, px. strength : (N,) opacity, 0 to 1. radii : (N,), px. half : see
    `half_patch`. bright : grey level of bright markers; None for dark ones. deform : (N, 2, 2), Jacobian
    from the image to the gel; None for the identity.
    """
    padded_height, padded_width = canvas.shape[:2]
    anchor = np.rint(centers).astype(np.int64)
    # A marker outside the frame may reach in. Indices beyond the padding are clamped to its invisible edge.
    reachable = np.all(anchor > -half, axis=1)
    reachable &= (anchor[:, 0] < padded_width - half) & (anchor[:, 1] < padded_height - half)
    span = np.arange(-half, half + 1)
    flat = canvas.reshape(-1, 3)
    for number in np.unique(group):
        chosen = np.flatnonzero(reachable & (group == number) & (strength > 0))
        if not len(chosen):
            continue
        fraction = (centers[chosen] - anchor[chosen]).astype(np.float32)
        dx = span.astype(np.float32)[None, None, :] - fraction[:, 0, None, None]
        dy = span.astype(np.float32)[None, :, None] - fraction[:, 1, None, None]
        if deform is not None:
            m = deform[chosen].astype(np.float32)[:, :, :, None, None]
            dx, dy = m[:, 0, 0] * dx + m[:, 0, 1] * dy, m[:, 1, 0] * dx + m[:, 1, 1] * dy
        radius = radii[chosen, None, None].astype(np.float32)
        opaque = _coverage(dx, dy, radius, shape) * strength[chosen].astype(np.float32)[:, None, None]
        rows = anchor[chosen, 1, None] + half + span
        columns = anchor[chosen, 0, None] + half + span
        np.clip(rows, 0, padded_height - 1, out=rows)
        np.clip(columns, 0, padded_width - 1, out=columns)
        index = (rows[:, :, None] * padded_width + columns[:, None, :]).ravel()
        opaque = opaque.reshape(-1, 1)
        under = flat[index].astype(np.float32)
        if bright is None:
            under *= np.float32(1.0) - np.float32(DARK_MARKER_ABSORPTION) * opaque
        else:
            under += (np.float32(bright * FIXED_POINT_STEPS) - under) * opaque
        flat[index] = np.rint(under, out=under).astype(np.int16)
