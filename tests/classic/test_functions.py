"""The original script's masks of markers and contact."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from tactflow.classic.functions import difference, mask_marker

BRIGHTER_BY = 14
"""Smallest brightening, grey levels, that passes the script's threshold of 140."""


def _all_pairs() -> tuple[np.ndarray, np.ndarray]:
    """Every (frame, reference) pair of values once."""
    frame, reference = np.meshgrid(np.arange(256, dtype=np.uint8), np.arange(256, dtype=np.uint8))
    return frame.ravel(), reference.ravel()


@pytest.mark.parametrize("channel", [0, 1, 2])
def test_contact_is_brighter_by_14_grey_levels_for_every_pair_of_values_in_every_channel(
    channel: int,
) -> None:
    frame, reference = _all_pairs()
    for start in range(0, frame.size, 4096):
        part = slice(start, start + 4096)
        now = np.full((64, 64, 3), 200, np.uint8)
        before = np.full((64, 64, 3), 100, np.uint8)
        now[..., channel] = frame[part].reshape(64, 64)
        before[..., channel] = reference[part].reshape(64, 64)
        # Tiles of 11 x 11 px survive the erosion by 9 x 9, so each pair of values decides its own pixels.
        large_now = now.repeat(11, axis=0).repeat(11, axis=1)
        large_before = before.repeat(11, axis=0).repeat(11, axis=1)
        centers = difference(large_now, large_before)[5::11, 5::11].ravel() == 255
        brighter_by = frame[part].astype(int) - reference[part].astype(int)
        # A dilation by 5 x 5 reaches no further than 2 px: neighbours cannot decide a tile's centre.
        assert np.array_equal(centers, brighter_by >= BRIGHTER_BY)


def test_the_scale_of_negative_differences_changes_nothing() -> None:
    rng = np.random.default_rng(2)
    frame, reference = rng.integers(0, 256, (2, 40, 50, 3), dtype=np.uint8)
    masks = [difference(frame, reference, scale=scale) for scale in (0.2, 0.5, 0.7)]
    assert np.array_equal(masks[0], masks[1])
    assert np.array_equal(masks[1], masks[2])


def test_brightening_in_two_channels_only_is_not_contact() -> None:
    reference = np.full((40, 40, 3), 100, np.uint8)
    frame = reference.copy()
    frame[..., :2] += 50
    assert not difference(frame, reference).any()
    frame[..., 2] += BRIGHTER_BY
    assert difference(frame, reference).all()


def test_mask_marker_follows_the_description_step_by_step() -> None:
    rng = np.random.default_rng(3)
    image = np.full((121, 90, 3), 150, np.uint8)
    for x, y in rng.uniform(12, 78, (8, 2)):
        cv2.circle(image, (int(x), int(y)), 5, (40, 30, 20), -1)
    small = cv2.pyrDown(image).astype(np.float32)
    amplified = (cv2.GaussianBlur(small, (25, 25), 0) - cv2.GaussianBlur(small, (15, 15), 0)) * 20
    amplified[amplified < 0] = 0
    amplified[amplified > 255] = 255
    votes = [(amplified[..., channel] > 120).astype(int) for channel in range(3)]
    marked = votes[0] * votes[1] + votes[0] * votes[2] + votes[1] * votes[2] > 0
    expected = cv2.resize(marked.astype(np.uint8), (90, 121)) * 255
    mask = mask_marker(image)
    assert mask.any()
    assert np.array_equal(mask, expected)


@pytest.mark.parametrize("shape", [(10, 10), (10, 10, 4), (0, 5, 3)])
def test_an_array_that_is_not_a_colour_image_is_rejected_with_its_shape(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="required a non-empty"):
        mask_marker(np.zeros(shape, np.uint8))


def test_a_frame_of_another_size_than_the_reference_is_rejected() -> None:
    with pytest.raises(ValueError, match="required a reference of shape"):
        difference(np.zeros((4, 5, 3), np.uint8), np.zeros((5, 4, 3), np.uint8))
