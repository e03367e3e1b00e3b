"""Remove specks from a mask of changed pixels."""

from __future__ import annotations

import cv2
import numpy as np

from tactflow.vision.arrays import Mask


def without_specks(mask: Mask, diameter: int, valid: Mask | None = None) -> Mask:
    """Morphological opening of a mask by a disc: what no disc of that diameter fits into is removed.

    mask : (H, W) uint8, 255 where something changed. diameter : px, >= 1. valid : (H, W) uint8, 0 where
    nothing counts; None: everything counts. Returns a new mask (H, W) uint8, 0 or 255.

    >>> mask = np.zeros((20, 30), np.uint8)
    >>> mask[4:14, 4:14] = mask[4, 25] = 255
    >>> opened = without_specks(mask, 5)
    >>> int(opened[8, 8]), int(opened[4, 25])
    (255, 0)
    """
    kept = mask if valid is None else np.where(valid > 0, mask, 0).astype(np.uint8)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (diameter, diameter))
    return np.asarray(cv2.morphologyEx(kept, cv2.MORPH_OPEN, disc), np.uint8)
