"""Outputs follow when the picture is moved, turned, mirrored, enlarged, brightened, or its channels swapped.

Nothing here needs truth: the answer for the changed picture is compared with the changed answer. "Measured"
bounds were found on the small gel of `builders` and are twice the largest deviation seen there.
"""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np
import pytest
from _pytest.mark import ParameterSet
from numpy.typing import NDArray

from tactflow.vision.change import ChangeProbe
from tactflow.vision.geometry import Method, Preprocessor
from tactflow.vision.geometry.hull import contact_geometry
from tactflow.vision.markers.inpaint import remove_markers
from tactflow.vision.types import Markers
from tests.stress.builders import (
    DIFFERENCES,
    DOUBLED,
    FLOWS,
    HULLS,
    INPAINTING,
    MARKER_MASKS,
    MOTIONS,
    PICTURE_METHODS,
    SIZE,
    TRACKERS,
    Image,
    Points,
    Transformation,
    apart,
    axis_difference,
    contact_mask,
    gel,
    tracked,
)

WIDTH, HEIGHT = SIZE
SHIFTS = ((1, 0), (0, 1), (3, 2), (7, 5), (8, 4))
MOVED = [pytest.param(motion, id=motion.name) for motion in MOTIONS]
RESIZED = [*MOVED, pytest.param(DOUBLED, id=DOUBLED.name)]


def paired(before: Markers, after: Markers, origin: Points) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """For each marker of `before`, whose origin is now expected at `origin`: its index in `after`, and how
    far that one's origin is off, px."""
    away = np.hypot(*(origin[:, None] - after.origin[None]).transpose(2, 0, 1))
    assert len(before.origin) == len(origin)
    return away.argmin(axis=1), away.min(axis=1)


# -- turned, mirrored, doubled ----------------------------------------------------------------------------

# How far masks may be apart, px: (moved, doubled).
# dog: works on blocks of 2 x 2, which turns and mirrors keep (sides are even): exact. Doubled, its rim keeps
#   its width and its blocks their size: derived, 2 px each, on the diagonal 4 * sqrt(2) of doubled pixels.
# classic: samples every second pixel and enlarges with a shift of half a pixel; a turn swaps which ones:
#   measured 2.83. Its kernels have a fixed size in pixels, so it cannot follow a doubling.
MASK_BOUND = {"dog": (0.0, 5.66), "classic": (5.66, float("inf"))}
FOLLOWS_DOUBLING = {"dog": True, "appearance": True, "classic": False}


def motions_of(methods: Iterable[str]) -> list[ParameterSet]:
    """Every method with every motion that it can follow."""
    return [
        pytest.param(method, motion, id=f"{method}-{motion.name}")
        for method in methods
        for motion in (*MOTIONS, DOUBLED)
        if motion is not DOUBLED or FOLLOWS_DOUBLING[method]
    ]


@pytest.mark.parametrize(("method", "motion"), motions_of(MARKER_MASKS))
def test_the_marker_mask_follows(method: str, motion: Transformation) -> None:
    bound = MASK_BOUND[method][motion is DOUBLED]
    find, pictures = MARKER_MASKS[method], gel()
    mask = find(pictures.reference, pictures.touched)
    assert mask.any()
    follows = find(motion.picture(pictures.reference), motion.picture(pictures.touched))
    assert apart(motion.picture(mask), follows) <= bound


# Difference of filled pixels, grey levels: (largest, mean).
# normalized: cells of 4 x 4 and symmetric kernels: only sums of float32 in another order before rounding, 1.
# telea, ns: march from pixel to pixel in an order that a turn changes; measured 12 and 20, 0.76 and 0.54.
FILL_BOUND = {"normalized": (1, 0.1), "telea": (24, 1.5), "ns": (40, 1.1), "none": (0, 0.0)}


