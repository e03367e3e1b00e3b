"""Stage `valid_area`: the part of the picture that shows gel."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from tactflow.engine.contract import Stage, StageParams
from tactflow.engine.errors import StageError
from tactflow.ports import Image, Valid
from tactflow.vision.geometry.valid_area import polygon_mask, valid_area

Point = Annotated[list[float], Field(min_length=2, max_length=2)]
Polygon = Annotated[list[Point], Field(min_length=3)]


class ValidArea(Stage):
    """Find the gel in the reference frame; a black or saturated surround is excluded.

    >>> import tactflow
    >>> image = np.zeros((60, 80, 3), np.uint8)
    >>> image[:, 20:] = 128
    >>> valid = tactflow.stage("valid_area").process(image)
    >>> valid[30, [10, 50]].tolist()
    [0, 255]
    """

    memory = "stateful"

    class Params(StageParams):
        """The area, if it is known."""

        area: Polygon | Literal["auto", "all"] = Field(
            "auto",
            description="auto finds it in the reference frame; all is the whole picture; or its corners "
            "[[x, y], ...], processed px",
        )

    def __init__(self, params: Params) -> None:
        super().__init__(params)
        self._valid: Valid | None = None

    def reset(self) -> None:
        """Forget the area; it is found again in the new reference."""
        self._valid = None

    def process(self, image: Image) -> Valid:
        """255 where there is gel; the same array until the next reference."""
        if self._valid is None:
            self._valid = self._find(image)
        return self._valid

    def _find(self, image: Image) -> Valid:
        height, width = image.shape[:2]
        area = self.params.area
        if area == "auto":
            return valid_area(image)
        if area == "all":
            return np.full((height, width), 255, np.uint8)
        try:
            return polygon_mask(area, width, height)
        except ValueError as problem:
            raise StageError(f"area: {problem}") from None
