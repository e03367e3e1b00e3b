"""Over many presses and releases nothing creeps."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import tactflow
from tactflow.sim import Truth
from tests.stress.builders import Image, detector, gel


def noisy(picture: Image, random: np.random.Generator) -> Image:
    return np.clip(np.rint(picture + random.normal(0, 1, picture.shape)), 0, 255).astype(np.uint8)


def test_a_detector_ends_every_one_of_many_contacts() -> None:
    pictures = gel(dots=False, noise=0.0)
    random = np.random.default_rng(0)
    contact = detector(noisy(pictures.reference, random))
    for _ in range(60):
        assert contact.detect(noisy(pictures.touched, random)).touching
        assert not contact.detect(noisy(pictures.reference, random)).touching


def test_the_marker_error_of_the_default_pipeline_does_not_grow(tmp_path: Path) -> None:
    cycle, presses, random = 40, 3, np.random.default_rng(0)
    scene = tactflow.open_scene(f"press?frames={cycle}&noise=0")
    pictures = [scene.frame(index) for index in range(cycle)]
    np.save(tmp_path / "frames.npy", [noisy(picture, random) for picture in pictures * presses])
    truths: list[Truth] = []
    errors = []
    for result in tactflow.stream(source=str(tmp_path / "frames.npy")):
        assert result.markers is not None
        truths = truths or [scene.truth(index, result["mapping"]) for index in range(cycle)]
        truth = truths[result.seq % cycle]
        away = np.hypot(*(result.markers.origin[:, None] - truth.origin[None]).transpose(2, 0, 1))
        wanted = (truth.position - truth.origin)[away.argmin(axis=1)]
        errors.append(float(np.sqrt(((result.markers.displacement - wanted) ** 2).sum(axis=1).mean())))
    # Measured 0.0076 px in the first and 0.0077 px in the last.
    of_presses = np.array(errors).reshape(presses, cycle).mean(axis=1)
    assert of_presses.max() < 0.01
    assert of_presses[-1] < 1.1 * of_presses[0]
