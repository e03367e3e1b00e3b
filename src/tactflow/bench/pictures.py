"""The frame on which a pipeline was worst, with the truth beside its answer: not how much, but why."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.message.result import Result
from tactflow.notebook import draw


class WorstFrame:
    """The frame in which the contact that was found overlaps least with the true one."""

    def __init__(self) -> None:
        self._overlap = 2.0
        self._result: Result | None = None
        self._region: NDArray[np.uint8] = np.zeros((0, 0), np.uint8)

    def add(self, overlap: float, result: Result, region: NDArray[Any]) -> None:
        """Keep this frame if it is worse. overlap : 0 to 1. region : (H, W), not 0 in the true contact."""
        if overlap < self._overlap and result.image is not None:
            self._overlap, self._result = overlap, result
            self._region = np.asarray(region, dtype=np.uint8)

    def write(self, folder: Path, name: str) -> None:
        """Write FOLDER/NAME.png: what was found as the live page draws it, the true outline in red."""
        if self._result is None:
            return
        size = tuple(2 * side for side in self._result.size)
        picture = cv2.resize(draw(self._result, text=False), size, interpolation=cv2.INTER_CUBIC)
        region = cv2.resize(self._region, size, interpolation=cv2.INTER_NEAREST)
        outline, _ = cv2.findContours(region, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(picture, outline, -1, (0, 0, 255), 1)
        caption = f"{name}, frame {self._result.seq}: overlap {self._overlap:.2f}"
        cv2.putText(
            picture, caption, (6, 17), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (255, 255, 255), 1, cv2.LINE_AA
        )
        folder.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(folder / f"{name.replace('/', '_')}.png"), picture)
