"""Stage `preprocess`: from the raw frame to the processed one."""

from __future__ import annotations

import logging
from typing import Annotated, Literal, NamedTuple, Self

from pydantic import Field, model_validator

from tactflow.engine.contract import Stage, StageParams
from tactflow.engine.frame import Frame
from tactflow.ports import Image
from tactflow.system.spelling import joined
from tactflow.vision.geometry import Lens, PixelMapping, Preprocessor, find_homography

Point = Annotated[list[float], Field(min_length=2, max_length=2)]
Row = Annotated[list[float], Field(min_length=3, max_length=3)]
Corners = Annotated[list[Point], Field(min_length=4, max_length=4)]
Pixels = Annotated[int, Field(ge=1, le=32767)]


class Undistort(StageParams):
    """A lens calibration from `cv2.calibrateCamera`, or from `cv2.fisheye.calibrate`."""

    camera_matrix: list[Row] = Field(
        min_length=3, max_length=3, description="3 x 3, raw px: [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]"
    )
    distortion: list[float] = Field(description="coefficients, 1: 4, 5, 8, 12 or 14 of them; fisheye: 4")
    fisheye: bool = Field(False, description="whether the coefficients are of the fisheye model")

    @model_validator(mode="after")
    def _usable(self) -> Self:
        self.lens()
        return self

    def lens(self) -> Lens:
        """The lens; raises ValueError if it is impossible."""
        return Lens(self.camera_matrix, self.distortion, self.fisheye)


class Homography(StageParams):
    """Four points of the undistorted raw frame and their destinations."""

    source: Corners = Field(alias="from", description="four points [x, y], undistorted raw px")
    destination: Corners = Field(alias="to", description="where they go, [x, y], px of the result")
    size: tuple[Pixels, Pixels] = Field(description="width and height of the result, px, 1 to 32767")

    @model_validator(mode="after")
    def _usable(self) -> Self:
        find_homography(self.source, self.destination)
        return self


logger = logging.getLogger("tactflow")

MIN_SIDE_PX = 160
"""Shorter side of a processed picture, px, below which a message warns of `downsample`. Chosen by hand: the
smallest pictures of the sensors with shipped pipelines."""


class Preprocessed(NamedTuple):
    """The processed frame.

    Attributes
    ----------
    image : its pixels.
    mapping : between its pixels and those of the raw frame.
    """

    image: Image
    mapping: PixelMapping


class Preprocess(Stage):
    """Straighten, cut, turn and shrink the frame in one pass.

    >>> import tactflow
    >>> preprocess = tactflow.stage("preprocess", rotate=90, downsample=2)
    >>> preprocess.process(tactflow.open_scene("press").frame(0)).image.shape
    (400, 300, 3)
    """

    memory = "pure"

    class Params(StageParams):
        """The steps in their order; missing steps are skipped."""

        undistort: Undistort | None = Field(None, description="correct the distortion of the lens")
        homography: Homography | None = Field(None, description="rectify: map four points to four others")
        crop: tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0)], Pixels, Pixels] | None = Field(
            None,
            description="keep [x, y, width, height], px of the rectified frame (without homography: raw px)",
        )
        rotate: Literal[0, 90, 180, 270] = Field(0, description="degrees clockwise")
        downsample: Literal[1, 2, 4, 8, 16] = Field(1, description="shrink factor of both sides")
        method: Literal["area", "pyramid"] = Field(
            "area", description="method of shrinking: area is faster; pyramid (cv2.pyrDown) is the original's"
        )

    def __init__(self, params: Params) -> None:
        super().__init__(params)
        self._preprocessor: Preprocessor | None = None

    def process(self, frame: Frame) -> Preprocessed:
        """The processed frame; all frames must have the size of the first."""
        if self._preprocessor is None:
            height, width = frame.image.shape[:2]
            self._preprocessor = self._build(width, height)
            image = self._preprocessor(frame.image)
            self._report((width, height), (image.shape[1], image.shape[0]))
            return Preprocessed(image, self._preprocessor.mapping)
        return Preprocessed(self._preprocessor(frame.image), self._preprocessor.mapping)

    def _report(self, before: tuple[int, int], after: tuple[int, int]) -> None:
        """Log the sizes once, if any step changes the picture. before, after : (width, height), px."""
        steps = self.params.model_dump(exclude_defaults=True).keys() - {"method"}
        if steps:
            small = self.params.downsample > 1 and min(after) < MIN_SIDE_PX
            hint = "; dots may be lost: try downsample: 1" if small else ""
            logger.info(
                "%d x %d becomes %d x %d by %s: stages.preprocess%s",
                *before,
                *after,
                joined(sorted(steps)),
                hint,
            )

    def _build(self, width: int, height: int) -> Preprocessor:
        params = self.params
        plane = params.homography
        return Preprocessor(
            (width, height),
            rotate=params.rotate,
            downsample=params.downsample,
            method=params.method,
            crop=params.crop,
            lens=params.undistort.lens() if params.undistort else None,
            homography=(plane.source, plane.destination, plane.size) if plane else None,
        )
