"""Pictures and contacts that no sensor should give: a defined answer, or an error that says what to do."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest

from tactflow.drawing.results import Annotator
from tactflow.vision.change import ChangeProbe
from tactflow.vision.flow import flow_in_mask
from tactflow.vision.geometry import Preprocessor
from tactflow.vision.geometry.hull import contact_geometry, contact_parts
from tactflow.vision.markers.detection import NoMarkersError, detect_markers
from tactflow.vision.markers.mask import Dot, find_dot, marker_mask
from tactflow.vision.markers.tracking import MarkerTracker
from tactflow.vision.types import Markers, MarkerStatus
from tests.stress.builders import (
    DIFFERENCES,
    PICTURE_METHODS,
    Image,
    Points,
    assert_defined,
    assert_mask,
    detector,
    gel,
)

SHAPES = ((1, 1), (1, 7), (7, 1), (3, 5), (17, 31), (64, 48))
HEIGHT, WIDTH = 60, 80
ROWS, COLUMNS = np.indices((HEIGHT, WIDTH))


def checkerboard(shape: tuple[int, int], cell: int) -> Image:
    rows, columns = np.indices(shape) // cell
    return np.repeat(((rows + columns) % 2 * 255).astype(np.uint8)[..., None], 3, axis=2)


PICTURES: dict[str, Callable[[tuple[int, int]], Image]] = {
    "black": lambda shape: np.zeros((*shape, 3), np.uint8),
    "white": lambda shape: np.full((*shape, 3), 255, np.uint8),
    "one channel": lambda shape: np.full((*shape, 3), (0, 0, 255), np.uint8),
    "fine checkerboard": lambda shape: checkerboard(shape, 1),
    "checkerboard": lambda shape: checkerboard(shape, 8),
    "noise": lambda shape: np.random.default_rng(3).integers(0, 256, (*shape, 3), dtype=np.uint8),
}


@pytest.mark.parametrize("shape", SHAPES, ids=str)
@pytest.mark.parametrize("method", PICTURE_METHODS)
def test_every_pair_of_degenerate_pictures_has_a_defined_answer(method: str, shape: tuple[int, int]) -> None:
    pictures = [make(shape) for make in PICTURES.values()]
    for reference, image in ((a, b) for a in pictures for b in pictures):
        try:
            answer = PICTURE_METHODS[method](reference, image)
        except NoMarkersError:
            assert method == "tracker"
            continue
        assert_defined(answer)
        if isinstance(answer, Markers):
            assert (answer.origin > -1).all()
            assert (answer.origin < shape[::-1]).all()
        elif method.startswith("inpaint"):
            assert (answer.shape, answer.dtype) == (image.shape, np.uint8)
        else:
            assert_mask(answer, shape)


@pytest.mark.parametrize("name", PICTURES)
def test_the_same_picture_again_is_no_contact_and_no_change(name: str) -> None:
    for shape in SHAPES:
        image = PICTURES[name](shape)
        for method in DIFFERENCES:
            contact = detector(method, image)
            assert not any(contact.detect(image).touching for _ in range(3)), shape
        probe = ChangeProbe(image)
        for _ in range(8):
            probe.look(image)
        assert not probe.look(image)
        assert_defined(probe.noise)
        assert Annotator()(image).shape == image.shape
        if name not in ("checkerboard", "noise"):
            assert find_dot(image) is None


@pytest.mark.parametrize("radius", [0.1, 5, 300])
@pytest.mark.parametrize("polarity", ["dark", "bright"])
def test_any_size_of_dot_gives_a_mask_on_any_picture(radius: float, polarity: str) -> None:
    for shape in SHAPES:
        for make in PICTURES.values():
            assert_mask(marker_mask(make(shape), Dot(radius, polarity, 6.0)), shape)  # type: ignore[arg-type]


@pytest.mark.parametrize("shape", SHAPES, ids=str)
@pytest.mark.parametrize("method", ["area", "pyramid"])
def test_preprocess_takes_any_size_or_says_what_is_required(method: Any, shape: tuple[int, int]) -> None:
    height, width = shape
    for rotate, downsample in ((0, 1), (90, 2), (180, 4), (270, 16)):
        if method == "area" and min(shape) < downsample:
            with pytest.raises(ValueError, match="required both sides of the frame"):
                Preprocessor((width, height), rotate=rotate, downsample=downsample, method=method)
            continue
        process = Preprocessor((width, height), rotate=rotate, downsample=downsample, method=method)
        assert process(PICTURES["noise"](shape)).shape[1::-1] == process.mapping.size


# -- markers and contacts in gels -------------------------------------------------------------------------


def dots(centers: Points) -> Image:
    """Dark dots with soft rims on a grey gel with a little noise."""
    rows, columns = np.indices((128, 176)).astype(np.float64)
    cover = np.zeros((128, 176))
    for x, y in centers:
        np.maximum(cover, np.clip(5.5 - np.hypot(columns - x, rows - y), 0, 1), out=cover)
    rough = np.random.default_rng(2).normal(0, 1, (128, 176, 3))
    return np.clip(np.rint(150 * (1 - 0.8 * cover[..., None]) + rough), 0, 255).astype(np.uint8)


GRID = np.stack(np.meshgrid(np.arange(20, 170, 28.0), np.arange(20, 120, 28.0)), axis=-1).reshape(-1, 2)


@pytest.mark.parametrize("count", [0, 1, 3])
def test_fewer_than_four_marks_need_a_radius(count: int) -> None:
    image = dots(GRID[8 : 8 + count])
    with pytest.raises(NoMarkersError, match="markers found"):
        detect_markers(image, dot_radius=None if count else 5, polarity="dark")
    if count:
        found = detect_markers(image, dot_radius=5, polarity="dark")
        order = np.argsort(found.centers[:, 0])
        # Noise of 1 level on 90 levels of contrast: the standard error is below 0.02 px; 10 of them.
        assert np.abs(found.centers[order] - GRID[8 : 8 + count]).max() < 0.2
        moved = MarkerTracker(image, found).track(dots(GRID[8 : 8 + count] + np.array([2.25, -1.5])))
        assert np.abs(moved.displacement - (2.25, -1.5)).max() < 0.2


def test_marks_that_vanish_merge_or_multiply_keep_their_identities() -> None:
    reference = dots(GRID)
    tracker = MarkerTracker(reference, detect_markers(reference))
    for image in (dots(GRID[:0]), np.zeros_like(reference), np.full_like(reference, 255)):
        gone = tracker.track(image)
        assert_defined(gone)
        assert (gone.status != MarkerStatus.TRACKED).all()
    again = tracker.track(reference)
    assert (again.status == MarkerStatus.TRACKED).all()
    assert np.abs(again.displacement).max() < 0.05
    rows, columns = np.indices(reference.shape[:2])
    blob = np.where((np.hypot(columns - 88, rows - 64) < 90)[..., None], np.uint8(30), reference)
    assert (tracker.track(blob).status != MarkerStatus.TRACKED).mean() > 0.5
    tracker = MarkerTracker(reference, detect_markers(reference))
    for _ in range(3):
        crowded = tracker.track(dots(np.concatenate([GRID, GRID[:-1] + 14])))
    assert len(crowded.origin) == len(GRID)
    # A neighbour's rim 9 px away is inside the patch that a mark is compared with; measured 0.03 px.
    assert np.abs(crowded.displacement).max() < 0.1


@pytest.mark.parametrize("method", DIFFERENCES)
def test_a_reference_in_contact_shows_what_changes_and_recovers(method: str) -> None:
    pictures = gel(dots=False)
    contact = detector(method, pictures.touched)
    assert not contact.detect(pictures.touched).touching
    released = contact.detect(pictures.reference)
    assert released.touching
    assert not (released.mask[~pictures.contact] > 0).sum() > 0.2 * pictures.contact.sum()
    contact.reset()
    contact.add_reference(pictures.reference)
    assert contact.detect(pictures.touched).touching


# The search for dots takes four seconds.
LARGE: list[Any] = ["inpaint-normalized", "difference-noise", "tracker"]
SLOW: list[Any] = [pytest.param("marker_mask", marks=pytest.mark.slow)]


@pytest.mark.parametrize("method", LARGE + SLOW)
def test_4k_frames_have_an_answer(method: str) -> None:
    large = []
    for picture in (gel().reference, gel().touched):
        once = cv2.resize(picture, None, fx=8, fy=8, interpolation=cv2.INTER_LINEAR)
        large.append(np.full((2160, 3840, 3), 120, np.uint8))
        large[-1][500 : 500 + once.shape[0], 900 : 900 + once.shape[1]] = once
    answer = PICTURE_METHODS[method](*large)
    assert_defined(answer)
    if isinstance(answer, Markers):
        # Marks move by up to 8 * 2.5 px.
        assert len(answer.origin) == 24
        assert 15 < np.abs(answer.displacement).max() < 22
    else:
        assert answer.shape[:2] == (2160, 3840)


# -- masks ------------------------------------------------------------------------------------------------


def mask(inside: Any) -> Image:
    return np.broadcast_to(inside, (HEIGHT, WIDTH)).astype(np.uint8) * np.uint8(255)


# Name -> mask, area, centre, angle, whether there is an ellipse. By hand.
KNOWN: dict[str, tuple[Image, float, tuple[float, float], float | None, bool]] = {
    "one pixel": (mask((ROWS == 20) & (COLUMNS == 30)), 1, (30, 20), None, False),
    "one row": (mask(ROWS == 7), 80, (39.5, 7), 0.0, False),
    "one column": (mask(COLUMNS == 79), 60, (79, 29.5), 90.0, False),
    "a diagonal": (mask((ROWS + 10 == COLUMNS) & (abs(COLUMNS - 39.5) < 20)), 40, (39.5, 29.5), -45.0, False),
    "a disc": (mask(np.hypot(COLUMNS - 40, ROWS - 30) <= 20), 1257, (40, 30), None, True),
    "the whole frame": (mask(True), 4800, (39.5, 29.5), 0.0, True),
    # Two specks of dust always lie on a line: that is no direction.
    "two far pixels": (mask(ROWS + COLUMNS == 0) | mask(ROWS + COLUMNS == 138), 2, (39.5, 29.5), None, False),
    "the border alone": (mask((ROWS % 59 == 0) | (COLUMNS % 79 == 0)), 4800, (39.5, 29.5), 0.0, True),
}


@pytest.mark.parametrize("name", KNOWN)
def test_degenerate_contacts_have_the_geometry_worked_out_by_hand(name: str) -> None:
    image, area, center, angle, ellipse = KNOWN[name]
    found = contact_geometry(image)
    assert found is not None
    assert_defined((found, *contact_parts(image, max_gap=5.0)))
    assert found.area == area
    assert found.region_area == (image > 0).sum()
    # One division of whole numbers: half a unit in the last place.
    np.testing.assert_allclose(found.center, center, rtol=1e-15)
    assert found.angle == (None if angle is None else pytest.approx(angle, abs=1e-12))
    slope = None if angle in (None, 90.0) else pytest.approx(-np.tan(np.radians(angle)), abs=1e-12)
    assert found.slope == slope
    assert (found.ellipse is not None) == ellipse
    drawn = Annotator(ellipse=True)(np.zeros((HEIGHT, WIDTH, 3), np.uint8), contact=found, contact_mask=image)
    assert drawn.any()


@pytest.mark.parametrize("shape", [(0, 0), (0, 5), (1, 1), (1, 9), (13, 7)], ids=str)
def test_an_empty_mask_of_any_size_is_no_contact(shape: tuple[int, int]) -> None:
    assert contact_geometry(np.zeros(shape, np.uint8)) is None
    if 0 not in shape:
        assert_defined(contact_geometry(np.full(shape, 255, np.uint8)))


@pytest.mark.parametrize("name", KNOWN)
def test_the_flow_in_degenerate_contacts_is_that_of_the_markers_inside(name: str) -> None:
    origin = np.stack(np.meshgrid(np.arange(5, 80, 10.0), np.arange(5, 60, 10.0)), axis=-1).reshape(-1, 2)
    markers = Markers(origin, origin + np.array([3.0, -2.0]), np.zeros(48, np.uint8), np.full(48, 0.1))
    flow = flow_in_mask(markers, KNOWN[name][0])
    assert_defined(flow)
    if name != "a disc":
        assert flow.count == {"the whole frame": 48, "a diagonal": 0}.get(name, 0)
    if flow.count:
        assert flow.mean == pytest.approx((3, -2), abs=1e-12)
        assert flow.rotation == pytest.approx(0, abs=1e-10)
    else:
        assert flow.mean is None


FAR = [[-500, 1e9], [40, 30], [1e300, 0]]


@pytest.mark.parametrize("origin", [[], [[40, 30]], [[40, 30]] * 5, [[10 * k, 30] for k in range(8)], FAR])
def test_few_or_flat_or_far_markers_have_a_defined_flow_and_are_drawn(origin: list[list[float]]) -> None:
    at = np.array(origin, float).reshape(-1, 2)
    markers = Markers(at, at + 1, np.zeros(len(at), np.uint8), np.full(len(at), np.nan))
    for dilate in (0.0, 7.5, 1e6):
        flow = flow_in_mask(markers, mask(True), dilate=dilate)
        assert_defined(flow)
        if len(np.unique(at[:, 1])) < 2:
            assert flow.rotation is None
    near = Markers(np.clip(at, -1e7, 1e7), np.clip(at, -1e7, 1e7) + 1, markers.status, markers.stderr)
    assert Annotator()(np.zeros((HEIGHT, WIDTH, 3), np.uint8), markers=near).shape == (HEIGHT, WIDTH, 3)
