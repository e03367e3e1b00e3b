"""The outline of one contact, and what it does where a marker was removed."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.vision.contact.contact_outline import (
    change_over_maximum,
    contact_level,
    largest_nearby,
)

Float = NDArray[np.float32]
Mask = NDArray[np.uint8]

SIZE = 100


def distance_from(x: float, y: float) -> Float:
    rows, columns = np.mgrid[:SIZE, :SIZE].astype(np.float32)
    return np.asarray(np.hypot(columns - np.float32(x), rows - np.float32(y)), np.float32)


CLINGS = 2.0
"""Distance from the border of a contact inwards to where the gel leaves the object, px at half resolution."""


LAMPS = np.array([[math.cos(k * 2 * math.pi / 3), -math.sin(k * 2 * math.pi / 3)] for k in range(3)])
"""(3, 2): how three lights from all sides answer to slopes along x and y."""
SLOPES = np.asarray(np.linalg.pinv(LAMPS), np.float32)
WHITE = np.full((1, 3), 1 / 3, np.float32)
"""The mixture that shows depth in white light."""


def tilted(outside: Float, ring: float = 3.0, skirt: float = 0.7) -> Float:
    """(h, w, 3) change of a gel that answers with its slope, largest where it leaves the object.

    outside : (h, w), distance from the border of the contact, px, negative inside. ring : how fast the slope
    fades towards the middle. skirt : slope just outside of where it clings relative to just inside; at the
    border, where the object crosses the untouched surface, 0.4 are left, between the 0.26 of a half-space
    (Hertz) and a thin layer, which is steepest there.
    """
    free = outside + CLINGS
    fading = CLINGS / np.log(max(skirt, 0.6) / 0.4)
    strength = np.where(free < 0, np.exp(free / ring), skirt * np.exp(-free / fading))
    blurred = cv2.GaussianBlur(strength.astype(np.float32), (0, 0), 0.8)
    turn = np.linspace(0, 2 * np.pi, SIZE, dtype=np.float32)[None, :]
    slopes = np.stack([np.broadcast_to(part, blurred.shape) for part in (np.cos(turn), np.sin(turn))], axis=2)
    return np.asarray(blurred[..., None] * (slopes @ LAMPS.T) * 0.4, np.float32)


def disc(radius: float = 30.0) -> Float:
    return np.asarray(distance_from(49.5, 49.5) - np.float32(radius), np.float32)


def punch(half_width: float = 32.0, half_height: float = 24.0) -> Float:
    rows, columns = np.mgrid[:SIZE, :SIZE].astype(np.float32)
    away = np.maximum(np.abs(columns - 49.5) - half_width, np.abs(rows - 49.5) - half_height)
    return np.asarray(away, np.float32)


def found(change: Float, core: NDArray[np.bool_], mixtures: Float = SLOPES) -> NDArray[np.bool_]:
    """Pixels in contact, of which some are known."""
    return np.asarray(contact_level(relative(change, mixtures), core.astype(np.uint8)) > 0, np.bool_)


def relative(change: Float, mixtures: Float = SLOPES) -> tuple[Float, float]:
    """Of a change (h, w, 3)."""
    return change_over_maximum(np.ascontiguousarray((change @ mixtures.T).transpose(2, 0, 1)))


def hull_of(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    hull = cv2.convexHull(np.argwhere(mask)[:, ::-1].astype(np.int32))
    return cv2.fillConvexPoly(np.zeros(mask.shape, np.uint8), hull, 1) > 0


def overlap(first: NDArray[np.bool_], second: NDArray[np.bool_]) -> float:
    return float((first & second).sum() / (first | second).sum())


@pytest.mark.parametrize("mixtures", [SLOPES, np.eye(3, dtype=np.float32)])
def test_a_disc_is_found_to_within_a_pixel(mixtures: Float) -> None:
    mask = found(tilted(disc()), disc() < -4, mixtures)
    assert math.sqrt(mask.sum() / math.pi) == pytest.approx(30, abs=1.0)


def test_a_higher_border_draws_the_outline_further_in() -> None:
    change, core = relative(tilted(disc())), (disc() < -4).astype(np.uint8)
    areas = [int((contact_level(change, core, border) > 0).sum()) for border in (0.3, 0.55, 0.85)]
    assert areas == sorted(areas, reverse=True)
    assert areas[0] > areas[2]


def test_the_core_of_a_contact_ends_where_the_gel_leaves_the_object() -> None:
    shown = relative(tilted(disc()))
    level = contact_level(shown, (disc() < -4).astype(np.uint8), 0.85)
    assert math.sqrt((level > 0).sum() / math.pi) == pytest.approx(30 - CLINGS, abs=1.0)


@pytest.mark.parametrize("size", [(2, 2), (2, 8), (32, 44)])
def test_the_largest_change_nearby_is_found_up_to_the_border(size: tuple[int, int]) -> None:
    change = np.random.default_rng(0).random(size).astype(np.float32)
    near = np.zeros_like(change)
    largest_nearby(change, 0.55, near)
    smooth = cv2.blur(change, (3, 3))
    assert near.min() > 0
    assert near.max() <= smooth.max() * (1 + 1e-6)


def test_what_the_core_does_not_reach_is_no_part_of_the_contact() -> None:
    clean = np.repeat((disc(20) < 0)[..., None], 3, axis=2).astype(np.float32)
    speck = clean.copy()
    speck[4:20, 4:20] = 1
    assert np.array_equal(found(speck, disc(10) < 0), found(clean, disc(10) < 0))


def test_every_part_that_the_core_reaches_belongs_to_the_contact() -> None:
    change = np.zeros((SIZE, SIZE, 3), np.float32)
    change[10:30, 20:80] = change[50:70, 20:80] = 1
    core = np.zeros((SIZE, SIZE), np.bool_)
    core[15:25, 40:60] = core[55:65, 40:60] = True
    mask = found(change, core)
    assert mask[20, 50]
    assert mask[60, 50]
    assert not mask[40, 50]


def test_masks_are_left_as_they_are() -> None:
    change, core = tilted(disc()), (disc() < -4).astype(np.uint8)
    kept = change.copy(), core.copy()
    contact_level(relative(change), core)
    assert np.array_equal(change, kept[0])
    assert np.array_equal(core, kept[1])


def test_a_darkened_contact_with_a_bright_halo_ends_where_it_turns_bright() -> None:
    away = disc(24)
    darker = np.clip(-away / 6, 0, 1) - 0.4 * np.exp(-((away - 8) ** 2) / 50) * (away > 0)
    mask = found(-np.repeat(darker[..., None], 3, axis=2).astype(np.float32), away < -4, WHITE)
    # It darkens over 6 px, and is 0.15 dark 0.9 px inside; with the halo's size it would reach 9 px further.
    assert math.sqrt(mask.sum() / math.pi) == pytest.approx(24 - 0.9, abs=0.5)


def test_relief_of_an_object_that_is_steeper_than_its_border_does_not_draw_the_outline_in() -> None:
    relief = 3 * tilted(np.abs(disc(12)) - 1.5, ring=1.0, skirt=0.0)
    mask = found(tilted(disc()) + relief, disc() < -4)
    assert math.sqrt(mask.sum() / math.pi) == pytest.approx(30, abs=1.0)


def test_a_faint_band_of_light_through_a_contact_does_not_move_its_outline() -> None:
    ball, core = tilted(disc(16)), disc(16) < -4
    band = np.zeros_like(ball)
    band[:, 56:72] = 0.2 * np.linalg.norm(ball, axis=2).max() / 3**0.5
    assert overlap(found(ball + band, core), found(ball, core)) > 0.95


def test_a_large_contact_has_the_same_outline_however_it_is_turned() -> None:
    strip = cv2.resize(tilted(punch(40, 12), ring=20), None, fx=2, fy=2)
    noise = np.random.default_rng(0).normal(0, 0.04, strip.shape)
    change = np.asarray(strip + noise * (np.linalg.norm(strip, axis=2) > 0.05)[..., None], np.float32)
    core = cv2.resize(punch(40, 12), None, fx=2, fy=2) < -4
    turned = np.ascontiguousarray(np.rot90(change))
    outlines = found(change, core), found(turned, np.ascontiguousarray(np.rot90(core)))
    assert overlap(np.rot90(outlines[0]), outlines[1]) > 0.99


def test_a_brightened_contact_reaches_as_far_where_it_is_dim() -> None:
    away, across = disc(32), (np.arange(SIZE) - 49.5) / 32
    uneven = (0.5 - 0.5 * np.tanh(away / 4)) * np.clip(0.65 + 0.35 * across, 0.3, 1.0)
    mask = found(np.repeat(uneven[..., None], 3, axis=2).astype(np.float32), disc(16) < 0, WHITE)
    assert 49.5 - np.flatnonzero(mask[50])[0] > 28


@pytest.mark.parametrize("mixtures", [np.full((2, 3), 0.4, np.float32), WHITE], ids=["slope", "one"])
@pytest.mark.parametrize("turn", [0, 30, 90, 135])
def test_both_flanks_of_a_ball_lit_from_one_side_are_one_contact(turn: int, mixtures: Float) -> None:
    rows, columns = np.mgrid[:SIZE, :SIZE].astype(np.float32) - np.float32(49.5)
    toward = columns * math.cos(math.radians(turn)) + rows * math.sin(math.radians(turn))
    slope = np.where(disc(24) < 0, toward / 24, np.float32(0)).astype(np.float32)
    change = np.repeat(cv2.GaussianBlur(slope, (0, 0), 0.8)[..., None], 3, axis=2)
    mask = found(change, disc(16) < 0, mixtures)
    # One of the flanks alone has its centroid 14 px off.
    assert math.hypot(*(float(places[mask].mean()) for places in (rows, columns))) < 0.5
    # The slope vanishes where the light comes along the border, so that the outline is drawn in there.
    assert overlap(hull_of(mask), disc(24) < 0) > 0.7
