"""The frame on which a pipeline was worst, with the truth beside its answer: not how much, but why."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.message.result import Result
from tactflow.vision.types import MarkerStatus

_SCALE = 2
"""Pixels of the picture for each of the processed frame, so that lines stay apart."""

_TRUE, _FOUND, _MARKER, _LOST = (80, 220, 60), (60, 60, 240), (255, 255, 255), (0, 165, 255)
"""Colours, BGR grey levels: green, red, white, orange."""

_CAPTION = 24
"""Height of the line of text at the top, px."""


@dataclass(slots=True)
class WorstFrame:
    """The frame with the least overlap. region, center : of the true contact, (H, W) and px."""

    overlap: float = 2.0
    result: Result | None = None
    region: NDArray[np.uint8] | None = None
    center: tuple[float, float] | None = None

    def see(
        self, overlap: float, result: Result, region: NDArray[Any], center: tuple[float, float] | None
    ) -> None:
        """Keep this frame if it is worse. overlap : of the found contact with the true one, 0 to 1."""
        if overlap < self.overlap:
            self.overlap, self.result, self.center = overlap, result, center
            self.region = np.asarray(region, dtype=np.uint8)

    def write(self, folder: Path | None, name: str) -> None:
        """Write FOLDER/NAME.png; nothing without a folder or a frame.

        Green: outline and centre of the true contact. Red: those of the contact that was found. White
        crosses: tracked markers; orange ones: inferred or lost.
        """
        if folder is None or self.result is None or self.result.image is None or self.region is None:
            return
        caption = f"{name}, frame {self.result.frame.seq}: IoU {self.overlap:.2f}"
        folder.mkdir(parents=True, exist_ok=True)
        picture = _draw(self.result, self.result.image, self.region, self.center, caption)
        cv2.imwrite(str(folder / f"{name.replace('/', '_')}.png"), picture)


def _draw(
    result: Result,
    image: NDArray[np.uint8],
    region: NDArray[np.uint8],
    center: tuple[float, float] | None,
    caption: str,
) -> NDArray[np.uint8]:
    """(2 H + 24, 2 W, 3) uint8 BGR."""
    size = (image.shape[1] * _SCALE, image.shape[0] * _SCALE)
    picture: NDArray[Any] = cv2.resize(image, size, interpolation=cv2.INTER_CUBIC)
    for mask, color in ((region, _TRUE), (result.contact_mask, _FOUND)):
        if mask is not None:
            large = cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST)
            contours, _ = cv2.findContours(large, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
            cv2.drawContours(picture, contours, -1, color, 1, cv2.LINE_AA)
    if center is not None:
        cv2.circle(picture, _place(center), 5, _TRUE, 2, cv2.LINE_AA)
    if result.contact is not None:
        cv2.drawMarker(picture, _place(result.contact.center), _FOUND, cv2.MARKER_CROSS, 14, 2)
    if result.markers is not None:
        for point, status in zip(result.markers.position, result.markers.status, strict=True):
            color = _MARKER if status == MarkerStatus.TRACKED else _LOST
            cv2.drawMarker(picture, _place(point), color, cv2.MARKER_TILTED_CROSS, 7, 1)
    bar = np.full((_CAPTION, size[0], 3), 30, np.uint8)
    cv2.putText(bar, caption, (6, 17), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (235, 235, 235), 1, cv2.LINE_AA)
    return np.vstack([bar, np.asarray(picture, dtype=np.uint8)])


def _place(point: Any) -> tuple[int, int]:
    # The centre of processed pixel 0 lies half a large pixel into the enlarged picture.
    half = (_SCALE - 1) / 2
    return round(point[0] * _SCALE + half), round(point[1] * _SCALE + half)
