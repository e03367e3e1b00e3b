"""Where something touches the gel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.seed_contact import seed_contact_mask

ContactMethod = Literal["colour", "seed"]


@dataclass(frozen=True, slots=True)
class ContactResult:
    """mask : (H, W) uint8, 255 in contact, else 0. touching : True if any pixel is in contact."""

    mask: NDArray[np.uint8]
    touching: bool


class ContactDetector:
    """Finds where a gel is touched, by comparison with frames of the untouched gel."""

    def __init__(self, method: ContactMethod = "colour", *, distance: float = 24.0) -> None:
        self._method = method
        self._distance = distance
        self._reference: NDArray[np.uint8] | None = None

    def add_reference(self, image: NDArray[np.uint8]) -> None:
        """Learn from a frame of the untouched gel."""
        self._reference = image.copy()

    def reset(self) -> None:
        """Forget the reference."""
        self._reference = None

    @property
    def has_reference(self) -> bool:
        """Whether a frame of the untouched gel is known."""
        return self._reference is not None

    def detect(self, image: NDArray[np.uint8]) -> ContactResult:
        """Compare a frame with the untouched gel."""
        if self._reference is None:
            raise ValueError("required a reference frame first: call add_reference")
        if self._method == "seed":
            mask = seed_contact_mask(image, self._reference)
        else:
            change = cv2.blur(cv2.absdiff(image, self._reference), (5, 5)).astype(np.float32)
            squared = np.einsum("ijk,ijk->ij", change, change)
            mask = np.where(squared > self._distance**2, 255, 0).astype(np.uint8)
            mask = np.asarray(cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((7, 7), np.uint8)), np.uint8)
        return ContactResult(mask, bool(mask.any()))
