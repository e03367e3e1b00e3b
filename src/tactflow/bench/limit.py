"""The limits that physics sets: how well a dot's position can be known, whatever the method.

Let the mean image of one dot at (x0, y0) be m(x - x0, y - y0) and every pixel of every channel carry
independent Gaussian noise of standard deviation s. The log-likelihood is a sum of squared residuals over
2 s^2, so the Fisher information about x0 is

    J_xx = sum over channels and pixels of (dm/dx)^2 / s^2,

and no unbiased estimator of x0 has a smaller variance than 1 / J_xx (Cramer-Rao). For a dot that is
symmetric about its centre, dm/dx and dm/dy are odd while the derivatives by brightness, contrast and size
are even: all mixed terms of the information matrix vanish, so not knowing those costs nothing.

For a disc of radius R whose edge is an integrated Gaussian of width b,
m = background - contrast * Phi((R - r) / b), the sum becomes an integral when pixels are small against b:

    J_xx = contrast^2 / s^2 * integral of phi((R - r)/b)^2 / b^2 * cos^2(angle) r dr dangle
         = contrast^2 / s^2 * pi R / (2 sqrt(pi) b)          for R >> b,

so the standard error of one coordinate is (s / contrast) sqrt(2 b / (sqrt(pi) R)): it falls with the root
of the circumference, because only the edge tells where the dot is.

A displacement is the difference of two positions. With the reference averaged over k frames its variance is
(1 + 1/k) / J; the length of the error vector has the RMS sqrt(2 (1 + 1/k) / J).

References
----------
S. Kay, "Fundamentals of Statistical Signal Processing: Estimation Theory", Prentice Hall 1993, section 3.
K. Winick, "Cramer-Rao lower bounds on the performance of charge-coupled-device optical position
estimators", J. Opt. Soc. Am. A 3 (1986) 1809-1815.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np


def disc_information(radius: float, edge: float) -> float:
    """Sum of (d disc / dx)^2 over the pixels of one channel, averaged over sub-pixel phases, 1 / px^2.

    The disc is 1 inside, 0 outside, and Phi((radius - r) / edge) between. Multiply by (contrast / noise)^2
    and sum over channels for the Fisher information of one coordinate.

    Parameters
    ----------
    radius : of the half-way contour, px, > 0.
    edge : standard deviation of the edge's blur, px, > 0. An area-averaged sharp edge has about 0.3.

    Raises
    ------
    ValueError
        If `radius` or `edge` is not positive.
    """
    if not (radius > 0 and edge > 0):
        raise ValueError(f"required radius > 0 and edge > 0, got {radius} and {edge}")
    half = math.ceil(radius + 6 * edge) + 1
    # Four samples per pixel and axis average over where the dot falls on the pixel grid.
    step = 0.25
    axis = np.arange(-half, half + step / 2, step)
    x, y = np.meshgrid(axis, axis)
    r = np.hypot(x, y)
    slope = np.exp(-(((radius - r) / edge) ** 2) / 2) / (edge * math.sqrt(2 * math.pi))
    cosine = np.divide(x, r, out=np.zeros_like(x), where=r > 0)
    return float(np.sum((slope * cosine) ** 2) * step**2)


def position_bound(radius: float, edge: float, contrast: float | Sequence[float], noise: float) -> float:
    """Smallest possible standard error of one coordinate of a dot's centre, px.

    Parameters
    ----------
    radius, edge : of the dot, px; see `disc_information`.
    contrast : grey levels between dot and gel; one number, or one per channel.
    noise : standard deviation of one pixel of one channel, grey levels, > 0. Rounding to whole grey levels
        adds a variance of 1/12; see `rounded`.

    Raises
    ------
    ValueError
        If `noise` is not positive or there is no contrast at all.
    """
    power = float(np.sum(np.square(np.atleast_1d(np.asarray(contrast, dtype=np.float64)))))
    if not (noise > 0 and power > 0):
        raise ValueError(f"required noise > 0 and some contrast, got noise {noise} and contrast {contrast}")
    return noise / math.sqrt(power * disc_information(radius, edge))


def displacement_bound(position: float, reference_frames: int = 1) -> float:
    """Smallest possible RMS length of a displacement's error vector, px.

    Parameters
    ----------
    position : standard error of one coordinate in one frame, px; from `position_bound`.
    reference_frames : how many frames the position at rest is averaged over, >= 1.
    """
    if reference_frames < 1:
        raise ValueError(f"required at least 1 reference frame, got {reference_frames}")
    return position * math.sqrt(2 * (1 + 1 / reference_frames))


def rounded(noise: float) -> float:
    """Standard deviation of noise after rounding to whole grey levels (uniform rounding error, 1/12)."""
    return math.sqrt(noise**2 + 1 / 12)
