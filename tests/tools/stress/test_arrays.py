"""Arrays as others hand them over: strided, mirrored, in Fortran order, read-only; and what is given back."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.drawing.results import Annotator
from tactflow.tools.stress.inputs import SIZE, gel
from tactflow.vision.change import RestTest
from tactflow.vision.flow import flow_in_mask, inside_mask
from tactflow.vision.geometry import Preprocessor
from tactflow.vision.geometry.hull import contact_geometry, contact_parts
from tactflow.vision.markers.inpaint import remove_markers
from tactflow.vision.types import Contact, Flow, Markers
from tests.tools.stress.methods import PICTURE_METHODS

Array = NDArray[Any]


def _strided(array: Array) -> Array:
    large = np.zeros((2 * array.shape[0], 3 * array.shape[1], *array.shape[2:]), array.dtype)
    large[::2, ::3] = array
    return large[::2, ::3]


LAYOUTS: dict[str, Callable[[Array], Array]] = {
    "strided": _strided,
    "backwards": lambda array: np.ascontiguousarray(array[::-1, ::-1])[::-1, ::-1],
    "Fortran order": np.asfortranarray,
}
PLAIN = gel()
CONTACT = contact_geometry(PLAIN.mask)
MARKERS = Markers(PLAIN.origin, PLAIN.position, np.zeros(24, np.uint8), np.full(24, np.nan))


def _probed(reference: Array, image: Array) -> Any:
    probe = RestTest(reference)
    return [probe.look(picture) for picture in (reference,) * 8 + (image, image)]


CORNERS = [[3.0, 2], [170, 5], [1, 120], [174, 125]]
SQUARE = [[0.0, 0], [99, 0], [0, 79], [99, 79]]
PREPROCESS: dict[str, dict[str, Any]] = {
    "area": {"downsample": 2, "rotate": 90},
    "pyramid": {"downsample": 2, "method": "pyramid"},
    "crop": {"crop": (5, 7, 50, 40)},
    "remap": {"homography": (CORNERS, SQUARE, (100, 80))},
}
PICTURES: dict[str, Callable[[Array, Array], Any]] = {
    **PICTURE_METHODS,
    "probe": _probed,
    **{name: lambda _, image, s=s: Preprocessor(SIZE, **s)(image) for name, s in PREPROCESS.items()},
    "draw": lambda _reference, image: Annotator()(image, contact=CONTACT, markers=MARKERS),
}
MASKS: dict[str, Callable[[Array], Any]] = {
    "hull": contact_geometry,
    "parts": lambda mask: contact_parts(mask, min_area=5)[0],
    "flow": lambda mask: flow_in_mask(MARKERS, mask),
    "inside": lambda mask: inside_mask(PLAIN.position, mask),
    "inpaint": lambda mask: remove_markers(PLAIN.touched, mask),
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


def assert_same(compute: Callable[..., Any], *arrays: Array) -> None:
    """The result is the same in every layout; inputs are neither written nor part of the result."""
    given = [array.copy() for array in arrays]
    expected = flat(compute(*given))
    for array, copy in zip(arrays, given, strict=True):
        assert np.array_equal(array, copy)
        assert not any(isinstance(part, np.ndarray) and np.shares_memory(part, copy) for part in expected)
    for layout in LAYOUTS.values():
        arranged = [layout(array) for array in arrays]
        for array in arranged:
            array.flags.writeable = False
        for part, other in zip(expected, flat(compute(*arranged)), strict=True):
            np.testing.assert_array_equal(other, part)


@pytest.mark.parametrize("name", PICTURES)
def test_pictures_may_have_any_layout_and_are_not_written(name: str) -> None:
    assert_same(PICTURES[name], PLAIN.reference, PLAIN.touched)


@pytest.mark.parametrize("name", MASKS)
def test_masks_may_have_any_layout_and_are_not_written(name: str) -> None:
    assert_same(MASKS[name], PLAIN.mask)
