"""The original script's rules, literally and in integers."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from tactflow.classic.functions import (
    BRIGHTER_BY,
    contact_mask,
    difference,
    mask_marker,
)


def _all_pairs() -> tuple[np.ndarray, np.ndarray]:
    """Every (frame, reference) pair of values once."""
    frame, reference = np.meshgrid(np.arange(256, dtype=np.uint8), np.arange(256, dtype=np.uint8))
    return frame.ravel(), reference.ravel()


@pytest.mark.parametrize("channel", [0, 1, 2])
def test_integer_rule_equals_the_floating_point_chain_for_every_pair_of_values_in_every_channel(
    channel: int,
) -> None:
    frame, reference = _all_pairs()
    for start in range(0, frame.size, 4096):
        part = slice(start, start + 4096)
        now = np.full((64, 64, 3), 200, np.uint8)
        before = np.full((64, 64, 3), 100, np.uint8)
        now[..., channel] = frame[part].reshape(64, 64)
        before[..., channel] = reference[part].reshape(64, 64)
        # Tiles of 11 x 11 px survive the erosion by 9 x 9, so that each pair decides about pixels of its own.
        large_now = now.repeat(11, axis=0).repeat(11, axis=1)
        large_before = before.repeat(11, axis=0).repeat(11, axis=1)
        expected = difference(large_now, large_before)
        assert np.array_equal(contact_mask(large_now, large_before), expected)
        centers = expected[5::11, 5::11].ravel() == 255
        brighter_by = frame[part].astype(int) - reference[part].astype(int)
        # A dilation by 5 x 5 reaches no further than 2 px: neighbours cannot decide a tile's centre.
        assert np.array_equal(centers, brighter_by >= BRIGHTER_BY)


def test_integer_rule_equals_the_chain_on_noise_and_blobs() -> None:
    rng = np.random.default_rng(1)
    reference = rng.integers(60, 180, (97, 131, 3), dtype=np.uint8)
    frame = np.clip(reference.astype(int) + rng.integers(-8, 9, reference.shape), 0, 255).astype(np.uint8)
    frame[20:60, 30:90] = np.minimum(frame[20:60, 30:90].astype(int) + 30, 255).astype(np.uint8)
    mask = contact_mask(frame, reference)
    assert mask.any()
    assert np.array_equal(mask, difference(frame, reference))


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
    assert not contact_mask(frame, reference).any()
    frame[..., 2] += BRIGHTER_BY
    assert contact_mask(frame, reference).all()


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
def test_what_is_not_a_colour_image_is_refused_with_its_shape(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="required a non-empty"):
        mask_marker(np.zeros(shape, np.uint8))


def test_another_size_than_the_reference_is_refused() -> None:
    with pytest.raises(ValueError, match="required a reference of shape"):
        contact_mask(np.zeros((4, 5, 3), np.uint8), np.zeros((5, 4, 3), np.uint8))
