"""Outputs follow when the picture is moved, turned, mirrored, enlarged, brightened, or its channels swapped.

Nothing here needs truth: the answer for the changed picture is compared with the changed answer. "Measured"
bounds were found on the small gel of `builders` and are twice the largest deviation seen there.
"""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.vision.change import ChangeProbe
from tactflow.vision.flow import flow_in_mask
from tactflow.vision.geometry.hull import contact_geometry
from tactflow.vision.markers.inpaint import remove_markers
from tactflow.vision.types import Markers
from tests.stress.builders import (
    DIFFERENCES,
    DOUBLED,
    MIRRORED,
    PICTURE_METHODS,
    SIZE,
    TURNED,
    Image,
    Points,
    Transformation,
    apart,
    axis_difference,
    contact_mask,
    dog_mask,
    gel,
    tracked,
)

WIDTH, HEIGHT = SIZE


def parameters(*changes: Transformation) -> list[object]:
    return [pytest.param(change, id=change.name) for change in changes]


# One turn and one mirror swap and reverse both axes.
MOVED = parameters(TURNED, MIRRORED)
RESIZED = [*MOVED, *parameters(DOUBLED)]


def paired(before: Markers, after: Markers, origin: Points) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """For each marker of `before`, whose origin is now expected at `origin`: its index in `after`, and how
    far that one's origin is off, px."""
    away = np.hypot(*(origin[:, None] - after.origin[None]).transpose(2, 0, 1))
    assert len(before.origin) == len(origin)
    return away.argmin(axis=1), away.min(axis=1)


@pytest.mark.parametrize("motion", RESIZED)
def test_masks_follow(motion: Transformation) -> None:
    pictures = gel()
    both = pictures.reference, pictures.touched
    mask = dog_mask(*both)
    assert mask.any()
    # Works on blocks of 2 x 2, which turns and mirrors keep (sides are even): exact. Doubled, its rim keeps
    # its width and its blocks their size: derived, 2 px each, on the diagonal 4 * sqrt(2) of doubled pixels.
    there = dog_mask(*map(motion.picture, both))
    assert apart(motion.picture(mask), there) <= (5.66 if motion is DOUBLED else 0.0)
    # noise: cells of 4 x 4 keep under turns (sides divide by 4); float32 sums in another order, 1 px.
    # colour: symmetric kernels on whole numbers, exact. Doubled: measured 1, 2.
    bound = {"noise": (1.0, 2.0), "colour": (0.0, 4.0)}
    both = gel(dots=False).reference, gel(dots=False).touched
    for method in DIFFERENCES:
        contact = contact_mask(method, *both)
        assert contact.any()
        there = contact_mask(method, *map(motion.picture, both))
        assert apart(motion.picture(contact), there) <= bound[method][motion is DOUBLED]


@pytest.mark.parametrize("motion", MOVED)
def test_inpainting_follows(motion: Transformation) -> None:
    pictures = gel()
    mask = dog_mask(pictures.reference, pictures.touched)
    here = remove_markers(pictures.touched, mask)
    there = remove_markers(motion.picture(pictures.touched), motion.picture(mask))
    # Cells of 4 x 4 and symmetric kernels: only sums of float32 in another order before rounding.
    assert int(cv2.absdiff(motion.picture(here), there).max()) <= 1


@pytest.mark.parametrize("motion", RESIZED)
def test_geometry_follows(motion: Transformation) -> None:
    here, there = contact_geometry(gel().mask), contact_geometry(motion.picture(gel().mask))
    assert here is not None
    assert there is not None
    assert here.angle is not None
    assert there.angle is not None
    assert here.ellipse is not None
    assert there.ellipse is not None
    center = motion.points(np.array([here.center]), WIDTH, HEIGHT)[0]
    # Moments are sums of whole numbers: what is left is the rounding of one division and one arc tangent.
    np.testing.assert_allclose(there.center, center, rtol=0, atol=1e-12 * WIDTH)
    assert axis_difference(there.angle, motion.angle(here.angle)) <= 1e-12 * 180
    assert there.region_area == here.region_area * motion.scale**2
    if motion is not DOUBLED:
        assert there.area == here.area
        np.testing.assert_allclose(there.ellipse.axes, here.ellipse.axes, rtol=1e-12)
        corners = motion.points(here.hull, WIDTH, HEIGHT)
        assert {tuple(corner) for corner in corners} == {tuple(corner) for corner in there.hull}
    else:
        # Pixels have an extent: each variance gains 1/12 px^2 per pixel, which doubling does not double:
        # derived, 4 (v + 1/12) - 1/12 = 4 v + 1/4 for the variance of centres, and axes are 4 sqrt(v).
        expected = [4 * np.sqrt(4 * (axis / 4) ** 2 + 1 / 4) for axis in here.ellipse.axes]
        np.testing.assert_allclose(there.ellipse.axes, expected, rtol=1e-9)


