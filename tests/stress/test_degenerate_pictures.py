"""Pictures that no sensor should give: each method gives a defined answer, or says what it required."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.drawing.results import Annotator
from tactflow.vision.change import ChangeProbe
from tactflow.vision.geometry import Preprocessor
from tactflow.vision.markers.detection import NoMarkersError, detect_markers
from tactflow.vision.markers.inpaint import remove_markers
from tactflow.vision.markers.mask import Dot, find_dot, marker_mask
from tactflow.vision.markers.tracking import MarkerTracker
from tactflow.vision.types import Markers, MarkerStatus
from tests.stress.builders import (
    DIFFERENCES,
    INPAINTING,
    PICTURE_METHODS,
    TRACKERS,
    Image,
    Points,
    assert_defined,
    assert_mask,
    gel,
)

SHAPES = ((1, 1), (1, 7), (7, 1), (2, 2), (3, 5), (17, 31), (64, 48))


def _uniform(level: int) -> Callable[[tuple[int, int]], Image]:
    return lambda shape: np.full((*shape, 3), level, np.uint8)


def _checkerboard(cell: int) -> Callable[[tuple[int, int]], Image]:
    def make(shape: tuple[int, int]) -> Image:
        rows, columns = np.indices(shape) // cell
        return np.repeat(((rows + columns) % 2 * 255).astype(np.uint8)[..., None], 3, axis=2)

    return make


def _noise(shape: tuple[int, int]) -> Image:
    return np.random.default_rng(3).integers(0, 256, (*shape, 3), dtype=np.uint8)


def _ramp(shape: tuple[int, int]) -> Image:
    rows, columns = np.indices(shape)
    return np.repeat((rows * 5 + columns * 3).astype(np.uint8)[..., None], 3, axis=2)


def _one_channel(shape: tuple[int, int]) -> Image:
    image = np.zeros((*shape, 3), np.uint8)
    image[..., 2] = 255
    return image


PICTURES: dict[str, Callable[[tuple[int, int]], Image]] = {
    "black": _uniform(0),
    "white": _uniform(255),
    "constant": _uniform(128),
    "saturated in one channel": _one_channel,
    "checkerboard of pixels": _checkerboard(1),
    "checkerboard": _checkerboard(8),
    "noise": _noise,
    "ramp with overflow": _ramp,
}


def answered(method: str, reference: Image, image: Image) -> object | None:
    """The method's answer; None where it refused with words that say what it required."""
    try:
        return PICTURE_METHODS[method](reference, image)
    except ValueError as error:
        words = "markers found" if isinstance(error, NoMarkersError) else "required"
        if words not in str(error):
            raise
    return None


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: f"{shape[0]}x{shape[1]}")
@pytest.mark.parametrize("method", PICTURE_METHODS)
def test_every_pair_of_degenerate_pictures_has_a_defined_answer(method: str, shape: tuple[int, int]) -> None:
    pictures = [make(shape) for make in PICTURES.values()]
    for reference in pictures:
        for image in pictures:
            before = image.copy()
            answer = answered(method, reference, image)
            assert np.array_equal(image, before)
            if answer is None:
                assert method.startswith("tracker")
                continue
            assert_defined(answer)
            if isinstance(answer, Markers):
                height, width = shape
                assert len(answer.origin) >= 1
                assert (answer.origin > -1).all()
                assert (answer.origin < (width, height)).all()
            elif method.startswith("inpaint"):
                assert isinstance(answer, np.ndarray)
                assert answer.shape == image.shape
                assert answer.dtype == np.uint8
            else:
                assert isinstance(answer, np.ndarray)
                assert_mask(answer, shape)


@pytest.mark.parametrize("name", PICTURES)
@pytest.mark.parametrize("method", DIFFERENCES)
def test_the_same_frame_again_is_never_contact(method: str, name: str) -> None:
    for shape in SHAPES:
        image = PICTURES[name](shape)
        detector = DIFFERENCES[method]()
        detector.add_reference(image)
        for _ in range(3):
            assert not detector.detect(image).touching, shape


