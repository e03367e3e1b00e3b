"""Types of arrays, constants and checks that the rooms of `tactflow.vision` share."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

ColorImage = NDArray[np.uint8]
"""(H, W, 3), grey levels, blue, green, red."""
Mask = NDArray[np.uint8]
"""(H, W), not 0 inside."""
Points = NDArray[np.float64]
"""(N, 2), px, x right, y down."""
Bytes = NDArray[np.uint8]
"""Of any shape."""
Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
Indices = NDArray[np.int64]
Numbers = NDArray[np.int32]
Flags = NDArray[np.bool_]

MAD_TO_SIGMA: Final = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""
SATURATED_GREY: Final = 250
"""Grey level from which a pixel counts as saturated. Chosen by hand."""


def check_color_image(image: NDArray[Any]) -> None:
    """Raise ValueError if an array is not a non-empty (H, W, 3) uint8 image."""
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or image.size == 0:
        raise ValueError(
            f"required a non-empty (H, W, 3) uint8 image, got shape {image.shape}, dtype {image.dtype}"
        )


def check_mask(mask: NDArray[Any], shape: tuple[int, ...] | None = None, name: str = "mask") -> None:
    """Raise ValueError if an array is not an (H, W) uint8 mask, or not of a shape. name : of the argument."""
    wanted = "(H, W)" if shape is None else shape
    if mask.ndim != 2 or mask.dtype != np.uint8 or (shape is not None and mask.shape != shape):
        raise ValueError(
            f"{name}: required a uint8 mask of shape {wanted}, got shape {mask.shape}, dtype {mask.dtype}"
        )