@pytest.mark.parametrize("method", INPAINTING)
@pytest.mark.parametrize("motion", MOVED)
def test_inpainting_follows(method: str, motion: Transformation) -> None:
    pictures = gel()
    mask = MARKER_MASKS["dog"](pictures.reference, pictures.touched)
    here = remove_markers(pictures.touched, mask, method=method)  # type: ignore[arg-type]
    there = remove_markers(motion.picture(pictures.touched), motion.picture(mask), method=method)  # type: ignore[arg-type]
    error = cv2.absdiff(motion.picture(here), there)
    largest, mean = FILL_BOUND[method]
    assert int(error.max()) <= largest
    assert float(error[motion.picture(mask) > 0].mean()) <= mean


@pytest.mark.parametrize("method", INPAINTING)
def test_inpainting_follows_when_doubled_with_twice_the_radius(method: str) -> None:
    pictures = gel()
    mask = MARKER_MASKS["dog"](pictures.reference, pictures.touched)
    here = remove_markers(pictures.touched, mask, method=method, radius=5)  # type: ignore[arg-type]
    there = remove_markers(
        DOUBLED.picture(pictures.touched), DOUBLED.picture(mask), method=method, radius=10  # type: ignore[arg-type]
    )  # fmt: skip
    # What is filled is a guess between rims that differ by the noise: mean over the filled pixels, measured
    # 0.62, 0.78, 0.48 grey levels; `none` leaves them as they were.
    holes = DOUBLED.picture(mask) > 0
    error = cv2.absdiff(DOUBLED.picture(here), there)[holes].mean()
    assert error <= {"normalized": 1.3, "telea": 1.6, "ns": 1.0, "none": 0.0}[method]


# How far contact masks may be apart, px: (moved, doubled).
# noise: cells of 4 x 4 keep under turns (sides divide by 4); float32 sums in another order, 1 px.
# colour, classic: symmetric kernels on whole numbers, exact. Doubled, their kernels keep their size:
#   measured 1, 2 and 4 px.
CONTACT_BOUND = {"noise": (1.0, 2.0), "colour": (0.0, 4.0), "classic": (0.0, 8.0)}


@pytest.mark.parametrize("method", DIFFERENCES)
@pytest.mark.parametrize("motion", RESIZED)
def test_the_contact_mask_follows(method: str, motion: Transformation) -> None:
    pictures = gel(dots=False)
    here = contact_mask(method, pictures.reference, pictures.touched)
    assert here.any()
    there = contact_mask(method, motion.picture(pictures.reference), motion.picture(pictures.touched))
    assert apart(motion.picture(here), there) <= CONTACT_BOUND[method][motion is DOUBLED]


@pytest.mark.parametrize("motion", RESIZED)
def test_geometry_follows(motion: Transformation) -> None:
    mask = gel().mask
    height, width = mask.shape
    here, there = contact_geometry(mask), contact_geometry(motion.picture(mask))
    assert here is not None
    assert there is not None
    assert here.angle is not None
    assert there.angle is not None
    assert here.ellipse is not None
    assert there.ellipse is not None
    center = motion.points(np.array([here.center]), width, height)[0]
    # Moments are sums of whole numbers: what is left is the rounding of one division and one arc tangent.
    np.testing.assert_allclose(there.center, center, rtol=0, atol=1e-12 * width)
    assert axis_difference(there.angle, motion.angle(here.angle)) <= 1e-12 * 180
    assert there.region_area == here.region_area * motion.scale**2
    if motion is not DOUBLED:
        assert there.area == here.area
        np.testing.assert_allclose(there.ellipse.axes, here.ellipse.axes, rtol=1e-12)
        assert abs(there.confidence - here.confidence) <= 1e-12
        corners = motion.points(here.hull, width, height)
        assert {tuple(corner) for corner in corners} == {tuple(corner) for corner in there.hull}
    else:
        # Pixels have an extent: each variance gains 1/12 px^2 per pixel, which doubling does not double:
        # derived, 4 (v + 1/12) - 1/12 = 4 v + 1/4 for the variance of centres, and axes are 4 sqrt(v).
        expected = [4 * np.sqrt(4 * (axis / 4) ** 2 + 1 / 4) for axis in here.ellipse.axes]
        np.testing.assert_allclose(there.ellipse.axes, expected, rtol=1e-9)