@pytest.mark.parametrize("name", [name for name in PICTURES if name not in ("checkerboard", "noise")])
def test_no_marks_are_found_where_there_are_none(name: str) -> None:
    for shape in (*SHAPES, (120, 160)):
        assert find_dot(PICTURES[name](shape)) is None, shape


@pytest.mark.parametrize("method", INPAINTING)
@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: f"{shape[0]}x{shape[1]}")
def test_inpainting_with_nothing_or_everything_masked_leaves_the_picture(
    method: str, shape: tuple[int, int]
) -> None:
    image = _noise(shape)
    for level in (0, 255):
        filled = remove_markers(image, np.full(shape, level, np.uint8), method=method)  # type: ignore[arg-type]
        assert filled.shape == image.shape
        if level == 0 or method in ("none", "normalized"):
            assert np.array_equal(filled, image)
        assert not np.shares_memory(filled, image)


@pytest.mark.parametrize("method", ["normalized", "telea", "ns"])
def test_inpainting_knows_nothing_but_what_the_mask_has_left(method: str) -> None:
    image = np.full((24, 24, 3), 7, np.uint8)
    mask = np.full((24, 24), 255, np.uint8)
    mask[8:16, 8:16] = 0
    image[8:16, 8:16] = (50, 100, 200)
    filled = remove_markers(image, mask, method=method)  # type: ignore[arg-type]
    # A mean of equal values is that value. OpenCV's Telea adds a gradient that it takes across the rim of the
    # hole; measured 3.
    bound = {"normalized": 0, "ns": 1, "telea": 6}[method]
    assert int(np.abs(filled.astype(int) - (50, 100, 200)).max()) <= bound


@pytest.mark.parametrize("radius", [0.1, 1, 5, 60, 300])
@pytest.mark.parametrize("polarity", ["dark", "bright"])
def test_any_size_of_dot_gives_a_mask_on_any_picture(radius: float, polarity: str) -> None:
    for shape in SHAPES:
        for make in PICTURES.values():
            assert_mask(marker_mask(make(shape), Dot(radius, polarity, 6.0)), shape)  # type: ignore[arg-type]


# -- markers ----------------------------------------------------------------------------------------------


def dots(centers: Points, radius: float = 5.0, shape: tuple[int, int] = (128, 176)) -> Image:
    """Dark dots with soft rims on a grey gel with a little noise."""
    rows, columns = np.indices(shape).astype(np.float64)
    cover = np.zeros(shape)
    for x, y in centers:
        np.maximum(cover, np.clip(radius + 0.5 - np.hypot(columns - x, rows - y), 0, 1), out=cover)
    rough = np.random.default_rng(2).normal(0, 1, (*shape, 3))
    return np.clip(np.rint(150 * (1 - 0.8 * cover[..., None]) + rough), 0, 255).astype(np.uint8)


GRID = np.stack(np.meshgrid(np.arange(20, 170, 28.0), np.arange(20, 120, 28.0)), axis=-1).reshape(-1, 2)


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_fewer_than_four_marks_need_a_radius_and_none_are_refused(count: int) -> None:
    image = dots(GRID[8 : 8 + count])
    with pytest.raises(NoMarkersError, match="markers found"):
        detect_markers(image)
    if count == 0:
        with pytest.raises(NoMarkersError, match="markers found"):
            detect_markers(image, dot_radius=5, polarity="dark")
        return
    found = detect_markers(image, dot_radius=5, polarity="dark")
    assert len(found.centers) == count
    order = np.argsort(found.centers[:, 0])
    # Noise of 1 level on 90 levels of contrast: the centroid's standard error is below 0.02 px; 10 of them.
    assert np.abs(found.centers[order] - GRID[8 : 8 + count]).max() < 0.2
    moved = MarkerTracker(image, found).track(dots(GRID[8 : 8 + count] + np.array([2.25, -1.5])))
    assert_defined(moved)
    assert (moved.status == MarkerStatus.TRACKED).all()
    assert np.abs(moved.displacement - (2.25, -1.5)).max() < 0.2


