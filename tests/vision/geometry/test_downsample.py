"""Downsampling: by two, the same bits as block averages of OpenCV; means over larger cells."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.vision.geometry import Preprocessor
from tactflow.vision.geometry.downsample import cell_means

Image = NDArray[np.uint8]

ROTATIONS = {90: cv2.ROTATE_90_CLOCKWISE, 180: cv2.ROTATE_180, 270: cv2.ROTATE_90_COUNTERCLOCKWISE}


def noise(height: int, width: int) -> Image:
    return np.random.default_rng(4).integers(0, 256, (height, width, 3), dtype=np.uint8)


def plain_halved(picture: Image) -> Image:
    height, width = picture.shape[0] // 2, picture.shape[1] // 2
    whole = np.ascontiguousarray(picture[: 2 * height, : 2 * width])
    return np.asarray(cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


@pytest.mark.parametrize("rotate", [0, 90, 180, 270])
@pytest.mark.parametrize("downsample", [2, 4])
@pytest.mark.parametrize("crop", [None, (0, 0, 9, 8), (3, 5, 68, 41), (70, 50, 9, 11)])
def test_a_processed_frame_is_cropped_halved_and_turned(
    rotate: int, downsample: int, crop: tuple[int, int, int, int] | None
) -> None:
    frame = noise(61, 79)
    frame.setflags(write=False)
    strided = np.dstack([frame, frame])[:, :, ::2]
    x, y, width, height = crop or (0, 0, 79, 61)
    for raw in (frame, strided):
        expected = raw[y : y + height - height % downsample, x : x + width - width % downsample]
        for _ in range(downsample.bit_length() - 1):
            expected = plain_halved(expected)
        if rotate:
            expected = np.asarray(cv2.rotate(expected, ROTATIONS[rotate]), np.uint8)
        processed = Preprocessor((79, 61), rotate=rotate, downsample=downsample, crop=crop)(raw)
        assert np.array_equal(processed, expected)


@pytest.mark.parametrize("channels", [(), (3,)])
@pytest.mark.parametrize("side", [2, 4, 8])
def test_means_over_cells_leave_out_what_fills_none(side: int, channels: tuple[int, ...]) -> None:
    picture = np.random.default_rng(1).integers(
        0, 256, (5 * side + 1, 3 * side + side - 1, *channels), np.uint8
    )
    blocks = picture[: 5 * side, : 3 * side].reshape(5, side, 3, side, *channels)
    exact = blocks.mean(axis=(1, 3))
    np.testing.assert_allclose(cell_means(picture.astype(np.float32), side), exact, rtol=1e-5)
    rounded = cell_means(picture, side)
    # Each halving rounds a half up.
    assert rounded.dtype == np.uint8
    np.testing.assert_allclose(rounded, exact, atol=1.5)
