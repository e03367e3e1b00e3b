"""Outputs follow when the picture is moved, turned, mirrored or enlarged.

Nothing here needs truth: the answer for the changed picture is compared with the changed answer. "Measured"
bounds were found on the small gel of `builders` and are twice the largest deviation seen there.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.vision.change import ChangeProbe
from tactflow.vision.types import Markers
from tests.stress.builders import (
    PICTURE_METHODS,
    SIZE,
    Image,
    Points,
    apart,
    gel,
    tracked,
)

WIDTH, HEIGHT = SIZE


def doubled(picture: Image) -> Image:
    """Twice as large, by interpolation: blocks of equal pixels are not what a lens makes."""
    return np.asarray(cv2.resize(picture, None, fx=2, fy=2, interpolation=cv2.INTER_LINEAR), np.uint8)


def turned(picture: Image) -> Image:
    return np.ascontiguousarray(np.rot90(picture))


def mirrored(picture: Image) -> Image:
    return np.ascontiguousarray(picture[:, ::-1])


# What is done to a picture -> what that does to points. One turn and one mirror swap and reverse both axes.
MOTIONS: dict[Callable[[Image], Image], Callable[[Points], Points]] = {
    turned: lambda p: np.column_stack([p[:, 1], WIDTH - 1 - p[:, 0]]),
    mirrored: lambda p: np.column_stack([WIDTH - 1 - p[:, 0], p[:, 1]]),
    doubled: lambda p: 2 * p + 0.5,
}


def paired(before: Markers, after: Markers, origin: Points) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """For each marker of `before`, whose origin is now expected at `origin`: its index in `after`, and how
    far that one's origin is off, px."""
    away = np.hypot(*(origin[:, None] - after.origin[None]).transpose(2, 0, 1))
    assert len(before.origin) == len(origin)
    return away.argmin(axis=1), away.min(axis=1)


@pytest.mark.parametrize("motion", MOTIONS)
def test_the_tracker_follows(motion: Callable[[Image], Image]) -> None:
    pictures = gel()
    here = tracked(pictures.reference, pictures.touched)
    there = tracked(motion(pictures.reference), motion(pictures.touched))
    # Moved: whole-pixel reads and the same sub-pixel phases up to sign; derived 1e-3, since the search for a
    # centre ends within that of its goal. Doubled: noise of another scale, measured 0.011 and 0.062.
    of_origin, of_position = (0.022, 0.13) if motion is doubled else (1e-3, 1e-3)
    index, away = paired(here, there, MOTIONS[motion](here.origin))
    assert sorted(index.tolist()) == list(range(24))
    assert away.max() <= of_origin
    expected = MOTIONS[motion](here.position)
    assert np.hypot(*(there.position[index] - expected).T).max() <= of_position
    assert (there.status[index] == here.status).all()


# How far masks may be apart within the part that both pictures show, px. Blocks of 2 x 2 (marker_mask) and
# cells of 4 x 4 (noise) fall elsewhere on the gel: measured 1. colour: exact.
SHIFT_BOUND = {"marker_mask": 2.0, "difference-noise": 2.0, "difference-colour": 0.0}


@pytest.mark.parametrize("shift", [(1, 0), (3, 2), (8, 4)], ids=str)
def test_masks_and_markers_follow_a_translation(shift: tuple[int, int]) -> None:
    x, y = shift
    for method, bound in SHIFT_BOUND.items():
        dots = method == "marker_mask"
        here, there = gel(dots=dots), gel(shift, dots=dots)
        before = PICTURE_METHODS[method](here.reference, here.touched)[
            y + 24 : HEIGHT - 24, x + 24 : WIDTH - 24
        ]
        after = PICTURE_METHODS[method](there.reference, there.touched)
        after = after[24 : HEIGHT - 24 - y, 24 : WIDTH - 24 - x]
        assert before.any()
        # A dot that the window cuts is judged by what is left of it: one pixel in, or one pixel out.
        assert apart(whole(before, after), whole(after, before)) <= bound
    markers, moved = (tracked(pictures.reference, pictures.touched) for pictures in (gel(), gel(shift)))
    origin = markers.origin - shift
    inner = ((origin > 24) & (origin < np.array(SIZE) - 25)).all(axis=1)
    assert inner.sum() >= 8
    index, away = paired(markers, moved, origin)
    # Which marks are in view decides when the search for centres ends; measured 2e-8.
    assert away[inner].max() <= 1e-3
    assert np.hypot(*(moved.position[index] - markers.position + shift).T)[inner].max() <= 1e-3


def whole(mask: Image, other: Image) -> Image:
    """The mask without spots at the border, of it or of the other one, which the window has cut."""
    either = np.pad((mask > 0) | (other > 0), 1, constant_values=True).astype(np.uint8)
    labels = cv2.connectedComponents(either)[1]
    return np.where(labels[1:-1, 1:-1] != labels[0, 0], mask, 0).astype(np.uint8)


def test_the_probe_follows_turns_and_mirrors() -> None:
    """What it looks at is chosen anew, but still frames stay still and a touch is seen."""
    for change in (turned, mirrored):
        picture, random = change(gel().reference), np.random.default_rng(1)
        frames = [
            np.clip(np.rint(picture + random.normal(0, 1, picture.shape)), 0, 255).astype(np.uint8)
            for _ in range(31)
        ]
        probe = ChangeProbe(frames[0], false_alarms=1e-6)
        for frame in frames[1:21]:
            probe.look(frame)
        probe.anchor_here()
        assert not any(map(probe.look, frames[21:])), change.__name__
        assert probe.look(change(gel().touched)), change.__name__