@pytest.mark.parametrize("motion", RESIZED)
def test_geometry_of_the_script_follows(motion: Transformation) -> None:
    """Its centre is the middle of a line across the picture, which a turn does not keep: direction alone."""
    mask = gel().mask
    here, there = HULLS["classic"](mask), HULLS["classic"](motion.picture(mask))
    assert here is not None
    assert there is not None
    assert here.angle is not None
    assert there.angle is not None
    if motion is DOUBLED:
        # The hull's vertices are centres of corner pixels, and a doubled one has two: measured 0.095 degrees.
        assert axis_difference(there.angle, here.angle) <= 0.19
    else:
        # fitLine works in float32: 1e-7 of coordinates up to 176 px, over a contact 60 px long; derived.
        assert axis_difference(there.angle, motion.angle(here.angle)) <= 1e-3
        assert there.area == here.area


# (origins, positions, of the moved picture; of the doubled picture), px.
# appearance, moved: whole-pixel reads and the same sub-pixel phases up to sign; float32 sums reordered,
#   measured 7e-10 and 2e-7; derived 1e-3, since the search for a centre ends within that of its goal.
#   Doubled: both pictures have noise of their own scale, measured 0.011 and 0.062.
# classic, moved: half-pixel shift and swapped samples, as for its mask; measured 1.84 and 1.85.
TRACKER_BOUND = {"appearance": (1e-3, 1e-3), "classic": (3.7, 3.7)}
TRACKER_BOUND_DOUBLED = (0.022, 0.13)


@pytest.mark.parametrize(("method", "motion"), motions_of(TRACKERS))
def test_the_tracker_follows(method: str, motion: Transformation) -> None:
    pictures = gel()
    of_origin, of_position = TRACKER_BOUND_DOUBLED if motion is DOUBLED else TRACKER_BOUND[method]
    make = TRACKERS[method]
    here = tracked(make, pictures.reference, pictures.touched)
    there = tracked(make, motion.picture(pictures.reference), motion.picture(pictures.touched))
    assert len(here.origin) == len(there.origin) == 24
    index, away = paired(here, there, motion.points(here.origin, WIDTH, HEIGHT))
    assert sorted(index.tolist()) == list(range(24))
    assert away.max() <= of_origin
    expected = motion.points(here.position, WIDTH, HEIGHT)
    assert np.hypot(*(there.position[index] - expected).T).max() <= of_position
    assert (there.status[index] == here.status).all()


@pytest.mark.parametrize("method", FLOWS)
@pytest.mark.parametrize("motion", RESIZED)
def test_the_flow_follows(method: str, motion: Transformation) -> None:
    pictures = gel()
    # Whole pixels, so that what the script cuts off is the same everywhere but for the sign.
    position = np.rint(pictures.position) if method == "classic" else pictures.position
    origin = pictures.origin
    here_markers = Markers(origin, position, np.zeros(24, np.uint8), np.full(24, 0.1))
    turned = [motion.points(points, WIDTH, HEIGHT) for points in (origin, position)]
    there_markers = Markers(turned[0], turned[1], here_markers.status, here_markers.stderr)
    here = FLOWS[method](here_markers, pictures.mask, dilate=3)
    there = FLOWS[method](there_markers, motion.picture(pictures.mask), dilate=3 * motion.scale)
    assert here.mean is not None
    assert there.mean is not None
    assert there.count == here.count
    ends = motion.points(np.array([[0.0, 0.0], here.mean]), WIDTH, HEIGHT)
    np.testing.assert_allclose(there.mean, ends[1] - ends[0], rtol=0, atol=1e-10)
    if method == "mean":
        assert here.rotation is not None
        assert there.rotation is not None
        assert here.divergence is not None
        assert there.divergence is not None
        mirrored = motion.name.startswith("mirrored")
        assert abs(there.rotation - (-here.rotation if mirrored else here.rotation)) <= 1e-10
        assert abs(there.divergence - here.divergence) <= 1e-12


