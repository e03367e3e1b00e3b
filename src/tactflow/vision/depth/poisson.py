"""The surface that has given slopes."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.compiled import helper, kernel

Float = NDArray[np.float32]


def integrate(slope: Float, step: tuple[float, float]) -> Float:
    """Heights whose slopes come closest to the given ones, in least squares, up to a constant.

    Poisson's equation with free borders. The cosine transform of the rows leaves one equation for each column
    of it, which elimination solves. The transform is the Fourier transform of a row's even pixels and then
    its odd ones from behind. OpenCV's own takes four times as long where a side is no power of two.

    Parameters
    ----------
    slope : (2, h, w) float32, growth to the right and down; quick where w is a product of 2, 3 and 5.
    step : from a pixel to the next one, to the right and down, in the unit of the heights.

    Returns
    -------
    (h, w) float32; the mean of the last row is 0.

    References
    ----------
    T. Simchony, R. Chellappa, M. Shao, "Direct analytical methods for solving Poisson equations in computer
    vision problems", PAMI 12 (1990); R. Hockney, "A fast direct solution of Poisson's equation using Fourier
    analysis", JACM 12 (1965); J. Makhoul, "A fast cosine transform in one and two dimensions", ASSP 28
    (1980).

    Examples
    --------
    >>> slope = np.stack([np.full((4, 6), 2, np.float32), np.zeros((4, 6), np.float32)])
    >>> np.round(integrate(slope, (0.5, 0.5))[0], 3).tolist()
    [-2.5, -1.5, -0.5, 0.5, 1.5, 2.5]
    """
    divergence = _divergence(slope, step)
    width = divergence.shape[1]
    folded = np.concatenate([divergence[:, ::2], divergence[:, 1::2][:, ::-1]], axis=1)
    spectrum = np.asarray(cv2.dft(folded, flags=cv2.DFT_ROWS), np.float32)
    solve_columns(spectrum, *_frequencies(width))
    folded = np.asarray(cv2.idft(spectrum, flags=cv2.DFT_ROWS | cv2.DFT_SCALE), np.float32)
    heights = np.empty_like(folded)
    even = (width + 1) // 2
    heights[:, ::2], heights[:, 1::2] = folded[:, :even], folded[:, even:][:, ::-1]
    return heights


@lru_cache(maxsize=64)
def _frequencies(width: int) -> tuple[Float, Float]:
    """What `solve_columns` needs to know of rows of `width` pixels: (width,) stiffness, (2, pairs) turn."""
    pairs = np.arange(1, (width + 1) // 2)
    order = np.zeros(width)
    order[1 : 2 * len(pairs) : 2], order[2 : 2 * len(pairs) + 1 : 2] = pairs, width - pairs
    if width % 2 == 0:
        order[-1] = width / 2
    angle = np.pi * pairs / (2 * width)
    turn = np.stack([np.cos(angle), np.sin(angle)])
    return np.asarray(2 - 2 * np.cos(np.pi * order / width), np.float32), np.asarray(turn, np.float32)


def _divergence(slope: Float, step: tuple[float, float]) -> Float:
    """(h, w): by how much more the surface rises behind each pixel than before it.

    Between two pixels it rises by the mean of their slopes, beyond the border not at all.
    """
    slope_x, slope_y = slope
    across = (slope_x[:, 1:] + slope_x[:, :-1]) * np.float32(step[0] / 2)
    down = (slope_y[1:] + slope_y[:-1]) * np.float32(step[1] / 2)
    divergence = np.zeros(slope_x.shape, np.float32)
    divergence[:, :-1] += across
    divergence[:, 1:] -= across
    divergence[:-1] += down
    divergence[1:] -= down
    return divergence


@kernel("void(float32[:, ::1], float32[::1], float32[:, ::1])")
def solve_columns(values: Float, stiffness: Float, turn: Float) -> None:
    """Solve u[y - 1] - 2 u[y] + u[y + 1] - s u[y] = v[y], with free ends, for each column, in place.

    values : (h, w), rows of Fourier coefficients as OpenCV packs them: a real one, then pairs of a real and
    an imaginary part. stiffness : (w,), s >= 0 of each column; of the first it is 0, and u is known up to a
    constant: its last value is 0. turn : (2, pairs), for `_mirror`.

    Gauss's elimination of a tridiagonal matrix (Thomas's algorithm). Of each pivot only what it is beyond 1
    is kept, so that a small s is not lost.
    """
    height, width = values.shape
    pivots = np.empty((height, width), np.float32)
    beyond, carried = np.empty(width, np.float32), np.empty(width, np.float32)
    beyond[:] = carried[:] = 0
    one = np.float32(1)
    _mirror(values, turn)
    for y in range(height):
        line, pivot = values[y], pivots[y]
        # The last row has no neighbour below, so its pivot is smaller by 1; a trace of it is left where there
        # is nothing else to divide by.
        more = one if y < height - 1 else np.float32(1e-9)
        for x in range(width):
            rest = beyond[x] + stiffness[x]
            pivot[x] = one / (more + rest)
            beyond[x] = rest * pivot[x]
            carried[x] = (carried[x] - line[x]) * pivot[x]
            line[x] = carried[x]
    values[height - 1, 0] = 0
    for y in range(height - 2, -1, -1):
        line, below, pivot = values[y], values[y + 1], pivots[y]
        for x in range(width):
            line[x] += pivot[x] * below[x]
    _mirror(values, turn)


@helper
def _mirror(values: Float, turn: Float) -> None:
    """Make pairs of Fourier coefficients two coefficients of the cosine transform each, or back, in place.

    turn : (2, pairs), cosine and sine of the angle of the mirror.
    """
    for y in range(values.shape[0]):
        line = values[y]
        for k in range(turn.shape[1]):
            one, other = line[2 * k + 1], line[2 * k + 2]
            line[2 * k + 1] = turn[0, k] * one + turn[1, k] * other
            line[2 * k + 2] = turn[1, k] * one - turn[0, k] * other
