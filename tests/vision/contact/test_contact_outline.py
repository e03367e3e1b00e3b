"""The outline of one contact, and what it does where a marker was removed."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.vision.contact import ContactDetector
from tactflow.vision.contact.contact_outline import WindowChange, contact_level
from tactflow.vision.contact.filling import enclosed, outlined
from tactflow.vision.contact.nearby import FAINT, largest_nearby

Float = NDArray[np.float32]
Mask = NDArray[np.uint8]

SIZE = 100
DOT = 7
"""Radius of a removed marker with its soft border, px at half resolution: a large one."""


def change_of(picture: Float, inside: Mask) -> WindowChange:
    """A change of three channels, (h, w, 3) float32; only what is not 0 in `inside` counts."""
    counts = (inside > 0)[..., None] * picture
    strength = np.asarray(np.sqrt((counts * counts).sum(axis=2)), np.float32)
    brightness = np.asarray(counts.mean(axis=2), np.float32)
    return WindowChange(strength, brightness)


def distance_from(x: float, y: float) -> Float:
    rows, columns = np.mgrid[:SIZE, :SIZE].astype(np.float32)
    return np.asarray(np.hypot(columns - np.float32(x), rows - np.float32(y)), np.float32)


CLINGS = 2.0
"""Distance from the border of a contact inwards to where the gel leaves the object, px at half resolution."""


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
    # Three lights: what one channel loses another gains.
    shares = np.stack(
        [np.broadcast_to(np.cos(turn + k * 2 * np.pi / 3), blurred.shape) for k in range(3)], axis=2
    )
    return np.asarray(blurred[..., None] * shares * 0.4, np.float32)


def disc(radius: float = 30.0) -> Float:
    return np.asarray(distance_from(49.5, 49.5) - np.float32(radius), np.float32)


def punch(half_width: float = 32.0, half_height: float = 24.0) -> Float:
    rows, columns = np.mgrid[:SIZE, :SIZE].astype(np.float32)
    away = np.maximum(np.abs(columns - 49.5) - half_width, np.abs(rows - 49.5) - half_height)
    return np.asarray(away, np.float32)


def without_markers(change: Float, places: list[tuple[float, float]]) -> tuple[Float, Mask]:
    """What removing markers leaves of a change: painted from around, a gap and a bulge; and where."""
    hidden = np.zeros((SIZE, SIZE), np.uint8)
    for x, y in places:
        hidden |= (distance_from(x, y) <= DOT).view(np.uint8)
    seen = (1 - hidden).astype(np.float32)
    near = cv2.blur(change * seen[..., None], (2 * DOT + 1, 2 * DOT + 1))
    weight = np.maximum(cv2.blur(seen, (2 * DOT + 1, 2 * DOT + 1)), 1e-3)
    painted = np.where(hidden[..., None] > 0, near / weight[..., None], change)
    return np.asarray(painted, np.float32), hidden


def found(change: Float, hidden: Mask | None = None) -> NDArray[np.bool_]:
    """Pixels in contact; the change is known to belong to it wherever it is 2 % at least."""
    inside = (np.linalg.norm(change, axis=2) > 0.02).astype(np.uint8)
    if hidden is not None:
        hidden = hidden * inside
    return np.asarray(contact_level(change_of(change, inside), 4.0, hidden) > 0, np.bool_)


def hull_of(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    hull = cv2.convexHull(np.argwhere(mask)[:, ::-1].astype(np.int32))
    return cv2.fillConvexPoly(np.zeros(mask.shape, np.uint8), hull, 1) > 0


def overlap(first: NDArray[np.bool_], second: NDArray[np.bool_]) -> float:
    return float((first & second).sum() / (first | second).sum())


def test_a_disc_is_found_to_within_a_pixel() -> None:
    mask = found(tilted(disc()))
    # The profile falls by a tenth of its peak per pixel there, and gels differ by more.
    assert math.sqrt(mask.sum() / math.pi) == pytest.approx(30, abs=1)


@pytest.mark.parametrize("turn", range(0, 360, 30))
def test_a_marker_at_the_border_leaves_no_trace_in_a_disc(turn: int) -> None:
    clean = tilted(disc())
    place = (49.5 + 30 * math.cos(math.radians(turn)), 49.5 + 30 * math.sin(math.radians(turn)))
    painted, hidden = without_markers(clean, [place])
    # The chord instead of the arc loses two thirds of 16 px times 16^2 / (8 * 30) px, 11 of 2827 px, and
    # a pixel on the outline is 0.4 of a thousandth; measured 0.995 to 0.997.
    assert overlap(found(painted, hidden), found(clean)) > 0.993
    # Not told of the marker, the ring is open there, but its hull is the same; measured 0.95 to 0.99.
    assert overlap(hull_of(found(painted)), hull_of(found(clean))) > 0.94


def test_gaps_that_markers_leave_in_the_border_of_a_flat_punch_do_not_empty_it() -> None:
    clean = tilted(punch(), ring=1.0)
    painted, hidden = without_markers(clean, [(17.5, 40), (17.5, 58), (50, 25.5), (81.5, 47), (40, 73.5)])
    # Without knowing of the markers the middle is lost, or the outline bulges.
    assert overlap(found(painted, hidden), found(clean)) > 0.96
    middle = found(painted, hidden)[30:70, 25:75]
    assert middle.all()


def test_a_straight_border_stays_straight_below_a_marker() -> None:
    clean = tilted(punch(), ring=1.0)
    painted, hidden = without_markers(clean, [(50, 25.5 - 3)])
    top = found(painted, hidden).argmax(axis=0)[25:75]
    # All of this side's rows: a marker beside the rim moves it by one pixel at most.
    assert np.ptp(top) <= 1


def test_what_is_seen_of_a_contact_is_not_changed_by_a_marker_elsewhere() -> None:
    change = tilted(disc(20))
    hidden = (distance_from(90, 90) <= DOT).astype(np.uint8)
    assert np.array_equal(found(change, hidden), found(change))


def test_a_marker_alone_is_no_contact() -> None:
    change = tilted(disc(20))
    spot = (distance_from(90, 90) <= DOT).astype(np.uint8)
    # A dot that was removed in this frame only: the paint differs from the gel.
    change[spot > 0] = 0.2
    assert not found(change, spot)[spot > 0].any()


def test_a_change_that_lies_below_a_marker_alone_is_no_contact() -> None:
    change = (disc(6) < 0)[..., None] * np.array([1, -1, 0], np.float32)
    hidden = (distance_from(49.5, 49.5) <= DOT).astype(np.uint8)
    assert not found(change, hidden).any()


def test_brightened_contacts_end_below_markers_as_well() -> None:
    level = np.clip(0.5 - disc() / 4, 0, 1).astype(np.float32) * np.float32(0.5)
    clean = np.repeat(level[..., None], 3, axis=2)
    painted, hidden = without_markers(clean, [(79.5, 49.5), (49.5, 19.5)])
    assert overlap(found(painted, hidden), found(clean)) > 0.985


@pytest.mark.parametrize("dim", [0.5, 0.3, 0.2])
def test_the_side_that_lights_do_not_reach_belongs_to_the_contact(dim: float) -> None:
    change = tilted(disc())
    rows = np.linspace(1, dim, SIZE, dtype=np.float32)[:, None, None]
    mask = found(np.asarray(change * rows, np.float32))
    y = np.nonzero(mask)[0]
    # One pixel at half resolution, for a rim that is five times fainter at one end; measured 0.4 to 0.9 px.
    assert abs(float(y.mean()) - 49.5) < 1


def test_holes_and_pockets_at_the_border_are_filled_and_bays_are_not() -> None:
    mask = np.zeros((60, 80), np.uint8)
    cv2.circle(mask, (40, 30), 12, 1, 2)
    assert enclosed(mask).filled[30, 40]
    # Two flanks of a cable that crosses the frame: what lies between them belongs to it.
    flanks = np.zeros((60, 80), np.uint8)
    flanks[20:23] = flanks[36:39] = 1
    flanks[22:37, 40] = 1
    filled = enclosed(flanks).filled
    assert filled[20:39].all()
    assert not filled[:20].any()
    assert not filled[39:].any()
    # A hook is open to the outside.
    hook = np.zeros((60, 80), np.uint8)
    hook[10:50, 10:13] = hook[10:13, 10:60] = hook[47:50, 10:60] = 1
    assert np.array_equal(enclosed(hook).filled, hook)


@pytest.mark.parametrize("density", [0.3, 0.5, 0.6])
def test_holes_are_filled_as_by_filling_the_outlines_of_all_parts(density: float) -> None:
    # Rings within rings in noise, which has parts that touch the border.
    noise = np.random.default_rng(int(10 * density)).random((60, 80)) < density
    mask = noise.astype(np.uint8)
    for radius in (25, 18, 10):
        cv2.circle(mask, (40, 30), radius, 0, 4)
        cv2.circle(mask, (40, 30), radius, 1, 1)
    before = mask.copy()
    outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    expected = cv2.fillPoly(np.zeros_like(mask), outlines, (1.0,))
    assert (expected != mask).any()
    assert np.array_equal(outlined(mask, None), expected)
    assert np.array_equal(mask, before)


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (8, 2), (31, 40), (40, 33)])
def test_the_largest_change_nearby_is_found_up_to_the_border(size: tuple[int, int]) -> None:
    change = np.zeros(size, np.float32)
    change[: -(-size[0] // 2)] = 1
    near = largest_nearby(change)
    assert near.shape == size
    # Nowhere less than a part of the largest; all of it where the change fills what is around.
    assert near.min() >= FAINT * near.max()
    assert near[0].max() == pytest.approx(near.max())
    assert np.isfinite(near).all()


def test_pockets_that_are_filled_leave_no_holes() -> None:
    random = np.random.default_rng(0)
    filled_more = 0
    for _ in range(40):
        # Blobs that touch the border in several places, and each other.
        blurred = cv2.GaussianBlur(random.random((60, 80)), (0, 0), 4)
        mask = (blurred > np.quantile(blurred, 0.6)).astype(np.uint8)
        region = enclosed(mask)
        filled_more += int(region.filled.sum() > outlined(mask, None).sum())
        assert np.array_equal(outlined(region.filled, None), region.filled)
        parts = cv2.findContours(region.filled, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)[0]
        assert [part.tolist() for part in region.outlines] == [part.tolist() for part in parts]
    assert filled_more > 5


def test_masks_are_left_as_they_are() -> None:
    painted, hidden = without_markers(tilted(disc()), [(79.5, 49.5)])
    inside = (np.linalg.norm(painted, axis=2) > 0.02).astype(np.uint8)
    before = hidden.copy()
    contact_level(change_of(painted, inside), 4.0, hidden)
    assert np.array_equal(hidden, before)


@pytest.mark.parametrize("hidden", [np.zeros((50, 60), bool), np.zeros((60, 50), np.uint8)])
def test_the_detector_asks_for_a_mask_of_the_images_size(hidden: Any) -> None:
    detector = ContactDetector()
    image = np.full((50, 60, 3), 120, np.uint8)
    detector.add_reference(image)
    with pytest.raises(ValueError, match=r"required a uint8 mask of shape \(50, 60\)"):
        detector.detect(image, hidden)


def test_a_darkened_contact_with_a_bright_halo_ends_where_it_turns_bright() -> None:
    away = disc(24)
    darker = np.clip(-away / 6, 0, 1) - 0.4 * np.exp(-((away - 8) ** 2) / 50) * (away > 0)
    mask = found(-np.repeat(darker[..., None], 3, axis=2).astype(np.float32))
    # It darkens over 6 px, and is 0.15 dark 0.9 px inside; with the halo's size it would reach 9 px further.
    assert math.sqrt(mask.sum() / math.pi) == pytest.approx(24 - 0.9, abs=0.5)


def test_relief_of_an_object_that_is_steeper_than_its_border_does_not_draw_the_outline_in() -> None:
    relief = 3 * tilted(np.abs(disc(12)) - 1.5, ring=1.0, skirt=0.0)
    mask = found(tilted(disc()) + relief)
    assert math.sqrt(mask.sum() / math.pi) == pytest.approx(30, abs=1.0)


def test_what_holds_little_of_the_change_beside_a_contact_is_no_part_of_it() -> None:
    clean = np.repeat((disc(20) < 0)[..., None], 3, axis=2).astype(np.float32)
    speck = clean.copy()
    speck[4:9, 4:9] = 1
    assert np.array_equal(found(speck), found(clean))
    speck[4:20, 4:20] = 1
    assert found(speck)[12, 12]


def test_a_faint_band_of_light_through_a_contact_does_not_move_its_outline() -> None:
    ball = tilted(disc(16))
    band = np.zeros_like(ball)
    band[:, 56:72] = 0.2 * np.linalg.norm(ball, axis=2).max() / 3**0.5
    assert overlap(found(ball + band), found(ball)) > 0.95


def test_a_wrinkle_beside_a_dented_contact_is_not_joined_to_it() -> None:
    rows, columns = np.mgrid[:SIZE, :SIZE]
    dent = (np.abs(columns - 49.5) < 5) & (rows > 62)
    ball = tilted(disc(22), ring=12.0)
    dented = ball * np.where(dent, np.float32(0.1), np.float32(1))[..., None]
    wrinkled = dented.copy()
    wrinkled[80:82, 38:62] += np.float32(0.25) * ball.max()
    assert overlap(found(wrinkled), found(dented)) > 0.98


def test_a_large_contact_has_the_same_outline_however_it_is_turned() -> None:
    strip = cv2.resize(tilted(punch(40, 12), ring=20), None, fx=2, fy=2)
    noise = np.random.default_rng(0).normal(0, 0.04, strip.shape)
    change = np.asarray(strip + noise * (np.linalg.norm(strip, axis=2) > 0.05)[..., None], np.float32)
    turned = np.ascontiguousarray(np.rot90(change))
    # Measured: 0.999; 0.93 with the profile of one row in five.
    assert overlap(np.rot90(found(change)), found(turned)) > 0.99


def test_a_brightened_contact_reaches_as_far_where_it_is_dim() -> None:
    away, across = disc(32), (np.arange(SIZE) - 49.5) / 32
    uneven = (0.5 - 0.5 * np.tanh(away / 4)) * np.clip(0.65 + 0.35 * across, 0.3, 1.0)
    mask = found(np.repeat(uneven[..., None], 3, axis=2).astype(np.float32))
    assert 49.5 - np.flatnonzero(mask[50])[0] > 28


def test_one_pixel_that_outshines_all_others_is_a_contact_of_its_own() -> None:
    brightness = np.zeros((200, 200), np.float32)
    brightness[199, 199], brightness[198, 199] = 1, -1e-6
    level = contact_level(WindowChange(np.abs(brightness) * np.float32(3**0.5), brightness))
    assert np.argwhere(level > 0).tolist() == [[199, 199]]


@pytest.mark.parametrize("turn", [0, 30, 90, 135])
def test_both_flanks_of_a_ball_lit_from_one_side_are_one_contact(turn: int) -> None:
    rows, columns = np.mgrid[:SIZE, :SIZE].astype(np.float32) - np.float32(49.5)
    toward = columns * math.cos(math.radians(turn)) + rows * math.sin(math.radians(turn))
    slope = np.where(disc(24) < 0, toward / 24, np.float32(0)).astype(np.float32)
    mask = found(np.repeat(cv2.GaussianBlur(slope, (0, 0), 0.8)[..., None], 3, axis=2))
    # One of the flanks alone has its centroid 14 px off.
    assert math.hypot(*(float(places[mask].mean()) for places in (rows, columns))) < 0.5
    # The slope vanishes where the light comes along the border, so that the outline is drawn in there.
    assert overlap(hull_of(mask), disc(24) < 0) > 0.7
