"""What a camera delivers instead of its pictures: empty buffers, leftovers, light that settles, lost rows."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from tactflow.sim.settings import Settings
from tactflow.vision.arrays import ColorImage

_EMPTY_COLOURS = {"black": (0, 0, 0), "green": (0, 135, 0)}
"""Blue, green and red of an empty RGB buffer and of an empty YUV buffer."""
_OVEREXPOSURE_GAIN = 2.0
"""Gain of the first picture of a camera that then lowers it frame by frame."""
_DISPLACEMENT_PX = 8
"""Distance by which rows are displaced, px: four pixel pairs of YUYV."""


def delivered(index: int, settings: Settings, render: Callable[[int], ColorImage]) -> ColorImage:
    """Frame `index` as the camera delivers it. render : draws a frame, (H, W, 3) uint8, which is new."""
    if index < settings.late and settings.first != "gel":
        return _first(index, settings, render)
    picture = render(index)
    if settings.damaged and index % settings.damaged == settings.damaged - 1:
        _damage(picture, index // settings.damaged, settings.seed)
    return picture


def _first(index: int, settings: Settings, render: Callable[[int], ColorImage]) -> ColorImage:
    if settings.first in _EMPTY_COLOURS:
        picture = render(0)
        picture[:] = _EMPTY_COLOURS[settings.first]
    elif settings.first == "leftover":
        # Another gel: seen from the other side, in the middle of a recording.
        picture = np.ascontiguousarray(render(settings.frames // 3)[::-1, ::-1])
    elif settings.first == "half":
        picture = render(index)
        _damage(picture, 0, settings.seed)
    else:
        gain = _OVEREXPOSURE_GAIN ** (1 - index / settings.late)
        picture = np.asarray(cv2.convertScaleAbs(render(index), alpha=gain), np.uint8)
    return picture


def _damage(picture: ColorImage, number: int, seed: int) -> None:
    """Damage the lower half of a picture, in place: gray, noise and displaced rows in turns."""
    lower = picture[len(picture) // 2 :]
    if number % 3 == 0:
        lower[:] = 128
    elif number % 3 == 1:
        lower[:] = np.random.default_rng([seed, 0x6461, number]).integers(0, 256, lower.shape, np.uint8)
    else:
        lower[:] = np.roll(lower, _DISPLACEMENT_PX, axis=1)
