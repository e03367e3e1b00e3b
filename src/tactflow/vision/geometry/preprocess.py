"""From the raw frame to the processed one, with the exact mapping between their coordinates.

The steps, in this order; each works in the pixels of the result of the one before it:

1. undistort: remove the distortion of the lens (size unchanged, same camera matrix);
2. homography: four points go to four points; the result has a size of its own;
3. crop: keep a rectangle;
4. rotate: clockwise by 0, 90, 180 or 270 degrees;
5. downsample: by averaging blocks ("area") or by a Gaussian pyramid ("pyramid").
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactflow.vision.geometry.downsample import halved
from tactflow.vision.geometry.lens import Lens
from tactflow.vision.geometry.mapping import PixelMapping, find_homography
from tactflow.vision.geometry.resample import Resampler

Method = Literal["area", "pyramid"]

_ROTATIONS: Final = {90: cv2.ROTATE_90_CLOCKWISE, 180: cv2.ROTATE_180, 270: cv2.ROTATE_90_COUNTERCLOCKWISE}


class Preprocessor:
    """Turns raw frames of one size into processed frames, all steps in one pass where that is exact.

    Raises ValueError for values out of range, a degenerate homography or a crop outside the frame.

    Parameters
    ----------
    raw_size : (width, height) of the raw frames, px.
    rotate : 0, 90, 180 or 270, degrees clockwise.
    downsample : 1, 2, 4, ...; the factor by which both sides shrink.
    method : "area" averages blocks: fast, and the mean of k x k pixels has 1 / k of their noise. Where a
        side is not a multiple of the factor, the last columns or rows of the unrotated picture are left
        out. "pyramid" is the original script's: rotate, then `cv2.pyrDown` for each factor of two (sides
        round up); three times the time, smoother, and its pixels lie half a raw pixel elsewhere.
    crop : (x, y, width, height), whole px of the undistorted and rectified, not yet rotated frame; without
        lens and homography these are raw pixels. None keeps everything.
    lens : whose distortion is removed.
    homography : (four source points, four destination points, (width, height)), px; source points in the
        undistorted raw frame. What lies outside the raw frame becomes black. Where the whole chain shrinks
        the picture by a factor s, the raw frame is first averaged over blocks of round(s) pixels along each
        axis, so that fine structure is averaged rather than aliased; sampling is bilinear, at positions
        rounded to 1/32 pixel (the same in every frame, so displacements are not affected).

    Examples
    --------
    >>> preprocess = Preprocessor((800, 600), rotate=90, downsample=2)
    >>> preprocess(np.zeros((600, 800, 3), np.uint8)).shape
    (400, 300, 3)
    >>> preprocess.mapping.to_processed([0.5, 0.5])
    array([299.,   0.])
    """

    def __init__(
        self,
        raw_size: tuple[int, int],
        *,
        rotate: int = 0,
        downsample: int = 1,
        method: Method = "area",
        crop: tuple[int, int, int, int] | None = None,
        lens: Lens | None = None,
        homography: tuple[ArrayLike, ArrayLike, Sequence[int]] | None = None,
    ) -> None:
        if rotate not in (0, *_ROTATIONS):
            raise ValueError(f"required rotate to be 0, 90, 180 or 270 degrees clockwise, got {rotate}")
        if downsample < 1 or downsample & (downsample - 1):
            raise ValueError(f"required downsample to be 1, 2, 4, 8, ..., got {downsample}")
        self._rotate, self._method = rotate, method
        self._levels = downsample.bit_length() - 1
        matrix, (width, height) = np.eye(3), raw_size
        if homography is not None:
            matrix, (width, height) = find_homography(*homography[:2]), homography[2]
        if min(width, height) < 1:
            raise ValueError(f"required a frame of at least 1 x 1 px, got {width} x {height}")
        left, top, width, height = _cropped(crop, width, height)
        matrix = np.array([[1.0, 0.0, -left], [0.0, 1.0, -top], [0.0, 0.0, 1.0]]) @ matrix
        if method == "area":
            if min(width, height) < downsample:
                raise ValueError(
                    f"required both sides of the frame >= downsample {downsample}, got {width} x {height}"
                )
            width, height = width - width % downsample, height - height % downsample
        self._block = slice(top, top + height), slice(left, left + width)
        for _ in range(rotate // 90):
            matrix = np.array([[0.0, -1.0, height - 1.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]) @ matrix
            width, height = height, width
        before_pyramid = PixelMapping(raw_size, (width, height), matrix, lens)
        for _ in range(self._levels):
            offset, rounding = (-0.25, 0) if method == "area" else (0.0, 1)
            matrix = np.array([[0.5, 0.0, offset], [0.0, 0.5, offset], [0.0, 0.0, 1.0]]) @ matrix
            width, height = (width + rounding) // 2, (height + rounding) // 2
        self.mapping: PixelMapping = PixelMapping(raw_size, (width, height), matrix, lens)
        """Exact mapping between raw and processed pixels."""
        self._resampler: Resampler | None = None
        if lens is not None or homography is not None:
            self._resampler = Resampler(self.mapping if method == "area" else before_pyramid)

    def __call__(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Process one frame.

        image : (H, W, 3) uint8, of the size given at construction.
        Returns (h, w, 3) uint8 with (w, h) = `mapping.size`; where nothing is to be done, a read-only view
        of `image`. Raises ValueError if the frame has another size, type or number of channels.
        """
        width, height = self.mapping.raw_size
        if image.shape != (height, width, 3) or image.dtype != np.uint8:
            raise ValueError(
                f"required a ({height}, {width}, 3) uint8 frame, got {image.shape} {image.dtype}"
            )
        result: NDArray[Any]
        if self._resampler is not None:
            result = self._resampler(image)
        else:
            result = image[self._block]
            if self._levels and self._method == "area":
                # By halves: three times as fast as one step of four, for 1/8 grey level of bias.
                result = halved(image, self._block)
                for _ in range(self._levels - 1):
                    result = halved(result)
            if self._rotate:
                result = cv2.rotate(result, _ROTATIONS[self._rotate])
        if self._method == "pyramid":
            for _ in range(self._levels):
                result = cv2.pyrDown(result)
        result = np.ascontiguousarray(result)
        result.flags.writeable = not np.may_share_memory(result, image)
        return result


def _cropped(crop: tuple[int, int, int, int] | None, width: int, height: int) -> tuple[int, int, int, int]:
    """Corner x, y, width and height of a crop, which must lie inside the frame."""
    x, y, wide, high = crop or (0, 0, width, height)
    if min(x, y) < 0 or min(wide, high) < 1 or x + wide > width or y + high > height:
        raise ValueError(
            f"required a crop (x, y, width, height) inside the {width} x {height} frame, got {crop}"
        )
    return x, y, wide, high