# -- translated by whole pixels ---------------------------------------------------------------------------

# How far masks may be apart within the part that both pictures show, px.
# dog: blocks of 2 x 2 fall elsewhere on the gel: measured 1.
# classic: samples every second pixel, measured 1.41.
# noise: cells of 4 x 4 fall elsewhere, measured 1. colour, classic difference: exact.
SHIFT_BOUND = {
    "marker_mask-dog": 2.0,
    "marker_mask-classic": 2.83,
    "difference-noise": 2.0,
    "difference-colour": 0.0,
    "difference-classic": 0.0,
}


@pytest.mark.parametrize("shift", SHIFTS, ids=str)
@pytest.mark.parametrize("method", SHIFT_BOUND)
def test_masks_follow_a_translation(method: str, shift: tuple[int, int]) -> None:
    dots = method.startswith("marker")
    here, there = gel(dots=dots), gel(shift, dots=dots)
    find = PICTURE_METHODS[method]
    margin = 24
    x, y = shift
    before = find(here.reference, here.touched)[y + margin : HEIGHT - margin, x + margin : WIDTH - margin]
    after = find(there.reference, there.touched)[margin : HEIGHT - margin - y, margin : WIDTH - margin - x]
    assert before.any()
    # A dot that the window cuts is judged by what is left of it: one pixel in, or one pixel out.
    assert apart(_whole(before, after), _whole(after, before)) <= SHIFT_BOUND[method]
    if x % 4 == 0 and y % 4 == 0 and method != "difference-noise":
        assert np.array_equal(before, after)


def _whole(mask: Image, other: Image) -> Image:
    """The mask without spots at the border, of it or of the other one, which the window has cut."""
    either = np.pad((mask > 0) | (other > 0), 1, constant_values=True).astype(np.uint8)
    count, labels = cv2.connectedComponents(either)
    assert count > 1
    kept = labels[1:-1, 1:-1] != labels[0, 0]
    return np.where(kept, mask, 0).astype(np.uint8)


@pytest.mark.parametrize("shift", SHIFTS, ids=str)
@pytest.mark.parametrize("method", TRACKERS)
def test_the_tracker_follows_a_translation(method: str, shift: tuple[int, int]) -> None:
    before, after = (
        tracked(TRACKERS[method], pictures.reference, pictures.touched) for pictures in (gel(), gel(shift))
    )
    origin, position = before.origin - shift, before.position - shift
    inner = ((origin > 24) & (origin < np.array(SIZE) - 25)).all(axis=1)
    assert inner.sum() >= 8
    index, away = paired(before, after, origin)
    # appearance: the search for centres ends when all moves are below 1e-3 px, and which marks are in view
    # decides when that is; measured 2e-8.
    # classic: every second pixel is sampled, and the mask's border moves by a pixel or two; measured 0.45 and
    # 0.69.
    of_origin, of_position = {"appearance": (1e-3, 1e-3), "classic": (0.9, 1.4)}[method]
    assert away[inner].max() <= of_origin
    assert np.hypot(*(after.position[index] - position).T)[inner].max() <= of_position


# -- gain, offset, channels -------------------------------------------------------------------------------


def brightened(gain: float, offset: float = 0.0) -> Transformation:
    """The picture times gain plus offset, without saturation on this gel; everything else stays."""
    return Transformation(
        f"times {gain:g} plus {offset:g}",
        lambda picture: np.clip(np.rint(picture * np.float64(gain) + offset), 0, 255).astype(np.uint8),
        lambda points, _width, _height: points,
        lambda angle: angle,
    )


