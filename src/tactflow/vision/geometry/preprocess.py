"""From the raw frame to the processed one, with the exact mapping between their coordinates.

The steps, in this order; each works in the pixels of the result of the one before it:

1. undistort: take out the lens (size unchanged, same camera matrix);
2. homography: four points go to four points; the result has the given size;
3. crop: keep a rectangle;
4. rotate: clockwise by 0, 90, 180 or 270 degrees;
5. downsample: by averaging blocks ("area") or by Gaussian pyramid ("pyramid").
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactflow.vision.arrays import Floats
from tactflow.vision.geometry.downsample import halved
from tactflow.vision.geometry.homography import find_homography
from tactflow.vision.geometry.lens import check_lens
from tactflow.vision.geometry.mapping import PixelMapping, rotation, shift
from tactflow.vision.geometry.resample import Resampler

Method = Literal["area", "pyramid"]
Size = tuple[int, int]

_ROTATIONS: Final = {90: cv2.ROTATE_90_CLOCKWISE, 180: cv2.ROTATE_180, 270: cv2.ROTATE_90_COUNTERCLOCKWISE}


class Preprocessor:
    """Turns raw frames of one size into processed frames, all geometric steps in one pass where exact.

    raw_size : (width, height) of the raw frames, px.
    rotate : 0, 90, 180 or 270, degrees clockwise.
    downsample : 1, 2, 4, ...; the factor by which both sides shrink.
    method : "area" averages blocks: fast, and the mean of k x k pixels has 1 / k of their noise. Where a side
        is not a multiple of the factor, the last columns or rows of the unrotated picture are left out.
        "pyramid" is the original script's: rotate, then `cv2.pyrDown` for each factor of two (sides round
        up); three times the time, smoother, and its pixels lie half a raw pixel elsewhere.
    crop : (x, y, width, height), px of the undistorted and rectified, not yet rotated frame; without lens and
        homography these are raw pixels. None keeps everything.
    camera_matrix, distortion, fisheye : the lens, see `Lens`; both or neither must be given.
    homography : (four source points, four destination points, (width, height)), px; source points in the
        undistorted raw frame. What lies outside the raw frame becomes black. Where the whole chain shrinks
        the picture by a factor s, the raw frame is first averaged over blocks of round(s) pixels along each
        axis, so that fine structure is averaged rather than aliased; sampling is bilinear, at positions
        rounded to 1/32 pixel (the same in every frame, so displacements are not affected).

    Raises ValueError for values out of range, a degenerate homography or a crop outside the frame.

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
        camera_matrix: ArrayLike | None = None,
        distortion: ArrayLike | None = None,
        fisheye: bool = False,
        homography: tuple[ArrayLike, ArrayLike, Sequence[int]] | None = None,
    ) -> None:
        _check(raw_size, rotate, downsample, method)
        raw = (int(raw_size[0]), int(raw_size[1]))
        lens = check_lens(camera_matrix, distortion, fisheye)
        matrix, size = _rectified(homography, raw)
        x, y = 0, 0
        if crop is not None:
            x, y, size = _cropped(crop, size)
            matrix = shift(-x, -y) @ matrix
        if method == "area" and downsample > 1:
            size = _whole_blocks(size, downsample)
        self._block = (slice(y, y + size[1]), slice(x, x + size[0]))
        matrix = rotation(rotate, size) @ matrix
        if rotate in (90, 270):
            size = (size[1], size[0])
        self._levels = int(downsample).bit_length() - 1
        before_pyramid = PixelMapping(raw, size, matrix, lens)
        for _ in range(self._levels):
            matrix, size = _half(matrix, size, method)
        self.mapping: PixelMapping = PixelMapping(raw, size, matrix, lens)
        """Exact mapping between raw and processed pixels."""
        self._rotate = rotate
        self._method = method
        self._half: NDArray[np.uint8] | None = None
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
        if self._resampler is not None:
            result: NDArray[Any] = self._resampler(image)
            if self._method == "pyramid":
                result = self._pyramid(result)
            return result
        block: NDArray[Any] = image[self._block]
        if self._method == "pyramid" and self._levels:
            return self._pyramid(block if self._rotate == 0 else cv2.rotate(block, _ROTATIONS[self._rotate]))
        if self._levels:
            # By halves: three times as fast as one step of four, for 1/8 grey level of bias. The first
            # result is as large as the processed frame, and costs less where it is in the caches.
            turned = self._rotate == 90
            block = self._half = halved(image, self._block, into=self._half, upside_down=turned)
            for _ in range(self._levels - 1):
                block = halved(block)
            if turned:
                # To turn a picture that is upside down is to exchange rows and columns: 0.7 of the time.
                return cv2.transpose(block)  # type: ignore[return-value]
            if block is self._half and not self._rotate:
                return block.copy()
        if self._rotate:
            return cv2.rotate(block, _ROTATIONS[self._rotate])  # type: ignore[return-value]
        if self._levels:
            return block
        if block.shape == image.shape:
            same = image.view()
            same.flags.writeable = False
            return same
        return np.ascontiguousarray(block)

    def _pyramid(self, image: NDArray[Any]) -> NDArray[Any]:
        for _ in range(self._levels):
            image = cv2.pyrDown(image)
        return image


