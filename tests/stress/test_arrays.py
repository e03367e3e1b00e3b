"""Arrays as others hand them over: strided, mirrored, in Fortran order, read-only; and what is given back."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.drawing.results import Annotator
from tactflow.vision.change import ChangeProbe
from tactflow.vision.flow import inside_mask
from tactflow.vision.geometry import Preprocessor
from tactflow.vision.geometry.hull import contact_geometry, contact_parts
from tactflow.vision.markers.inpaint import remove_markers
from tactflow.vision.markers.mask import Dot, marker_mask
from tactflow.vision.types import Contact, Flow, Markers
from tests.stress.builders import (
    DIFFERENCES,
    FLOWS,
    HULLS,
    INPAINTING,
    PICTURE_METHODS,
    SIZE,
    TRACKERS,
    gel,
)

Array = NDArray[Any]


def _strided(array: Array) -> Array:
    large = np.zeros((2 * array.shape[0], 3 * array.shape[1], *array.shape[2:]), array.dtype)
    large[::2, ::3] = array
    return large[::2, ::3]


def _backwards(array: Array) -> Array:
    return np.ascontiguousarray(array[::-1, ::-1])[::-1, ::-1]


def _window(array: Array) -> Array:
    """A part of a larger array, as a crop of a camera's frame is."""
    large = np.full((array.shape[0] + 5, array.shape[1] + 7, *array.shape[2:]), 77, array.dtype)
    large[2:-3, 3:-4] = array
    return large[2:-3, 3:-4]


LAYOUTS: dict[str, Callable[[Array], Array]] = {
    "strided": _strided,
    "backwards": _backwards,
    "a window": _window,
    "Fortran order": np.asfortranarray,
}

PLAIN = gel()
CONTACT = contact_geometry(PLAIN.mask)
MARKERS = Markers(PLAIN.origin, PLAIN.position, np.zeros(24, np.uint8), np.full(24, np.nan))


def _probed(reference: Array, image: Array) -> Any:
    probe = ChangeProbe(reference)
    return [probe.look(picture) for picture in (reference,) * 8 + (image, image)]


def _preprocessed(**settings: Any) -> Callable[[Array, Array], Any]:
    return lambda _reference, image: Preprocessor(SIZE, **settings)(image)


CORNERS = [[3.0, 2], [170, 5], [1, 120], [174, 125]]
SQUARE = [[0.0, 0], [99, 0], [0, 79], [99, 79]]
PICTURES: dict[str, Callable[[Array, Array], Any]] = {
    **PICTURE_METHODS,
    "probe": _probed,
    "preprocess-area": _preprocessed(downsample=2, rotate=90),
    "preprocess-area 4": _preprocessed(downsample=4),
    "preprocess-pyramid": _preprocessed(downsample=2, method="pyramid"),
    "preprocess-crop": _preprocessed(crop=(5, 7, 50, 40)),
    "preprocess-remap": _preprocessed(homography=(CORNERS, SQUARE, (100, 80))),
    "draw": lambda _reference, image: Annotator()(image, contact=CONTACT, markers=MARKERS),
}

MASKS: dict[str, Callable[[Array], Any]] = {
    **{f"hull-{name}": lambda mask, name=name: HULLS[name](mask) for name in HULLS},
    "hull-groups": lambda mask: contact_parts(mask, min_area=5, max_gap=2)[0],
    **{f"flow-{name}": lambda mask, name=name: FLOWS[name](MARKERS, mask, dilate=3) for name in FLOWS},
    "inside": lambda mask: inside_mask(PLAIN.position, mask, 2.5),
    **{
        f"inpaint-{name}": lambda mask, name=name: remove_markers(PLAIN.touched, mask, method=name)
        for name in INPAINTING
    },
    "draw": lambda mask: Annotator(view="contact")(PLAIN.touched, contact=CONTACT, contact_mask=mask),
}


def flat(value: Any) -> list[Any]:
    """A result as a list of arrays and numbers, to be compared."""
    if isinstance(value, Markers):
        return [value.origin, value.position, value.status, value.stderr]
    if isinstance(value, Contact):
        return [value.area, value.center, value.angle or 0, value.hull, value.confidence]
    if isinstance(value, Flow):
        return [value.mean, value.count, value.rotation or 0]
    return [value]


