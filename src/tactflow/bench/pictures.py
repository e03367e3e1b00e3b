"""The frame on which a pipeline was worst, with the truth beside its answer: not how much, but why."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.bench.lockstep import Outcome
from tactflow.vision.types import MarkerStatus

_SCALE = 2
"""Pixels of the picture for each of the processed frame, so that lines stay apart."""

_TRUE, _FOUND, _MARKER, _LOST = (80, 220, 60), (60, 60, 240), (255, 255, 255), (0, 165, 255)
"""Colours, BGR grey levels: green, red, white, orange."""

_CAPTION = 24
"""Height of the line of text at the top, px."""


def draw(
    outcome: Outcome, region: NDArray[np.uint8], center: tuple[float, float] | None, caption: str
) -> NDArray[np.uint8] | None:
    """Truth and answer on one processed frame; None where the pipeline has no image.

    Green: outline and centre of the true contact. Red: outline and centre of the one that was found. White
    crosses: tracked markers; orange ones: inferred or lost.

    Parameters
    ----------
    outcome : what the pipeline said. region : (H, W), not 0 in the true contact. center : of it, px, or None.
    caption : written above.

    Returns
    -------
    (2 H + 24, 2 W, 3) uint8 BGR.
    """
    if outcome.image is None:
        return None
    height, width = outcome.image.shape[:2]
    size = (width * _SCALE, height * _SCALE)
    picture: NDArray[Any] = cv2.resize(outcome.image, size, interpolation=cv2.INTER_CUBIC)
    _outline(picture, region, _TRUE)
    if outcome.contact_mask is not None:
        _outline(picture, outcome.contact_mask, _FOUND)
    if center is not None:
        cv2.circle(picture, _place(center), 5, _TRUE, 2, cv2.LINE_AA)
    if outcome.contact is not None:
        cv2.drawMarker(picture, _place(outcome.contact.center), _FOUND, cv2.MARKER_CROSS, 14, 2)
    if outcome.markers is not None:
        for point, status in zip(outcome.markers.position, outcome.markers.status, strict=True):
            color = _MARKER if status == MarkerStatus.TRACKED else _LOST
            cv2.drawMarker(picture, _place((point[0], point[1])), color, cv2.MARKER_TILTED_CROSS, 7, 1)
    bar = np.full((_CAPTION, size[0], 3), 30, np.uint8)
    cv2.putText(bar, caption, (6, 17), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (235, 235, 235), 1, cv2.LINE_AA)
    return np.vstack([bar, np.asarray(picture, dtype=np.uint8)])


def _place(point: tuple[float, float]) -> tuple[int, int]:
    # The centre of processed pixel 0 lies half a large pixel into the enlarged picture.
    half = (_SCALE - 1) / 2
    return round(point[0] * _SCALE + half), round(point[1] * _SCALE + half)


def _outline(picture: NDArray[Any], mask: NDArray[np.uint8], color: tuple[int, int, int]) -> None:
    height, width = mask.shape
    large = cv2.resize(mask, (width * _SCALE, height * _SCALE), interpolation=cv2.INTER_NEAREST)
    contours, _ = cv2.findContours(large, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(picture, contours, -1, color, 1, cv2.LINE_AA)