def _check(raw_size: Size, rotate: int, downsample: int, method: str) -> None:
    if raw_size[0] < 1 or raw_size[1] < 1:
        raise ValueError(f"required raw_size (width, height) >= 1, got {raw_size}")
    if rotate not in (0, 90, 180, 270):
        raise ValueError(f"required rotate to be 0, 90, 180 or 270 degrees clockwise, got {rotate}")
    if not _is_whole(downsample) or downsample < 1 or downsample & (downsample - 1):
        raise ValueError(f"required downsample to be 1, 2, 4, 8, ..., got {downsample}")
    if method not in ("area", "pyramid"):
        raise ValueError(f"required method to be 'area' or 'pyramid', got {method!r}")


def _rectified(
    homography: tuple[ArrayLike, ArrayLike, Sequence[int]] | None, size: Size
) -> tuple[Floats, Size]:
    """Matrix of the homography, and the size of its result; without one, those of doing nothing."""
    if homography is None:
        return np.eye(3), size
    source, destination, target = homography
    if len(target) != 2 or not all(map(_is_whole, target)) or min(target) < 1:
        raise ValueError(f"required a homography size (width, height) >= 1, got {tuple(target)}")
    return find_homography(source, destination), (int(target[0]), int(target[1]))


def _cropped(crop: Sequence[int], size: Size) -> tuple[int, int, Size]:
    """Corner x, y and size (width, height) of a crop that lies inside a frame of this size."""
    if len(crop) != 4 or not all(map(_is_whole, crop)):
        raise ValueError(f"required crop (x, y, width, height) in whole px, got {tuple(crop)}")
    x, y, width, height = (int(value) for value in crop)
    if x < 0 or y < 0 or width < 1 or height < 1 or x + width > size[0] or y + height > size[1]:
        raise ValueError(
            f"required a crop (x, y, width, height) inside the {size[0]} x {size[1]} frame, got {tuple(crop)}"
        )
    return x, y, (width, height)


def _whole_blocks(size: Size, downsample: int) -> Size:
    """The size without the columns and rows that fill no whole block."""
    if min(size) < downsample:
        raise ValueError(
            f"required both sides of the frame >= downsample {downsample}, got width, height {size}"
        )
    return (size[0] - size[0] % downsample, size[1] - size[1] % downsample)


def _half(matrix: Floats, size: Size, method: Method) -> tuple[Floats, Size]:
    """Matrix and size of a picture, once more shrunk by two."""
    if method == "area":
        matrix = np.array([[0.5, 0, -0.25], [0, 0.5, -0.25], [0, 0, 1]]) @ matrix
        return matrix, (size[0] // 2, size[1] // 2)
    return np.diag([0.5, 0.5, 1.0]) @ matrix, ((size[0] + 1) // 2, (size[1] + 1) // 2)


def _is_whole(value: object) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool)