@pytest.mark.parametrize("method", TRACKERS)
def test_marks_that_all_vanish_are_lost_and_found_again(method: str) -> None:
    reference, blank = dots(GRID), dots(GRID[:0])
    tracker = TRACKERS[method](reference)
    for image in (blank, blank, np.zeros_like(blank), np.full_like(blank, 255)):
        gone = tracker.track(image)
        assert_defined(gone)
        assert (gone.status != MarkerStatus.TRACKED).all()
    again = tracker.track(reference)
    assert (again.status == MarkerStatus.TRACKED).all()
    assert np.abs(again.displacement).max() < 0.05


@pytest.mark.parametrize("method", TRACKERS)
def test_all_marks_merged_into_one_blob_are_not_called_tracked(method: str) -> None:
    reference = dots(GRID)
    tracker = TRACKERS[method](reference)
    rows, columns = np.indices(reference.shape[:2])
    blob = reference.copy()
    blob[np.hypot(columns - 88, rows - 64) < 90] = 30
    merged = tracker.track(blob)
    assert_defined(merged)
    assert (merged.status != MarkerStatus.TRACKED).mean() > 0.5


@pytest.mark.parametrize("method", TRACKERS)
def test_more_marks_than_the_grid_has_do_not_take_over_its_identities(method: str) -> None:
    reference = dots(GRID)
    extra = np.concatenate([GRID, GRID[:-1] + 14])
    tracker = TRACKERS[method](reference)
    for _ in range(3):
        crowded = tracker.track(dots(extra))
        assert_defined(crowded)
        assert len(crowded.origin) == len(GRID)
    if method == "appearance":
        assert (crowded.status == MarkerStatus.TRACKED).all()
        # A neighbour's rim 9 px away is inside the patch that a mark is compared with; measured 0.03 px.
        assert np.abs(crowded.displacement).max() < 0.1


@pytest.mark.parametrize("method", TRACKERS)
def test_the_same_frame_for_ever_never_drifts(method: str) -> None:
    pictures = gel()
    tracker = TRACKERS[method](pictures.reference)
    positions = [tracker.track(pictures.touched).position for _ in range(60)]
    # The last position decides which of sixteen sub-pixel phases a mark is compared with. Half way between
    # two phases it may alternate: measured 0.017 px, but between the same two answers for ever.
    assert np.array_equal(positions[-1], positions[-3])
    assert np.array_equal(positions[10], positions[-2])
    assert max(np.abs(position - positions[0]).max() for position in positions) < 0.034


# -- contact ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", DIFFERENCES)
def test_a_reference_already_in_contact_shows_what_changes_and_recovers(method: str) -> None:
    pictures = gel(dots=False)
    detector = DIFFERENCES[method]()
    detector.add_reference(pictures.touched)
    assert not detector.detect(pictures.touched).touching
    released = detector.detect(pictures.reference)
    assert_mask(released.mask, pictures.mask.shape)
    # The script's rule wants brightening, and a release darkens; the others report the change where it is.
    assert released.touching == (method != "classic")
    assert not (released.mask[~pictures.contact] > 0).sum() > 0.2 * pictures.contact.sum()
    detector.reset()
    detector.add_reference(pictures.reference)
    assert detector.detect(pictures.touched).touching


@pytest.mark.parametrize("method", DIFFERENCES)
def test_a_frame_that_is_wholly_brighter_is_defined(method: str) -> None:
    """White after black is either contact everywhere or a change of the light; never a part of it."""
    black, white = (np.full((64, 48, 3), level, np.uint8) for level in (0, 255))
    mask = contact(method, black, white)
    assert_mask(mask, (64, 48))
    assert mask.mean() in (0.0, 255.0)


def contact(method: str, reference: Image, image: Image) -> NDArray[np.uint8]:
    detector = DIFFERENCES[method]()
    detector.add_reference(reference)
    return detector.detect(image).mask


