"""The network on simulated gels, and what its detector refuses."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.wide import wide_scene
from tactflow.bench.metrics import mask_iou
from tactflow.sim import open_scene
from tactflow.vision.contact import LearnedDetector
from tactflow.vision.geometry import Preprocessor

Image = NDArray[np.uint8]


def _detector(reference: Image, **options: Any) -> LearnedDetector:
    detector = LearnedDetector(**options)
    detector.add_reference(reference)
    return detector


@pytest.mark.parametrize("name", ["press", "bright", "mixed", "cable", "edge", "box"])
def test_the_region_overlaps_the_true_one(name: str) -> None:
    scene = open_scene(f"{name}?frames=60&markers=0x0")
    half = Preprocessor((800, 600), downsample=2)
    detector = _detector(half(scene.frame(0)))
    assert not detector.detect(half(scene.frame(1))).touching
    truth = scene.truth(30, half.mapping).contact_mask
    assert mask_iou(detector.detect(half(scene.frame(30))).mask, truth) > 0.4


def test_most_contacts_of_random_scenes_are_found_and_few_where_there_are_none() -> None:
    """On scenes that the network was not trained on, many of which are too faint for any method."""
    found: dict[bool, list[bool]] = {True: [], False: []}
    for seed in range(5_000_000, 5_000_080):
        scene = wide_scene(seed)
        if not len(scene.origin):
            result = _detector(scene.reference).detect(scene.picture)
            found[bool(scene.contact.any())].append(result.touching)
    assert np.mean(found[True]) > 0.4
    assert np.mean(found[False]) < 0.15


def test_exposure_is_no_contact() -> None:
    scene = open_scene("unmarked?frames=60")
    reference = scene.frame(0)
    darker = np.rint(scene.frame(1) * 0.9).astype(np.uint8)
    assert not _detector(reference).detect(darker).touching


def test_a_contact_ends_when_the_gel_is_released() -> None:
    scene = open_scene("unmarked?frames=60")
    detector = _detector(scene.frame(0))
    assert detector.detect(scene.frame(25)).touching
    assert not detector.detect(scene.frame(1)).touching


def test_what_is_left_of_a_strong_contact_is_not_a_new_one() -> None:
    scene = open_scene("unmarked?frames=60")
    reference, pressed = (scene.frame(index).astype(float) for index in (0, 25))
    rest = np.rint(reference + 0.15 * (pressed - reference)).astype(np.uint8)
    fresh = _detector(scene.frame(0), certainty=0.5)
    assert fresh.detect(rest).touching
    creeping = _detector(scene.frame(0), certainty=0.5)
    assert creeping.detect(scene.frame(25)).touching
    assert not creeping.detect(scene.frame(0)).touching
    assert not creeping.detect(rest).touching


def test_nothing_outside_of_the_valid_area_is_contact() -> None:
    scene = open_scene("unmarked?frames=60")
    detector = LearnedDetector()
    detector.add_reference(scene.frame(0), np.zeros((600, 800), np.uint8))
    assert not detector.detect(scene.frame(25)).touching


def test_the_same_frames_give_the_same_masks() -> None:
    scene = open_scene("unmarked?frames=60")
    masks = [_detector(scene.frame(0)).detect(scene.frame(25)).mask for _ in range(2)]
    assert masks[0].any()
    assert np.array_equal(*masks)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"certainty": 0.3}, "certainty"),
        ({"certainty": 1.0}, "certainty"),
        ({"relaxation": 1.0}, "relaxation"),
    ],
)
def test_a_parameter_out_of_its_range_is_refused(options: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=f"{message}: required"):
        LearnedDetector(**options)


def test_wrong_pictures_are_refused() -> None:
    gel = np.full((48, 64, 3), 120, np.uint8)
    with pytest.raises(ValueError, match="reference frame first"):
        LearnedDetector().detect(gel)
    detector = _detector(gel)
    for picture in (gel[:40], gel[..., 0], gel.astype(np.float32), gel[:0]):
        with pytest.raises(ValueError, match="required"):
            detector.detect(picture)
    with pytest.raises(ValueError, match="required"):
        detector.detect(gel, gel[..., :2])
