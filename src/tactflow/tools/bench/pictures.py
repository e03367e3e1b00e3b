"""Small pictures of a scene's deepest frame: the truth, and what each pipeline found."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.drawing.jpeg import encode_jpeg
from tactflow.drawing.results import Annotator
from tactflow.sim import Truth
from tactflow.tools.bench.lockstep import TimedResult
from tactflow.tools.bench.scenes import Rendered

SIDE_PX: Final = 240
"""Longer side of a picture."""
_JPEG_QUALITY: Final = 75
"""JPEG quality, 1 to 100: about 6 kB a picture."""
_TRUTH_COLOUR: Final = (90, 230, 60)
"""Colour of the true outline, blue, green, red."""


def deepest_frame(scene: Rendered) -> int:
    """The frame with the deepest contact; the middle one of a scene without any."""
    depths = [max((p.depth for p in scene.scene.presses(n)), default=0.0) for n in range(len(scene))]
    return int(np.argmax(depths)) if max(depths) > 0 else len(scene) // 2


def found_picture(result: TimedResult) -> bytes:
    """The processed frame with what was found, JPEG."""
    image = result.frame.image if result.image is None else result.image
    annotate = Annotator(text=False)
    return _small(annotate(image, contact=result.contact, flow=result.flow, markers=result.markers))


def true_picture(result: TimedResult, truth: Truth) -> bytes:
    """The processed frame with the true outline, JPEG."""
    image = result.frame.image if result.image is None else result.image
    drawn = image.copy()
    mask = np.asarray(truth.contact_mask, np.uint8)
    outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(drawn, outlines, -1, _TRUTH_COLOUR, max(1, round(min(drawn.shape[:2]) / 200)))
    return _small(drawn)


def _small(picture: NDArray[np.uint8]) -> bytes:
    scale = min(1.0, SIDE_PX / max(picture.shape[:2]))
    small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return encode_jpeg(np.asarray(small, np.uint8), _JPEG_QUALITY)