@pytest.mark.parametrize("method", DIFFERENCES)
def test_the_same_touch_for_ever_gives_the_same_mask_for_ever(method: str) -> None:
    pictures = gel(dots=False)
    detector = DIFFERENCES[method]()
    detector.add_reference(pictures.reference)
    masks = [detector.detect(pictures.touched).mask for _ in range(60)]
    assert masks[0].any()
    assert all(np.array_equal(mask, masks[1]) for mask in masks[1:])


# -- large ------------------------------------------------------------------------------------------------

LARGE = [
    # It takes four seconds.
    pytest.param(name, marks=pytest.mark.slow) if name == "marker_mask-dog" else name
    for name in PICTURE_METHODS
    if name not in ("inpaint-telea", "inpaint-ns")
]


@pytest.fixture(scope="module")
def four_k() -> tuple[Image, Image]:
    """The small gel, untouched and touched, eight times as large, on a plain frame of 3840 x 2160."""
    large = []
    for picture in (gel().reference, gel().touched):
        once = cv2.resize(picture, None, fx=8, fy=8, interpolation=cv2.INTER_LINEAR)
        plain = np.full((2160, 3840, 3), 120, np.uint8)
        plain[500 : 500 + once.shape[0], 900 : 900 + once.shape[1]] = once
        large.append(plain)
    return large[0], large[1]


@pytest.mark.parametrize("method", LARGE)
def test_4k_frames_have_an_answer(method: str, four_k: tuple[Image, Image]) -> None:
    reference, touched = four_k
    if method == "tracker-classic":
        # Its dots have at most 500 px^2, these have 7000.
        with pytest.raises(NoMarkersError, match="markers found"):
            PICTURE_METHODS[method](reference, touched)
        return
    answer = PICTURE_METHODS[method](reference, touched)
    assert_defined(answer)
    if isinstance(answer, Markers):
        # Marks move by up to 8 * 2.5 px.
        assert len(answer.origin) == 24
        assert 15 < np.abs(answer.displacement).max() < 22
    else:
        assert isinstance(answer, np.ndarray)
        assert answer.shape[:2] == (2160, 3840)


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: f"{shape[0]}x{shape[1]}")
def test_the_probe_and_the_annotator_take_any_size(shape: tuple[int, int]) -> None:
    for make in PICTURES.values():
        image = make(shape)
        probe = ChangeProbe(image)
        for _ in range(8):
            assert isinstance(probe.look(image), bool)
        assert not probe.look(image)
        assert probe.noise is not None
        assert_defined(probe.noise)
        picture = Annotator()(image)
        assert picture.shape == image.shape


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: f"{shape[0]}x{shape[1]}")
@pytest.mark.parametrize("rotate", [0, 90, 180, 270])
@pytest.mark.parametrize("method", ["area", "pyramid"])
def test_preprocess_takes_any_size_or_says_what_it_required(
    method: str, rotate: int, shape: tuple[int, int]
) -> None:
    height, width = shape
    image = _noise(shape)
    for downsample in (1, 2, 4, 8, 16):
        settings = {"rotate": rotate, "downsample": downsample, "method": method}
        if method == "area" and min(shape) < downsample:
            with pytest.raises(ValueError, match="required both sides of the frame"):
                Preprocessor((width, height), **settings)  # type: ignore[arg-type]
            continue
        process = Preprocessor((width, height), **settings)  # type: ignore[arg-type]
        result = process(image)
        assert result.shape[1::-1] == process.mapping.size
        corners = np.array([[0, 0], [width - 1, height - 1]], float)
        back = process.mapping.to_raw(process.mapping.to_processed(corners))
        # Affine with powers of two: exact to the rounding of one inverse.
        assert np.abs(back - corners).max() < 1e-12 * max(shape)


def test_a_degenerate_picture_is_remapped_to_itself() -> None:
    for make in PICTURES.values():
        image = make((40, 60))
        corners = [[0, 0], [59, 0], [0, 39], [59, 39]]
        process = Preprocessor((60, 40), homography=(corners, corners, (60, 40)))
        assert int(cv2.absdiff(process(image), image).max()) == 0
