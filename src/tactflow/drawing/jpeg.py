"""Pictures as JPEG, for people."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray


def encode_jpeg(image: NDArray[np.uint8], quality: int) -> bytes:
    """Encode a picture, (H, W, 3) uint8 BGR or (H, W) uint8, as a JPEG file.

    quality : 1 to 100; higher is sharper and larger. Raises ValueError if JPEG cannot hold the image: it is
    empty, or longer than 65500 pixels.

    >>> encode_jpeg(np.zeros((4, 6, 3), np.uint8), 80)[:2].hex()
    'ffd8'
    """
    try:
        done, jpeg = cv2.imencode(".jpg", image, (cv2.IMWRITE_JPEG_QUALITY, quality))
    except cv2.error:
        done = False
    if not done:
        raise ValueError(f"required an image that JPEG can hold, got {image.shape} {image.dtype}")
    return jpeg.tobytes()
