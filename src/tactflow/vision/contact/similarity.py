"""Structural similarity of two pictures."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.arrays import Floats32

MEAN_STABILISER: Final = (0.01 * 255) ** 2
"""Keeps the quotient of the means from noise where both are dark, squared grey levels; of the article."""
VARIANCE_STABILISER: Final = (0.03 * 255) ** 2
"""The same for the variances."""


def structural_similarity(
    first: NDArray[np.uint8], second: NDArray[np.uint8], sigma: float = 1.5
) -> Floats32:
    """Structural similarity (SSIM) of two pictures around each pixel: 1 where they are equal, at least -1.

    first, second : (H, W) uint8, grey levels. sigma : of the Gaussian window, px, > 0; wider windows are less
    noisy and blur the border of a change. Computed in float32.

    Raises
    ------
    ValueError : the pictures are not (H, W) uint8 of one size.

    References
    ----------
    Z. Wang, A. C. Bovik, H. R. Sheikh, E. P. Simoncelli, "Image quality assessment: from error visibility to
    structural similarity", IEEE Transactions on Image Processing 13 (2004).

    Examples
    --------
    >>> gel = np.full((20, 20), 100, np.uint8)
    >>> float(structural_similarity(gel, gel)[0, 0])
    1.0
    """
    if first.shape != second.shape or first.ndim != 2 or {first.dtype, second.dtype} != {np.dtype(np.uint8)}:
        raise ValueError(
            f"required two (H, W) uint8 pictures of one size, got shapes {first.shape} and {second.shape}"
        )

    def mean(picture: Floats32) -> Floats32:
        return np.asarray(cv2.GaussianBlur(picture, (0, 0), sigma, borderType=cv2.BORDER_REFLECT), np.float32)

    # Without their common mean, float32 keeps the small variances exact.
    middle = np.float32(first.mean()) if first.size else np.float32(0)
    a, b = first.astype(np.float32) - middle, second.astype(np.float32) - middle
    mean_a, mean_b = mean(a), mean(b)
    variances = mean(a * a) - mean_a * mean_a + mean(b * b) - mean_b * mean_b
    covariance = mean(a * b) - mean_a * mean_b
    mean_a, mean_b = mean_a + middle, mean_b + middle
    similar_mean = (2 * mean_a * mean_b + MEAN_STABILISER) / (mean_a**2 + mean_b**2 + MEAN_STABILISER)
    return np.asarray(
        similar_mean * (2 * covariance + VARIANCE_STABILISER) / (variances + VARIANCE_STABILISER), np.float32
    )
