"""Marker mask and inpainting: the kernels do what OpenCV and numpy do, for pictures of any size."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Literal, get_args

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.sim import open_scene
from tactflow.vision.markers.inpaint import remove_markers
from tactflow.vision.markers.mask import Dot, Polarity, find_dot, marker_mask
from tests.oracles import inpaint, mask
from tests.oracles.plain import plain

Image = NDArray[np.uint8]
SIZES = [(1, 1), (1, 8), (9, 1), (2, 2), (3, 5), (13, 200), (31, 64), (40, 131), (100, 76)]


def _plain_mask(picture: Image, dot: Dot) -> Image:
    with plain(mask):
        return marker_mask(picture, dot)


def _plain_filled(picture: Image, covered: Image, radius: float = 7.0) -> Image:
    with plain(inpaint):
        return remove_markers(picture, covered, radius=radius)


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


@pytest.mark.parametrize("size", SIZES, ids=str)
@pytest.mark.parametrize("polarity", get_args(Polarity))
@pytest.mark.parametrize("radius", [0.4, 2.0, 5.3, 11.0])
def test_marker_masks_are_equal_to_the_bit(
    size: tuple[int, int], polarity: Literal["dark", "bright"], radius: float
) -> None:
    found = 0
    for seed, contrast in enumerate([0.5, 6.0, 25.9, 80.0, 254.0, 300.0]):
        picture, dot = _picture(*size, seed=seed), Dot(radius, polarity, contrast)
        picture.setflags(write=False)
        found_mask = marker_mask(picture, dot)
        assert np.array_equal(found_mask, _plain_mask(picture, dot))
        found += int(np.count_nonzero(found_mask))
    # There is something to compare, where the circle leaves room between the frame's corners.
    assert found or min(size) < 40


def _inpainted(picture: Image, mask: Image, radius: float) -> NDArray[np.float64]:
    """What `normalized` means, in float64, its result not rounded; NaN if the mask leaves nothing."""
    bottom, right = -picture.shape[0] % 4, -picture.shape[1] % 4
    whole = np.pad(picture, ((0, bottom), (0, right), (0, 0)), mode="edge").astype(np.int64)
    hidden = np.pad(mask, ((0, bottom), (0, right)), mode="edge") > 0
    height, width = hidden.shape
    half = (whole.reshape(height // 2, 2, width // 2, 2, 3).sum(axis=(1, 3)) + 2) // 4
    valid = np.asarray(~hidden.reshape(height // 2, 2, width // 2, 2).any(axis=(1, 3)))
    kept = np.dstack([half * valid[..., None], 255 * valid]).astype(np.float64)
    total = kept.reshape(height // 4, 2, width // 4, 2, 4).mean(axis=(1, 3))

    def windows(kernel: NDArray[np.float64]) -> NDArray[np.float64]:
        reach = len(kernel) // 2
        wide = np.pad(total, ((reach, reach), (reach, reach), (0, 0)), mode="reflect")
        down = np.lib.stride_tricks.sliding_window_view(wide, len(kernel), axis=0) @ kernel
        return np.asarray(np.lib.stride_tricks.sliding_window_view(down, len(kernel), axis=1) @ kernel)

    size = 2 * int(np.ceil(radius / 4 + 1)) + 1
    mixed = windows(np.array([0.25, 0.5, 0.25])) + 0.01 * windows(np.full(size, 1 / size))
    if mixed[..., 3].min() < 1e-3:
        mixed += 1e-6 * total.mean(axis=(0, 1))
    filled = 255 * mixed[..., :3] / mixed[..., 3:]
    for axis in (0, 1):
        filled = np.moveaxis(filled, axis, 0)
        before = np.concatenate([filled[:1], filled[:-1]])
        after = np.concatenate([filled[1:], filled[-1:]])
        finer = np.stack([0.75 * filled + 0.25 * before, 0.75 * filled + 0.25 * after], axis=1)
        filled = np.moveaxis(finer.reshape(-1, *filled.shape[1:]).repeat(2, axis=0), 0, axis)
    return filled[: picture.shape[0], : picture.shape[1]]


@pytest.mark.parametrize("size", SIZES, ids=str)
@pytest.mark.parametrize("radius", [0.5, 3.0, 7.0, 100.0])
def test_inpainted_pictures_are_what_float64_gives_rounded(size: tuple[int, int], radius: float) -> None:
    rng = np.random.default_rng(1)
    for seed, fraction in enumerate([0.0, 0.003, 0.1, 0.4, 0.98, 1.0]):
        picture = _picture(*size, seed=seed)
        spots = (rng.random(size) < fraction).astype(np.uint8) * np.uint8(1 + 254 * (seed % 2))
        for covered in (
            spots,
            np.asarray(cv2.dilate(spots, np.ones((5, 7), np.uint8)), np.uint8).reshape(size),
        ):
            covered.setflags(write=False)
            both = (
                remove_markers(picture, covered, radius=radius),
                _plain_filled(picture, covered, radius),
            )
            with np.errstate(invalid="ignore"):
                expected = _inpainted(picture, covered, radius)
            if np.isnan(expected).any():
                expected = picture.astype(np.float64)
            for unmarked in both:
                assert np.array_equal(unmarked[covered == 0], picture[covered == 0])
                error = np.abs(unmarked - expected)[covered > 0]
                # Half a level of rounding, and what float32 leaves of 255 after some ten operations. Derived:
                # 10 * 2**-24 * 255 = 1.5e-4.
                assert error.max(initial=0) <= 0.5 + 2e-4


@pytest.mark.parametrize("scene", ["press", "bright_dots"])
def test_simulated_frames_come_out_equal(scene: str) -> None:
    recording = open_scene(f"{scene}?frames=60&noise=2")
    dot = find_dot(recording.frame(0))
    assert dot is not None
    for index in (0, 25):
        image = recording.frame(index)
        covered = marker_mask(image, dot)
        assert np.array_equal(covered, _plain_mask(image, dot))
        filled, expected = remove_markers(image, covered), _plain_filled(image, covered)
        # A value within float32's last digits of a half may be rounded either way. Measured: none, or one
        # value of a block of 2 x 2 px, in some 110 000.
        assert np.count_nonzero(filled != expected) <= 40
        assert np.abs(filled.astype(int) - expected).max() <= 1


def test_frames_of_different_sizes_and_dots_may_take_turns() -> None:
    pictures = [_picture(*size, seed=1) for size in ((40, 60), (60, 40), (41, 60))]
    dots = [Dot(3.0), Dot(5.0), Dot(5.0, "bright")]
    masks = [[_plain_mask(picture, dot) for dot in dots] for picture in pictures]
    filled = [_plain_filled(picture, known[0]) for picture, known in zip(pictures, masks, strict=True)]
    for _ in range(2):
        for picture, known, unmarked in zip(pictures, masks, filled, strict=True):
            for dot, expected in zip(dots, known, strict=True):
                assert np.array_equal(marker_mask(picture, dot), expected)
            difference = remove_markers(picture, known[0]).astype(int) - unmarked
            assert np.abs(difference).max() <= 1


def test_threads_do_not_disturb_each_other() -> None:
    pictures = [_picture(200, 151 + index, seed=2 * index + 1) for index in range(2)]
    pictures += [picture[::-1].copy() for picture in pictures]

    def both(picture: Image) -> tuple[Image, Image]:
        covered = marker_mask(picture, Dot(4.0))
        return covered, remove_markers(picture, covered)

    alone = [both(picture) for picture in pictures]
    with ThreadPoolExecutor(4) as threads:
        together = list(threads.map(both, pictures * 50))
    for index, (covered, unmarked) in enumerate(together):
        assert np.array_equal(covered, alone[index % 4][0])
        assert np.array_equal(unmarked, alone[index % 4][1])
