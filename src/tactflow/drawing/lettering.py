"""Text in pictures: the sans-serif letters of OpenCV 5, or the plain strokes of OpenCV 4."""

from __future__ import annotations

from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

_FONT_WEIGHT: Final = 400
"""Weight of OpenCV 5's letters: the font's regular one."""
_STROKE_FONT: Final = cv2.FONT_HERSHEY_SIMPLEX
_STROKE_SCALE: Final = 1 / 30
"""Scale of OpenCV 4's strokes over the letters' size, 1/px: at scale 1 capitals are 22 px high; in a usual
font seven tenths of its size."""
_ASCII_SPELLINGS: Final = str.maketrans({"°": " deg", "²": "2", "³": "3", "−": "-"})
"""OpenCV 4's strokes know ASCII only."""


class Lettering:
    """Writes into pictures. Not to be shared between threads: a font has a cache.

    >>> letters = Lettering()
    >>> picture = np.zeros((40, 200, 3), np.uint8)
    >>> letters.write(picture, "twist 3.1°", (5, 25), (255, 255, 255), 16)
    >>> bool(picture.any())
    True
    """

    def __init__(self, strokes: bool = False) -> None:
        """strokes : use the letters of OpenCV 4 even where OpenCV 5 is installed."""
        face = None if strokes else getattr(cv2, "FontFace", None)
        self._font: Any = None if face is None else face("sans")

    def size(self, picture: NDArray[np.uint8], text: str, size: int) -> tuple[int, int]:
        """Width and height, px, of a text in `picture`, (H, W, 3) uint8. size : of the letters, px."""
        if self._font is None:
            (wide, tall), _ = cv2.getTextSize(
                text.translate(_ASCII_SPELLINGS), _STROKE_FONT, size * _STROKE_SCALE, 1
            )
            return wide, tall
        height, width = picture.shape[:2]
        _, _, wide, tall = cv2.getTextSize((width, height), text, (0, 0), self._font, size, _FONT_WEIGHT)
        return wide, tall

    def write(
        self,
        picture: NDArray[np.uint8],
        text: str,
        place: tuple[int, int],
        colour: tuple[int, int, int],
        size: int,
    ) -> None:
        """Write text into `picture`, (H, W, 3) uint8; `place` is the left end of its base line, px."""
        if self._font is None:
            plain = text.translate(_ASCII_SPELLINGS)
            cv2.putText(picture, plain, place, _STROKE_FONT, size * _STROKE_SCALE, colour, 1, cv2.LINE_AA)
        else:
            cv2.putText(picture, text, place, colour, self._font, size, _FONT_WEIGHT)