def channels(*order: int) -> Transformation:
    """The channels in another order."""
    return Transformation(
        f"channels {order}",
        lambda picture: np.ascontiguousarray(picture[..., order]),
        lambda points, _width, _height: points,
        lambda angle: angle,
    )


LIGHT = (brightened(0.8), brightened(1.25), brightened(1, 20), brightened(1, -15))
SWAPPED = (channels(2, 0, 1), channels(2, 1, 0), channels(0, 2, 1))
LIT = [pytest.param(change, id=change.name) for change in (*LIGHT, *SWAPPED)]

# How far masks may be apart, px: (gain, offset).
# Offsets and swapped channels change no difference of pixels: exact, but for the float32 sums of `noise`.
# dog, noise: thresholds scale with the marks' contrast or the noise; rounding to whole grey levels may move a
#   border by one block of 2 x 2, derived 2.83, and by one pixel; measured 0 and 1.
# colour, classic, and the classic marker mask: fixed thresholds, so a gain moves the border along the slope
#   of its rim: measured 1, 1 and 2.
LIGHT_BOUND = {
    "marker_mask-dog": (2.83, 0.0),
    "marker_mask-classic": (4.0, 0.0),
    "difference-noise": (1.0, 1.0),
    "difference-colour": (2.0, 0.0),
    "difference-classic": (2.0, 0.0),
}


@pytest.mark.parametrize("method", LIGHT_BOUND)
@pytest.mark.parametrize("change", LIT)
def test_masks_do_not_depend_on_gain_offset_or_the_order_of_channels(
    method: str, change: Transformation
) -> None:
    pictures = gel(dots=method.startswith("marker"))
    find = PICTURE_METHODS[method]
    here = find(pictures.reference, pictures.touched)
    there = find(change.picture(pictures.reference), change.picture(pictures.touched))
    assert here.any()
    gain = change.name.startswith("times") and "times 1 " not in change.name
    assert apart(here, there) <= LIGHT_BOUND[method][0 if gain else 1]


@pytest.mark.parametrize("method", INPAINTING)
@pytest.mark.parametrize("change", LIT)
def test_inpainting_follows_gain_offset_and_the_order_of_channels(
    method: str, change: Transformation
) -> None:
    pictures = gel()
    mask = MARKER_MASKS["dog"](pictures.reference, pictures.touched)
    here = change.picture(remove_markers(pictures.touched, mask, method=method))  # type: ignore[arg-type]
    there = remove_markers(change.picture(pictures.touched), mask, method=method)  # type: ignore[arg-type]
    # normalized: a weighted mean of pixels that are each off by half a level, twice rounded: derived 2.
    # telea, ns: errors of half a level travel inwards from pixel to pixel; measured 4 and 3.
    assert int(cv2.absdiff(here, there).max()) <= {"normalized": 2, "telea": 8, "ns": 8, "none": 0}[method]


@pytest.mark.parametrize("method", TRACKERS)
@pytest.mark.parametrize("change", LIT)
def test_the_tracker_does_not_depend_on_gain_offset_or_the_order_of_channels(
    method: str, change: Transformation
) -> None:
    pictures = gel()
    here = tracked(TRACKERS[method], pictures.reference, pictures.touched)
    there = tracked(TRACKERS[method], change.picture(pictures.reference), change.picture(pictures.touched))
    assert len(here.origin) == len(there.origin) == 24
    index, away = paired(here, there, here.origin)
    # appearance: luma is another mean of the channels, and rounding is other noise; measured 0.014, 0.019.
    # classic: its fixed threshold moves the border of its mask with a gain; measured 0.55, 0.62.
    of_origin, of_position = {"appearance": (0.03, 0.04), "classic": (1.1, 1.3)}[method]
    assert away.max() <= of_origin
    assert np.hypot(*(there.position[index] - here.position).T).max() <= of_position


# -- preprocess and probe ---------------------------------------------------------------------------------

