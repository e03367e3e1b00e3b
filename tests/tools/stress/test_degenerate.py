"""Pictures and markers that no sensor should give: a defined answer, or an error that says what to do."""

from __future__ import annotations

import warnings
from contextlib import suppress

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

import tactflow
from tactflow.drawing.results import Annotator
from tactflow.engine.conformance import component
from tactflow.engine.contract import Stage
from tactflow.engine.errors import TactflowError
from tactflow.ports import Deviations, Image
from tactflow.tools.stress.degenerate import require_defined, try_pictures
from tactflow.tools.stress.inputs import gel
from tactflow.tools.stress.parts import Worst
from tactflow.vision.flow import flow_in_mask
from tactflow.vision.markers.detection import NoMarkersError, detect_markers
from tactflow.vision.types import Markers
from tests.tools.stress.methods import PICTURE_METHODS, detector

HEIGHT, WIDTH = 60, 80


class Broken(Stage):
    """A stage with every mistake, one for each level of grey."""

    memory = "pure"

    def process(self, image: Image) -> Deviations:
        level = int(image[0, 0, 0])
        if level == 1:
            raise ZeroDivisionError("no light")
        if level == 2:
            warnings.warn("dim", RuntimeWarning, stacklevel=1)
        if level == 3:
            raise ValueError("required light, got none")
        cells = np.zeros((2, 3, 3), np.float64 if level == 4 else np.float32)
        cells[0, 0, 0] = np.nan if level == 5 else 1
        return cells


@pytest.mark.parametrize(
    ("level", "broken"),
    [
        *((0, set()), (1, {"exceptions"}), (2, {"exceptions"}), (3, set())),
        *((4, {"undefined"}), (5, {"undefined"})),
    ],
)
def test_mistakes_of_a_stage_are_found_and_a_refusal_in_words_is_none(level: int, broken: set[str]) -> None:
    worst = Worst("broken")
    pictures = [np.full((4, 4, 3), level, np.uint8)]
    try_pictures([component(Broken, "broken", "a test", ())], {"broken": worst}, "grey", pictures)
    assert {check.promise for check in worst.checks() if not check.kept} == broken


ANY_PICTURE = arrays.arrays(np.uint8, st.tuples(st.integers(1, 20), st.integers(1, 20), st.just(3)))


@settings(max_examples=60, derandomize=True, deadline=None, database=None)
@given(ANY_PICTURE, st.data())
def test_any_pair_of_pictures_has_a_mask_and_marks_within_it_or_none(
    reference: Image, data: st.DataObject
) -> None:
    contact = detector(reference)
    assert not contact.detect(reference).touching
    result = contact.detect(data.draw(arrays.arrays(np.uint8, reference.shape)))
    require_defined(result.strength)
    assert result.mask.shape == reference.shape[:2]
    assert set(np.unique(result.mask).tolist()) <= {0, 255}
    with suppress(NoMarkersError):
        centers = detect_markers(reference).centers
        assert (centers > -1).all()
        assert (centers < reference.shape[1::-1]).all()


@pytest.mark.parametrize("method", ["inpaint-normalized", "difference", "tracker"])
def test_frames_of_two_megapixels_have_an_answer(method: str) -> None:
    large = []
    for picture in (gel().reference, gel().touched):
        once = cv2.resize(picture, None, fx=4, fy=4, interpolation=cv2.INTER_LINEAR)
        large.append(np.full((1080, 1920, 3), 120, np.uint8))
        large[-1][250 : 250 + once.shape[0], 450 : 450 + once.shape[1]] = once
    answer = PICTURE_METHODS[method](*large)
    require_defined(answer)
    if isinstance(answer, Markers):
        # Marks move by up to 4 * 2.5 px.
        assert len(answer.origin) == 24
        assert 7.5 < np.abs(answer.displacement).max() < 11
    else:
        assert answer.shape[:2] == (1080, 1920)


def test_markers_far_outside_the_picture_have_a_defined_flow_and_are_drawn() -> None:
    at = np.array([[-500, 1e9], [40, 30], [1e300, 0]])
    markers = Markers(at, at + 1, np.zeros(3, np.uint8), np.full(3, np.nan))
    require_defined(flow_in_mask(markers, np.full((HEIGHT, WIDTH), 255, np.uint8)))
    near = Markers(np.clip(at, -1e7, 1e7), np.clip(at, -1e7, 1e7) + 1, markers.status, markers.stderr)
    assert Annotator()(np.zeros((HEIGHT, WIDTH, 3), np.uint8), markers=near).shape == (HEIGHT, WIDTH, 3)


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (3, 5), (37, 51)], ids=str)
@pytest.mark.parametrize("name", ["default", "classic", "markerless"])
def test_tiny_and_odd_frames_end_in_an_answer_or_in_words(name: str, shape: tuple[int, int]) -> None:
    frames = list(np.random.default_rng(0).integers(0, 256, (4, *shape, 3), dtype=np.uint8))
    try:
        found = list(tactflow.stream(name, source=frames, images=True))
    except TactflowError as error:
        assert "required" in str(error) or "markers found" in str(error)  # noqa: PT017
        return
    for result in found:
        require_defined([result.image, result.contact, result.flow, result.markers])


def test_a_detector_ends_every_one_of_many_contacts() -> None:
    pictures = gel(dots=False, noise=0.0)
    random = np.random.default_rng(0)

    def noisy(picture: Image) -> Image:
        return np.clip(np.rint(picture + random.normal(0, 1, picture.shape)), 0, 255).astype(np.uint8)

    contact = detector(noisy(pictures.reference))
    for _ in range(60):
        assert contact.detect(noisy(pictures.touched)).touching
        assert not contact.detect(noisy(pictures.reference)).touching
