"""Marker masks: cover every dot with its border, nothing else, without shift."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.sim import open_scene
from tactflow.vision.markers.mask import Dot, find_dot, marker_mask

Image = NDArray[np.uint8]


def _dots(
    shape: tuple[int, int] = (200, 160), radius: float = 5.0, pitch: int = 30, dark: bool = True
) -> Image:
    """Anti-aliased dots on a shaded gel."""
    fine = np.zeros((shape[0] * 4, shape[1] * 4), np.uint8)
    for y in range(pitch // 2, shape[0], pitch):
        for x in range(pitch // 2, shape[1], pitch):
            cv2.circle(fine, (4 * x + 2, 4 * y + 2), int(4 * radius), 255, -1)
    cover = cv2.resize(fine, shape[::-1], interpolation=cv2.INTER_AREA).astype(float)[..., None] / 255
    gel = np.linspace(100, 150, shape[1])[None, :, None] * np.array([1.0, 0.9, 1.1])
    dot = 25.0 if dark else 230.0
    return np.rint(gel * (1 - cover) + dot * cover).astype(np.uint8)


def test_dots_of_several_sizes_in_one_picture_are_covered_whole() -> None:
    image = np.full((240, 320, 3), 130, np.uint8)
    painted = np.zeros((240, 320), np.uint8)
    for number in range(48):
        place = (20 + 40 * (number % 8), 20 + 40 * (number // 8))
        cv2.circle(painted, place, 12 if number % 7 == 3 else 4, 255, -1)
    image[painted > 0] = 30
    dot = find_dot(image)
    assert dot is not None
    mask = marker_mask(image, dot)
    # Measured: 0.9 % of them are bare, single pixels that stick out; a mask of one size leaves 28 %.
    assert (mask[painted > 0] == 255).mean() > 0.98
    assert (mask > 0).mean() < 2 * (painted > 0).mean()


def _centers(mask: Image) -> NDArray[np.float64]:
    count, _, _, centers = cv2.connectedComponentsWithStats(mask)
    return centers[1:count]


@pytest.mark.parametrize("dark", [True, False])
@pytest.mark.parametrize("radius", [2.0, 3.5, 5.0, 7.0])
def test_dots_of_any_size_and_polarity_are_found_and_covered(radius: float, dark: bool) -> None:
    image = _dots(radius=radius, pitch=32, dark=dark)
    dot = find_dot(image)
    assert dot is not None
    assert dot.polarity == ("dark" if dark else "bright")
    mask = marker_mask(image, dot)
    clean = _dots(radius=0.001, pitch=1000, dark=dark)
    changed = np.abs(image.astype(int) - clean.astype(int)).max(axis=2) > 8
    # Derived: pixels changed by more than 8 of some 100 levels are those at least a twelfth covered.
    assert mask[changed].all()
    assert len(_centers(mask)) == 5 * 6
    # Measured 2.0 to 2.6 px; the border is 3 px at most (1.5 px at half resolution).
    area = mask.astype(bool).sum() / 30
    assert np.sqrt(area / np.pi) < radius + 3.5


def test_mask_has_no_half_pixel_shift() -> None:
    image = _dots((186, 154), radius=5.0, pitch=31)
    dot = find_dot(image)
    assert dot is not None
    centers = _centers(marker_mask(image, dot))
    # Dots are drawn at 15.125, 46.125, ...: an eighth from the pixel's centre.
    error = centers - np.round((centers - 15) / 31) * 31 - 15.125
    # The mask is made of 2 x 2 blocks: a centre is off by up to half a block, to either side as often where
    # the pitch is odd. Measured: 0.49 at most, mean -0.18 and -0.10; half a pixel of shift would be 0.5.
    assert np.abs(error).max() <= 1.0
    assert np.abs(error.mean(axis=0)).max() < 0.3
    mirrored = np.ascontiguousarray(image[:, ::-1])
    back = marker_mask(mirrored, dot)[:, ::-1]
    assert np.array_equal(back, marker_mask(image, dot))


def test_the_edge_of_a_contact_is_not_a_marker() -> None:
    image = _dots(radius=4.0)
    dot = find_dot(image)
    assert dot is not None
    plain = np.full((200, 160, 3), 130, np.uint8)
    plain[:, 80:] = 60
    cv2.line(plain, (10, 20), (70, 180), (50, 50, 50), 5)
    inner = marker_mask(plain, dot)[15:-15, 15:-15]
    # The ends of the line are spots of a kind; a length of twice its width may be taken.
    assert (inner > 0).sum() < 4 * 5 * 10


def test_a_gel_without_markers_has_no_dot() -> None:
    rng = np.random.default_rng(4)
    image = np.clip(rng.normal(120, 2, (120, 100, 3)), 0, 255).astype(np.uint8)
    assert find_dot(image) is None


@pytest.mark.parametrize("turn", [0, 1, 2, 3])
def test_mask_turns_with_the_frame(turn: int) -> None:
    image = _dots(radius=4.0)
    mask = marker_mask(image, Dot(4.0))
    turned = marker_mask(np.ascontiguousarray(np.rot90(image, turn)), Dot(4.0))
    # Even sizes: blocks of 2 x 2 map onto blocks; the circle of twelve points is its own mirror image.
    assert np.mean(np.rot90(mask, turn) != turned) < 0.005


def test_mask_does_not_depend_on_the_order_of_channels_or_on_brightness() -> None:
    image = _dots(radius=4.0)
    mask = marker_mask(image, Dot(4.0))
    assert np.array_equal(marker_mask(np.ascontiguousarray(image[..., [2, 0, 1]]), Dot(4.0)), mask)
    assert np.array_equal(marker_mask(image + np.uint8(20), Dot(4.0)), mask)


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (2, 2), (5, 3), (33, 57)])
@pytest.mark.parametrize("value", [0, 128, 255])
def test_constant_frames_of_any_size_have_no_markers(shape: tuple[int, int], value: int) -> None:
    image = np.full((*shape, 3), value, np.uint8)
    mask = marker_mask(image, Dot(4.0))
    assert mask.shape == shape
    assert not mask.any()
    assert find_dot(image) is None


def test_read_only_and_strided_images_are_read_and_left_alone() -> None:
    wide = np.dstack([_dots(), _dots()])
    view = wide[:, :, ::2]
    image = np.ascontiguousarray(view)
    image.setflags(write=False)
    assert np.array_equal(marker_mask(view, Dot(5.0)), marker_mask(image, Dot(5.0)))


@pytest.mark.parametrize("scene", ["press", "bright_dots", "square_dots", "doubled_dots", "dense"])
def test_simulated_markers_are_covered_in_contact_and_out_of_it(scene: str) -> None:
    recording = open_scene(f"{scene}?frames=60&noise=2&vanish=0")
    dot = find_dot(recording.frame(0))
    assert dot is not None
    for index in (0, 25):
        truth = recording.truth(index)
        mask = marker_mask(recording.frame(index), dot)
        at = np.rint(truth.position[truth.visible]).astype(int)
        radius = 14
        height, width = mask.shape
        inside = np.all((at > radius) & (at < [width - radius, height - radius]), axis=1)
        near = np.array([mask[y - 4 : y + 5, x - 4 : x + 5].any() for x, y in at[inside]])
        # Measured 1.0 in all of these; a marker at the steepest edge of a contact may be missed.
        assert near.mean() > 0.97
        change = np.abs(recording.frame(index).astype(int) - recording.clean(index)).min(axis=2)
        # Noise of 2 levels exceeds 20 in all three channels nowhere: what changes that much is a marker.
        assert (mask[change > 20] > 0).mean() > 0.97


def _defined(image: Image, radius: float, contrast: float, dark: bool) -> Image:
    """The definition, for pictures of even sides, point by point."""
    half = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA).astype(int)
    height, width = half.shape[:2]
    outer = (radius + max(radius, 4.0) + 1) / 2
    reach, worst = int(np.ceil(outer)), 10_000 if dark else -10_000
    wide = np.pad(half, ((reach, reach), (reach, reach), (0, 0)), constant_values=worst)
    angles = np.arange(12) * (2 * np.pi / 12)
    rows, columns = np.rint(outer * np.stack([np.sin(angles), np.cos(angles)])).astype(int) + reach
    around = np.stack([wide[y : y + height, x : x + width] for y, x in zip(rows, columns, strict=True)])
    least = around.min(axis=0) - half if dark else half - around.max(axis=0)
    spots = np.median(np.clip(least, 0, 255), axis=2) > np.floor(contrast)
    side = (2 * reach + 1) // 4
    for part in (spots[:side], spots[max(height - side, 0) :]):
        part[:, :side] = part[:, max(width - side, 0) :] = False
    covered = cv2.dilate(spots.astype(np.uint8) * 255, np.ones((3, 3), np.uint8))
    return np.asarray(covered, np.uint8).repeat(2, axis=0).repeat(2, axis=1)


@pytest.mark.parametrize("dark", [True, False])
@pytest.mark.parametrize("size", [(40, 130), (100, 76)])
@pytest.mark.parametrize("radius", [0.4, 2.0, 5.3, 11.0])
def test_a_spot_differs_from_every_point_of_a_circle_in_two_channels(
    radius: float, size: tuple[int, int], dark: bool
) -> None:
    noise = np.random.default_rng(1).integers(0, 256, (*size, 3)).astype(np.uint8)
    smooth = np.asarray(cv2.GaussianBlur(noise, (0, 0), 2.5), float)
    blobs = (smooth - smooth.min()) * (255 / np.ptp(smooth))
    for image in (noise, blobs.astype(np.uint8)):
        for contrast in (0.5, 25.9, 80.0, 300.0):
            mask = marker_mask(image, Dot(radius, "dark" if dark else "bright", contrast))
            np.testing.assert_array_equal(mask, _defined(image, radius, contrast, dark))


def test_wrong_dots_and_images_are_refused() -> None:
    with pytest.raises(ValueError, match="radius: required > 0"):
        Dot(0)
    with pytest.raises(ValueError, match="contrast: required > 0"):
        Dot(3, "dark", 0)
    with pytest.raises(ValueError, match="required a non-empty"):
        marker_mask(np.zeros((4, 4), np.uint8), Dot(3))