PREPROCESS = [
    pytest.param({"method": "area", "downsample": 2}, 1, id="area"),
    pytest.param({"method": "pyramid", "downsample": 2}, 1, id="pyramid"),
    pytest.param({"method": "area", "downsample": 1}, 0, id="plain"),
]


@pytest.mark.parametrize("rotate", [0, 90, 180, 270])
@pytest.mark.parametrize(("settings", "bound"), PREPROCESS)
def test_preprocessing_a_turned_frame_equals_turning_the_processed_one(
    settings: dict[str, Method], bound: int, rotate: int
) -> None:
    """Within one grey level of rounding; `pyramid` on odd sides, where turning keeps its samples."""
    picture = gel().touched
    if settings["method"] == "pyramid":
        picture = np.ascontiguousarray(picture[:-1, :-1])
    size = (picture.shape[1], picture.shape[0])
    straight = Preprocessor(size, **settings)(picture)  # type: ignore[arg-type]
    turned = Preprocessor(size, rotate=rotate, **settings)(picture)  # type: ignore[arg-type]
    expected = np.rot90(straight, -rotate // 90)
    assert turned.shape == expected.shape
    assert int(cv2.absdiff(turned, np.ascontiguousarray(expected)).max()) <= bound


def test_a_remapped_frame_follows_a_translation_exactly() -> None:
    """The homography moves with the camera by whole pixels: the same bilinear samples, away from the rim."""
    corners = np.array([[20.0, 20], [150, 16], [24, 110], [156, 108]])
    square = [[0, 0], [100, 0], [0, 80], [100, 80]]
    results = []
    for shift in ((0, 0), (7, 5)):
        process = Preprocessor(SIZE, homography=(corners - shift, square, (101, 81)))
        results.append(process(gel(shift).touched))
    # Coordinates differ by float32 rounding, which may tip the rounding to 1/32 px: one such step on the
    # steepest edge (130 grey levels a pixel) is 4 levels, and 1 for rounding; derived (measured 0).
    assert int(cv2.absdiff(*results).max()) <= 5


def test_the_probe_follows_turns_mirrors_and_channels() -> None:
    """What it looks at is chosen anew, but still frames stay still and a touch is seen."""
    for change in (*MOTIONS, *SWAPPED):
        picture = change.picture(gel().reference)
        random = np.random.default_rng(1)

        def noisy(picture: Image = picture, random: np.random.Generator = random) -> Image:
            rough = picture + random.normal(0, 1, picture.shape)
            return np.clip(np.rint(rough), 0, 255).astype(np.uint8)

        probe = ChangeProbe(noisy(), false_alarms=1e-6)
        for _ in range(20):
            probe.look(noisy())
        probe.anchor_here()
        assert not any(probe.look(noisy()) for _ in range(10)), change.name
        assert probe.look(change.picture(gel().touched)), change.name


@pytest.mark.parametrize("method", HULLS)
@pytest.mark.parametrize("shift", [(0, 0), (1, 0), (13, 29), (1000, 2000)], ids=str)
def test_geometry_follows_a_translation(method: str, shift: tuple[int, int]) -> None:
    mask = gel().mask
    x, y = shift
    moved = np.zeros((HEIGHT + y, WIDTH + x), np.uint8)
    moved[y:, x:] = mask
    here, there = (HULLS[method](part) for part in (mask, moved))
    assert here is not None
    assert there is not None
    assert here.angle is not None
    assert there.angle is not None
    assert there.area == here.area
    np.testing.assert_array_equal(there.hull, here.hull + shift)
    # moments: whole numbers, exact to the rounding of the sum. classic: float32 at 2000 px holds 1e-4 px, for
    # a contact 60 px long; derived.
    assert axis_difference(there.angle, here.angle) <= {"moments": 1e-12, "classic": 1e-3}[method]
    if method == "moments":
        np.testing.assert_allclose(there.center, np.add(here.center, shift), rtol=1e-15)
