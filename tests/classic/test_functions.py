"""The original script's masks of markers and contact, and the reference of its difference."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from tactflow.classic.functions import difference, mask_marker
from tactflow.engine.frame import Frame
from tactflow.stages.classic_difference import ClassicDifference as Difference

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


GREY = np.full((40, 60, 3), 100, np.uint8)


def frame(seq: int, *, reference: bool = False) -> Frame:
    return Frame("test", seq, seq / 60, GREY, reference=reference)


def test_the_difference_is_taken_from_the_last_reference_until_a_reset() -> None:
    stage, touched = Difference(Difference.Params()), GREY.copy()
    touched[10:30, 10:40] += 20
    assert not stage.process(GREY - np.uint8(50), frame(0, reference=True)).touching
    assert not stage.process(GREY, frame(1, reference=True)).touching
    result = stage.process(touched, frame(2))
    assert result.touching
    assert np.array_equal(result.contact_mask, difference(touched, GREY))
    stage.reset()
    assert not stage.process(touched, frame(3)).touching