@pytest.mark.parametrize("motion", RESIZED)
def test_the_tracker_follows(motion: Transformation) -> None:
    pictures = gel()
    here = tracked(pictures.reference, pictures.touched)
    there = tracked(motion.picture(pictures.reference), motion.picture(pictures.touched))
    # Moved: whole-pixel reads and the same sub-pixel phases up to sign; derived 1e-3, since the search for a
    # centre ends within that of its goal. Doubled: noise of another scale, measured 0.011 and 0.062.
    of_origin, of_position = (0.022, 0.13) if motion is DOUBLED else (1e-3, 1e-3)
    index, away = paired(here, there, motion.points(here.origin, WIDTH, HEIGHT))
    assert sorted(index.tolist()) == list(range(24))
    assert away.max() <= of_origin
    expected = motion.points(here.position, WIDTH, HEIGHT)
    assert np.hypot(*(there.position[index] - expected).T).max() <= of_position
    assert (there.status[index] == here.status).all()


@pytest.mark.parametrize("motion", RESIZED)
def test_the_flow_follows(motion: Transformation) -> None:
    pictures = gel()
    status, stderr = np.zeros(24, np.uint8), np.full(24, 0.1)
    here = flow_in_mask(Markers(pictures.origin, pictures.position, status, stderr), pictures.mask, dilate=3)
    turned = [motion.points(points, WIDTH, HEIGHT) for points in (pictures.origin, pictures.position)]
    markers = Markers(turned[0], turned[1], status, stderr)
    there = flow_in_mask(markers, motion.picture(pictures.mask), dilate=3 * motion.scale)
    assert there.count == here.count > 0
    ends = motion.points(np.array([(0.0, 0.0), here.mean or (0.0, 0.0)]), WIDTH, HEIGHT)
    assert there.mean == pytest.approx(ends[1] - ends[0], abs=1e-10)
    sign = -1 if motion.name.startswith("mirrored") else 1
    assert there.rotation == pytest.approx(sign * (here.rotation or 0), abs=1e-10)
    assert there.divergence == pytest.approx(here.divergence, abs=1e-12)


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


def lit(gain: float, offset: int, *order: int) -> Transformation:
    """The picture times gain plus offset, unsaturated on this gel, its channels in another order."""

    def picture(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        brightened = np.clip(np.rint(image * np.float64(gain) + offset), 0, 255).astype(np.uint8)
        return np.ascontiguousarray(brightened[..., order or (0, 1, 2)])

    name = f"times {gain:g} plus {offset}, {order}"
    return Transformation(name, picture, lambda p, _w, _h: p, lambda a: a, gain)


LIGHT = parameters(lit(0.8, 0), lit(1.25, 0), lit(1, 20), lit(1, -15), lit(1, 0, 2, 0, 1), lit(1, 0, 2, 1, 0))


@pytest.mark.parametrize("change", LIGHT)
def test_gain_offset_and_the_order_of_channels_change_nothing(change: Transformation) -> None:
    # Offsets and swapped channels change no difference of pixels: exact, but for the float32 sums of `noise`.
    # With a gain, rounding to whole grey levels may move a border by one block of 2 x 2, derived 2.83, or a
    # pixel; the fixed threshold of `colour` moves it along the slope of its rim: measured 1.
    gain = change.scale != 1
    bounds = {"marker_mask": 2.83 * gain, "difference-noise": 1.0, "difference-colour": 2.0 * gain}
    for method, bound in bounds.items():
        pictures = gel(dots=method == "marker_mask")
        here = PICTURE_METHODS[method](pictures.reference, pictures.touched)
        there = PICTURE_METHODS[method](change.picture(pictures.reference), change.picture(pictures.touched))
        assert here.any()
        assert apart(here, there) <= bound
    pictures = gel()
    before = tracked(pictures.reference, pictures.touched)
    after = tracked(change.picture(pictures.reference), change.picture(pictures.touched))
    index, away = paired(before, after, before.origin)
    # Luma is another mean of the channels, and rounding is other noise; measured 0.014, 0.019.
    assert away.max() <= 0.03
    assert np.hypot(*(after.position[index] - before.position).T).max() <= 0.04


def test_the_probe_follows_turns_and_mirrors() -> None:
    """What it looks at is chosen anew, but still frames stay still and a touch is seen."""
    for change in (TURNED, MIRRORED):
        picture, random = change.picture(gel().reference), np.random.default_rng(1)
        frames = [
            np.clip(np.rint(picture + random.normal(0, 1, picture.shape)), 0, 255).astype(np.uint8)
            for _ in range(31)
        ]
        probe = ChangeProbe(frames[0], false_alarms=1e-6)
        for frame in frames[1:21]:
            probe.look(frame)
        probe.anchor_here()
        assert not any(map(probe.look, frames[21:])), change.name
        assert probe.look(change.picture(gel().touched)), change.name
