"""Changes of the light that are smooth over the whole frame, found although something touches the gel."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.contact.background_kernels import coarse_excess, fit_light

Float = NDArray[np.float32]

_BLOCK = 8
_CLIP = 2.0
_ROUNDS = 12
_SETTLED = 0.05
_RIDGE = 0.01


class LightChange:
    """Robust fit of gain, offset and plane per channel between a frame and the reference.

    The four unknowns of a channel are fitted to means over blocks of 8 x 8 cells by Huber's modified
    residuals: residuals are clipped to twice their standard deviation before each least-squares step, so
    that a contact, however strong, pulls no harder than noise would; the matrix of the step is known
    beforehand. The start is the median, so that a contact may cover nearly half of the frame. Planes and
    gains are drawn towards zero a little: on a gel lit from the side they are nearly the same thing, and
    large ones of opposite sign would follow any band or spot. Computed in float32, to 1e-3 grey levels of
    what float64 gives.

    References
    ----------
    P. J. Huber, "Robust Statistics", 1981, chapter 7.8.
    """

    def __init__(self, reference: Float, variance: Float) -> None:
        """reference, variance : (h, w, 3) float32, mean and variance of the cells of the untouched gel."""
        height, width = reference.shape[:2]
        self._blocks = (max(1, width // _BLOCK), max(1, height // _BLOCK))
        self._by_rows, self._by_columns = _shares(self._blocks[1], height), _shares(self._blocks[0], width)
        self._center: Float = np.asarray(reference.mean(axis=(0, 1)), np.float32)
        x = np.broadcast_to(np.linspace(-0.5, 0.5, width, dtype=np.float32), (height, width))
        y = np.broadcast_to(np.linspace(-0.5, 0.5, height, dtype=np.float32)[:, None], (height, width))
        shade = self.shade(reference)
        one = np.ones_like(x)
        channels = range(3)
        basis = np.stack([self._coarse(np.dstack([one, x, y, shade[..., c]])).T for c in channels])
        penalty = _RIDGE * basis.shape[2] * np.diag([0.0, 1.0, 1.0, 1.0])
        inverse = np.linalg.inv(basis @ basis.transpose(0, 2, 1) + penalty + 1e-6 * np.eye(4))
        self._basis: Float = np.ascontiguousarray(basis, np.float32)
        self._solve: Float = np.ascontiguousarray((inverse @ basis).transpose(0, 2, 1), np.float32)
        self._shrink: Float = np.ascontiguousarray((inverse @ penalty).transpose(0, 2, 1), np.float32)
        self._solve_planes: Float = np.ascontiguousarray(self._solve.transpose(0, 2, 1))
        self._reference = self._coarse(reference)
        self._planes: Float = np.ascontiguousarray(self._reference.T)
        limit = np.float32(_CLIP) * np.sqrt(self._coarse(variance)).T[:, None, :]
        self._limit: Float = np.ascontiguousarray(limit)
        self._lower: Float = -self._limit

    def shade(self, reference: Float) -> Float:
        """How the reference differs from its mean, relative: what a gain multiplies."""
        return np.asarray((reference - self._center) / np.maximum(self._center, 1), np.float32)

    def fit(self, cells: Float) -> Float:
        """(3, 4) float32: offset, slope along x and y (per frame) and gain of each channel, grey levels.

        cells : (h, w, 3) float32, the frame. The gain acts on `shade`.
        """
        excess = (self._coarse(cells) - self._reference).T[:, None, :]
        found = np.zeros((3, 1, 4), np.float32)
        found[..., 0] = np.sort(excess, axis=2)[..., excess.shape[2] // 2]
        for _ in range(_ROUNDS):
            residual = excess - found @ self._basis
            np.maximum(residual, self._lower, out=residual)
            np.minimum(residual, self._limit, out=residual)
            step = residual @ self._solve - found @ self._shrink
            found += step
            if max(float(step.max()), -float(step.min())) < _SETTLED:
                break
        return np.asarray(found[:, 0], np.float32)

    def fit_planes(self, planes: Float) -> Float:
        """The same by compiled loops. planes : (3, h, w) float32, the frame's channels."""
        excess = np.empty((3, self._reference.shape[0]), np.float32)
        coarse_excess(planes, self._by_rows, self._by_columns, self._planes, excess)
        found = np.zeros((3, 4), np.float32)
        found[:, 0] = np.sort(excess, axis=1)[:, excess.shape[1] // 2]
        limit = self._limit[:, 0]
        fit_light(excess, self._basis, self._solve_planes, self._shrink, limit, _ROUNDS, _SETTLED, found)
        return found

    def _coarse(self, cells: Float) -> Float:
        small = cv2.resize(np.ascontiguousarray(cells), self._blocks, interpolation=cv2.INTER_AREA)
        return np.asarray(small.reshape(-1, cells.shape[2]), np.float32)


def light_change(found: Float, shade: Float, rows: slice, columns: slice) -> Float:
    """(h, w, 3) float32: the change of the light over a window of the frame, grey levels.

    found : (3, 4) from `LightChange.fit`. shade : (H, W, 3) of the whole frame, at any resolution.
    rows, columns : the window.
    """
    height, width = shade.shape[:2]
    x, y = positions(width)[columns], positions(height)[rows]
    offset, along_x, along_y, gain = found.T
    change: Float = np.asarray(cv2.transform(shade[rows, columns], np.diag(gain)), np.float32)
    flat = change.reshape(y.size, -1)
    across = np.empty((2, x.size, 3), np.float32)
    across[0] = x[:, None] * along_x + offset
    across[1] = along_y
    down = np.ones((y.size, 2), np.float32)
    down[:, 1] = y
    # In place: memory for another picture costs more to get than to fill.
    cv2.gemm(down, across.reshape(2, -1), 1.0, flat, 1.0, dst=flat)
    return change


def _shares(blocks: int, count: int) -> Float:
    """(blocks, count) float32: which part of a block's mean each of `count` pixels in a row makes."""
    edges = np.arange(blocks + 1) * (count / blocks)
    pixels = np.arange(count)
    covered = np.minimum(edges[1:, None], pixels + 1) - np.maximum(edges[:-1, None], pixels)
    return np.asarray(np.maximum(covered, 0) * (blocks / count), np.float32)


@lru_cache(maxsize=16)
def positions(count: int) -> Float:
    """(count,) float32: where the pixels of a line are, -0.5 to 0.5; not to be written."""
    return np.linspace(-0.5, 0.5, count, dtype=np.float32)