def assert_equal(one: Any, other: Any) -> None:
    for a, b in zip(flat(one), flat(other), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("name", PICTURES)
def test_the_layout_of_a_picture_in_memory_changes_nothing(name: str, layout: str) -> None:
    arranged = [LAYOUTS[layout](picture) for picture in (PLAIN.reference, PLAIN.touched)]
    assert layout == "a window" or not arranged[0].flags.c_contiguous
    assert_equal(PICTURES[name](*arranged), PICTURES[name](PLAIN.reference, PLAIN.touched))


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("name", MASKS)
def test_the_layout_of_a_mask_in_memory_changes_nothing(name: str, layout: str) -> None:
    assert_equal(MASKS[name](LAYOUTS[layout](PLAIN.mask)), MASKS[name](PLAIN.mask))


@pytest.mark.parametrize("name", PICTURES)
def test_inputs_are_neither_written_nor_handed_back(name: str) -> None:
    given = [PLAIN.reference.copy(), PLAIN.touched.copy()]
    result = PICTURES[name](*given)
    assert np.array_equal(given[0], PLAIN.reference)
    assert np.array_equal(given[1], PLAIN.touched)
    for part in flat(result):
        if isinstance(part, np.ndarray):
            assert not any(np.shares_memory(part, picture) for picture in given)
    for picture in given:
        picture.flags.writeable = False
    assert_equal(PICTURES[name](*given), result)


@pytest.mark.parametrize("name", MASKS)
def test_masks_are_neither_written_nor_handed_back(name: str) -> None:
    mask = PLAIN.mask
    before = mask.copy()
    mask.flags.writeable = False
    result = MASKS[name](mask)
    assert np.array_equal(mask, before)
    for part in flat(result):
        if isinstance(part, np.ndarray):
            assert not np.shares_memory(part, mask)


@pytest.mark.parametrize("name", [name for name in PICTURES if name.startswith("preprocess")])
def test_a_processed_frame_is_not_written_by_the_next_one(name: str) -> None:
    settings = {
        "preprocess-area": {"downsample": 2, "rotate": 90},
        "preprocess-area 4": {"downsample": 4},
        "preprocess-pyramid": {"downsample": 2, "method": "pyramid"},
        "preprocess-crop": {"crop": (5, 7, 50, 40)},
        "preprocess-remap": {"homography": (CORNERS, SQUARE, (100, 80))},
    }[name]
    process = Preprocessor(SIZE, **settings)  # type: ignore[arg-type]
    first = process(PLAIN.touched)
    kept = first.copy()
    process(np.zeros_like(PLAIN.touched))
    assert np.array_equal(first, kept)


@pytest.mark.parametrize("name", TRACKERS)
def test_what_a_caller_does_with_markers_does_not_come_back(name: str) -> None:
    clean, spoiled = (TRACKERS[name](PLAIN.reference) for _ in range(2))
    for image in (PLAIN.touched, PLAIN.reference, PLAIN.touched):
        expected, markers = clean.track(image), spoiled.track(image)
        assert_equal(markers, expected)
        for part in flat(markers):
            part[...] = 1


@pytest.mark.parametrize("name", DIFFERENCES)
def test_what_a_caller_does_with_a_contact_mask_does_not_come_back(name: str) -> None:
    pictures = gel(dots=False)
    clean, spoiled = (DIFFERENCES[name]() for _ in range(2))
    own = pictures.reference.copy()
    clean.add_reference(pictures.reference)
    spoiled.add_reference(own)
    own[...] = 0
    for image in (pictures.touched, pictures.reference, pictures.touched):
        expected, mask = clean.detect(image).mask, spoiled.detect(image).mask
        assert np.array_equal(mask, expected)
        mask[...] = 1


@pytest.mark.parametrize("kind", [np.float32, np.int32, np.uint16, np.bool_])
def test_other_types_than_uint8_are_refused_by_name(kind: type) -> None:
    picture, mask = PLAIN.reference.astype(kind), PLAIN.mask.astype(kind)
    for name in PICTURES:
        with pytest.raises(ValueError, match="required"):
            PICTURES[name](picture, picture)
    for name in MASKS:
        with pytest.raises(ValueError, match="required"):
            MASKS[name](mask)


@pytest.mark.parametrize(
    "shape", [(), (5,), (5, 6, 1), (5, 6, 2), (5, 6, 4), (2, 5, 6, 3), (0, 6, 3), (5, 0, 3)]
)
def test_other_shapes_than_a_picture_are_refused_by_name(shape: tuple[int, ...]) -> None:
    picture = np.zeros(shape, np.uint8)
    for name in PICTURES:
        if name == "probe" and len(shape) == 3 and 0 not in shape:
            continue
        if name == "draw" and 0 in shape:
            continue
        with pytest.raises(ValueError, match="required"):
            PICTURES[name](picture, picture)


def test_no_function_leaves_opencv_with_other_settings() -> None:
    before = cv2.getNumThreads(), cv2.useOptimized()
    for name in PICTURES:
        PICTURES[name](PLAIN.reference, PLAIN.touched)
    assert (cv2.getNumThreads(), cv2.useOptimized()) == before


def test_the_marker_mask_of_a_window_has_the_size_of_the_window() -> None:
    assert marker_mask(_window(PLAIN.touched), Dot(6.0)).shape == PLAIN.touched.shape[:2]
