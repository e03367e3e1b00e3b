"""Pictures and masks by rule and at random, and a small gel whose truth is known."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Points = NDArray[np.float64]
Shape = tuple[int, int]

SIZE: Final = (176, 128)
"""Width and height of the small gel, px."""
PITCH_PX: Final = 28
DOT_RADIUS_PX: Final = 6.0
"""Distance and radius of its dots, px."""
CONTACT_CENTER_PX: Final = (90.0, 61.0)
"""Centre of the contact, px."""
CONTACT_AXES_PX: Final = (34.0, 19.0)
"""Half axes of the contact, px; the long one at `CONTACT_ANGLE_DEG` degrees, counter-clockwise on the
screen."""
CONTACT_ANGLE_DEG: Final = 25.0
CONTACT_RISE_GREY: Final = 45
"""How much the contact brightens, grey levels."""


@dataclass(frozen=True, slots=True)
class Gel:
    """Pictures of a gel, untouched and touched, and the truth about the second one.

    Attributes
    ----------
    mask : (H, W) uint8, 255 in contact.
    """

    reference: Image
    touched: Image
    origin: Points
    position: Points
    mask: Image


@lru_cache
def gel(*, dots: bool = True, noise: float = 1.0) -> Gel:
    """A gel that brightens in all channels where it is touched, which every method sees.

    Dots move by up to 2.5 px, and less with the distance from the contact; `dots` = False leaves them out.
    """
    width, height = SIZE
    x, y = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    dot_grid = np.meshgrid(np.arange(20, width, PITCH_PX), np.arange(23, height, PITCH_PX))
    origin = np.stack(dot_grid, axis=-1).reshape(-1, 2).astype(np.float64)
    away = np.hypot(*(origin - CONTACT_CENTER_PX).T)
    position = origin + np.exp(-((away / 45) ** 2))[:, None] * [2.3, 1.1]
    turn = np.radians(CONTACT_ANGLE_DEG)
    along = (x - CONTACT_CENTER_PX[0]) * np.cos(turn) - (y - CONTACT_CENTER_PX[1]) * np.sin(turn)
    across = (x - CONTACT_CENTER_PX[0]) * np.sin(turn) + (y - CONTACT_CENTER_PX[1]) * np.cos(turn)
    inside = np.hypot(along / CONTACT_AXES_PX[0], across / CONTACT_AXES_PX[1])
    rise = np.clip((1 - inside) * 8 + 0.5, 0, 1) * CONTACT_RISE_GREY
    shade = np.stack([110 + 0.10 * x, 120 + 0.08 * y, 115 - 0.05 * x + 0.05 * y], axis=-1)
    random = np.random.default_rng(5)
    pictures = []
    for centers, light in ((origin, np.zeros_like(rise)), (position, rise)):
        coverage = np.zeros_like(x)
        for dot_x, dot_y in centers if dots else ():
            np.maximum(
                coverage, np.clip(DOT_RADIUS_PX + 0.5 - np.hypot(x - dot_x, y - dot_y), 0, 1), out=coverage
            )
        picture = (shade + light[..., None]) * (1 - 0.85 * coverage[..., None])
        picture += random.normal(0, noise, picture.shape)
        pictures.append(np.clip(np.rint(picture), 0, 255).astype(np.uint8))
        pictures[-1].flags.writeable = False
    mask = (inside < 1).astype(np.uint8) * np.uint8(255)
    return Gel(pictures[0], pictures[1], origin, position, mask)


def tile(picture: Image, shape: Shape) -> Image:
    """The picture, repeated or cut to another shape (H, W)."""
    repeats = [-(-side // own) for side, own in zip(shape, picture.shape, strict=False)]
    return np.tile(picture, (*repeats, 1))[: shape[0], : shape[1]].copy()


def checkerboard(shape: Shape, cell: int) -> Image:
    """(H, W) uint8 of 0 and 255. cell : px."""
    rows, columns = np.indices(shape) // cell
    return ((rows + columns) % 2 * 255).astype(np.uint8)


def _constant(*levels: int) -> Callable[[Shape], Image]:
    return lambda shape: np.full((*shape, 3), levels, np.uint8)


def _board(cell: int) -> Callable[[Shape], Image]:
    return lambda shape: np.repeat(checkerboard(shape, cell)[..., None], 3, axis=2)


def _ramp(shape: Shape) -> Image:
    row = np.linspace(0, 255, shape[1]).astype(np.uint8)
    return np.repeat(np.broadcast_to(row, shape)[..., None], 3, axis=2).copy()


def _halves(shape: Shape) -> Image:
    picture = np.full((*shape, 3), 90, np.uint8)
    picture[:, shape[1] // 2 :] = 170
    return picture


PICTURES: Final[Mapping[str, Callable[[Shape], Image]]] = {
    "black": _constant(0, 0, 0),
    "white": _constant(255, 255, 255),
    "constant": _constant(120, 120, 120),
    "one channel": _constant(0, 0, 255),
    "fine checkerboard": _board(1),
    "checkerboard": _board(8),
    "ramp": _ramp,
    "two halves": _halves,
    "noise": lambda shape: np.random.default_rng(3).integers(0, 256, (*shape, 3), dtype=np.uint8),
}
"""Name -> picture (H, W, 3) of a shape (H, W)."""

RADIUS_SHARE: Final = 0.3
"""Radius of the disc, of the shorter side of the picture."""


def _drawn(draw: Callable[[Image, int, int], object]) -> Callable[[Shape], Image]:
    def mask(shape: Shape) -> Image:
        empty = np.zeros(shape, np.uint8)
        draw(empty, shape[1], shape[0])
        return empty

    return mask


def _points(mask: Image, width: int, height: int) -> None:
    mask[height // 3, width // 4] = mask[2 * height // 3, 3 * width // 4] = 255


def _holed(mask: Image, width: int, height: int) -> None:
    mask[:] = 255
    mask[height // 2, width // 2] = 0


def _disc(mask: Image, width: int, height: int) -> None:
    radius = max(1, int(RADIUS_SHARE * min(width, height)))
    cv2.circle(mask, (width // 2, height // 2), radius, 255, -1)


MASKS: Final[Mapping[str, Callable[[Shape], Image]]] = {
    "nothing": _drawn(lambda *_: None),
    "one pixel": _drawn(lambda mask, w, h: mask.__setitem__((h // 2, w // 2), 255)),
    "two points": _drawn(_points),
    "a line": _drawn(lambda mask, w, h: cv2.line(mask, (w // 5, h // 2), (w - 1 - w // 5, h // 2), 255)),
    "an upright line": _drawn(
        lambda mask, w, h: cv2.line(mask, (w // 2, h // 5), (w // 2, h - 1 - h // 5), 255)
    ),
    "a diagonal": _drawn(lambda mask, w, h: cv2.line(mask, (1, min(w, h) - 2), (min(w, h) - 2, 1), 255)),
    "a disc": _drawn(_disc),
    "cut off by the border": _drawn(lambda mask, w, h: cv2.circle(mask, (w - 1, h // 2), h // 3, 255, -1)),
    "a corner": _drawn(lambda mask, w, h: mask.__setitem__((slice(h // 4), slice(w // 4)), 255)),
    "the border": _drawn(lambda mask, w, h: cv2.rectangle(mask, (0, 0), (w - 1, h - 1), 255)),
    "the whole picture": lambda shape: np.full(shape, 255, np.uint8),
    "all but one pixel": _drawn(_holed),
    "fine checkerboard": lambda shape: checkerboard(shape, 1),
    "checkerboard": lambda shape: checkerboard(shape, 8),
}
"""Name -> mask (H, W) of a shape (H, W)."""


def random_picture(random: np.random.Generator, shape: Shape) -> Image:
    """A picture at random: noise of any coarseness and contrast on any level, with blots."""
    coarse = [max(1, side // int(random.integers(1, 12))) for side in shape]
    noise = random.normal(0, random.choice([0, 1, 5, 30, 90]), (*coarse, 3)).astype(np.float32)
    picture = cv2.resize(noise, shape[::-1], interpolation=cv2.INTER_LINEAR).reshape(*shape, 3)
    picture += random.uniform(-20, 275, 3).astype(np.float32)
    for _ in range(int(random.integers(0, 40))):
        place = tuple(int(random.integers(-5, side + 5)) for side in shape[::-1])
        level = tuple(float(value) for value in random.uniform(0, 255, 3))
        cv2.circle(picture, place, int(random.integers(1, 1 + max(1, min(shape) // 8))), level, -1)
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)


def random_mask(random: np.random.Generator, shape: Shape) -> Image:
    """A mask at random: a share of the pixels of noise of any coarseness."""
    coarse = [max(1, side // int(random.integers(1, 12))) for side in shape]
    noise = cv2.resize(random.random(coarse).astype(np.float32), shape[::-1]).reshape(shape)
    return np.where(noise < random.random(), 255, 0).astype(np.uint8)
