"""What the stress tests share: a small gel on an endless canvas, motions, and what a "defined" answer is."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactflow.engine.frame import Absent
from tactflow.vision.contact import ContactDetector
from tactflow.vision.markers.detection import detect_markers
from tactflow.vision.markers.inpaint import remove_markers
from tactflow.vision.markers.mask import Dot, find_dot, marker_mask
from tactflow.vision.markers.tracking import MarkerTracker
from tactflow.vision.types import Markers

Image = NDArray[np.uint8]
Points = NDArray[np.float64]

SIZE = (176, 128)
"""Width and height of the small gel, px."""
PITCH = 28
RADIUS = 6.0
CONTACT = (90.0, 61.0)
"""Centre of the contact, px."""
AXES = (34.0, 19.0)
"""Half axes of the contact, px; the long one at `TURN` degrees, counter-clockwise on the screen."""
TURN = 25.0


@dataclass(frozen=True)
class Gel:
    """Pictures of a gel, untouched and touched, and the truth about the second one."""

    reference: Image
    touched: Image
    origin: Points
    position: Points
    mask: Image
    """(H, W) uint8, 255 in contact."""


@lru_cache
def gel(*, dots: bool = True, noise: float = 1.0) -> Gel:
    """A gel that brightens by 45 grey levels in all channels where it is touched, which every method sees.

    Dots move by up to 2.5 px, and less with the distance from the contact; `dots` = False leaves them out.
    """
    width, height = SIZE
    x, y = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    dot_grid = np.meshgrid(np.arange(20, width, PITCH), np.arange(23, height, PITCH))
    origin = np.stack(dot_grid, axis=-1).reshape(-1, 2).astype(np.float64)
    away = np.hypot(*(origin - CONTACT).T)
    position = origin + np.exp(-((away / 45) ** 2))[:, None] * [2.3, 1.1]
    turn = np.radians(TURN)
    along = (x - CONTACT[0]) * np.cos(turn) - (y - CONTACT[1]) * np.sin(turn)
    across = (x - CONTACT[0]) * np.sin(turn) + (y - CONTACT[1]) * np.cos(turn)
    inside = np.hypot(along / AXES[0], across / AXES[1])
    rise = np.clip((1 - inside) * 8 + 0.5, 0, 1) * 45
    shade = np.stack([110 + 0.10 * x, 120 + 0.08 * y, 115 - 0.05 * x + 0.05 * y], axis=-1)
    random = np.random.default_rng(5)
    pictures = []
    for centers, light in ((origin, np.zeros_like(rise)), (position, rise)):
        coverage = np.zeros_like(x)
        for dot_x, dot_y in centers if dots else ():
            np.maximum(coverage, np.clip(RADIUS + 0.5 - np.hypot(x - dot_x, y - dot_y), 0, 1), out=coverage)
        picture = (shade + light[..., None]) * (1 - 0.85 * coverage[..., None])
        picture += random.normal(0, noise, picture.shape)
        pictures.append(np.clip(np.rint(picture), 0, 255).astype(np.uint8))
        pictures[-1].flags.writeable = False
    return Gel(*pictures, origin, position, (inside < 1).astype(np.uint8) * np.uint8(255))


# -- every method of every stage that looks at pictures ---------------------------------------------------


def dog_mask(reference: Image, image: Image) -> Image:
    """The marker mask; empty where the reference shows no markers, as in the stage."""
    dot = find_dot(reference)
    return np.zeros(image.shape[:2], np.uint8) if dot is None else marker_mask(image, dot)


def detector(reference: Image) -> ContactDetector:
    """A detector with one reference."""
    contact = ContactDetector()
    contact.add_reference(reference)
    return contact


def contact_mask(reference: Image, image: Image) -> Image:
    """The contact mask of one image against one reference."""
    return detector(reference).detect(image).mask


def tracked(reference: Image, image: Image) -> Markers:
    """The markers of the reference in one image."""
    return MarkerTracker(reference, detect_markers(reference)).track(image)


def filled(method: Any, _reference: Image, image: Image) -> Image:
    """The image without what looks like markers of radius 3 px."""
    return remove_markers(image, marker_mask(image, Dot(3.0)), method=method)


INPAINTING = ("normalized", "telea", "ns", "none")
PICTURE_METHODS: Mapping[str, Callable[[Image, Image], Any]] = {
    "marker_mask": dog_mask,
    **{f"inpaint-{name}": partial(filled, name) for name in INPAINTING},
    "difference": contact_mask,
    "tracker": tracked,
}
"""Name -> callable of (reference, image)."""


# -- defined answers --------------------------------------------------------------------------------------


def assert_defined(value: Any) -> None:
    """No NaN and no infinity anywhere in a result, except for standard errors that are not known."""
    if value is None or isinstance(value, bool | str | Absent | np.bool_):
        return
    if isinstance(value, int | float | complex):
        assert np.isfinite(value), value
    elif isinstance(value, np.ndarray):
        assert value.dtype != object
        assert np.isfinite(value).all()
    elif isinstance(value, Markers):
        for part in (value.origin, value.position, value.status):
            assert_defined(part)
        assert not np.isinf(value.stderr).any()
        assert len(value.origin) == len(value.position) == len(value.status) == len(value.stderr)
    elif dataclasses.is_dataclass(value):
        for part in dataclasses.fields(value):
            assert_defined(getattr(value, part.name))
    else:
        for part in value:
            assert_defined(part)


def assert_mask(mask: Image, shape: tuple[int, int]) -> None:
    """(H, W) uint8 of 0 and 255."""
    assert mask.shape == shape
    assert mask.dtype == np.uint8
    assert set(np.unique(mask).tolist()) <= {0, 255}
