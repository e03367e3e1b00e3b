"""Preprocessing with compiled kernels: the same numbers as with OpenCV."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.vision import compiled
from tactflow.vision.geometry import Preprocessor
from tactflow.vision.geometry.downsample import halved

Image = NDArray[np.uint8]
SIZES = [(1, 1), (1, 8), (9, 1), (2, 2), (3, 5), (13, 200), (31, 64), (40, 131), (100, 76)]


@pytest.fixture(autouse=True)
def _with_numba() -> None:
    with compiled.switched(True):
        if not compiled.active():
            pytest.skip('numba is not here: pip install "tactflow[fast]"')


def _each_way(compute: Callable[[], Image]) -> tuple[Image, Image]:
    with compiled.switched(True):
        fast = compute()
    with compiled.switched(False):
        plain = compute()
    assert fast.shape == plain.shape
    assert fast.dtype == plain.dtype
    return fast, plain


def _picture(height: int, width: int, seed: int) -> Image:
    """Noise, or blobs of it as wide as dots."""
    rng = np.random.default_rng(seed)
    picture = rng.integers(0, 256, (height, width, 3), dtype=np.uint8)
    if seed % 2:
        # Blurred noise is grey: stretched, it spans all levels again.
        smooth = np.asarray(cv2.GaussianBlur(picture, (0, 0), 2 + seed % 3), np.float64).reshape(
            picture.shape
        )
        picture = np.rint((smooth - smooth.min()) * (255 / max(float(np.ptp(smooth)), 1.0))).astype(np.uint8)
    return picture


@pytest.mark.parametrize("size", [(2, 2), (3, 5), (8, 7), (64, 131), (150, 401)], ids=str)
def test_halves_are_equal_to_the_bit(size: tuple[int, int]) -> None:
    picture = _picture(*size, seed=4)
    picture[:1, :, 0], picture[1:, :, 0] = 255, 254
    fast, plain = _each_way(lambda: halved(picture))
    assert np.array_equal(fast, plain)


@pytest.mark.parametrize("rotate", [0, 90, 180, 270])
@pytest.mark.parametrize("downsample", [2, 4])
@pytest.mark.parametrize("crop", [None, (0, 0, 9, 8), (3, 5, 68, 41), (70, 50, 9, 11)])
def test_processed_frames_are_equal_to_the_bit(
    rotate: int, downsample: int, crop: tuple[int, int, int, int] | None
) -> None:
    frame = _picture(61, 79, seed=2)
    frame.setflags(write=False)
    strided = np.dstack([frame, frame])[:, :, ::2]
    for raw in (frame, strided):
        fast, plain = _each_way(
            lambda raw=raw: Preprocessor((79, 61), rotate=rotate, downsample=downsample, crop=crop)(raw)  # type: ignore[misc]
        )
        assert np.array_equal(fast, plain)


def test_a_processed_frame_stays_when_the_next_one_comes() -> None:
    with compiled.switched(True):
        for rotate in (0, 90):
            preprocess = Preprocessor((64, 48), rotate=rotate, downsample=2)
            first = preprocess(_picture(48, 64, seed=0))
            kept = first.copy()
            preprocess(_picture(48, 64, seed=1))
            assert np.array_equal(first, kept)
