"""Dirt that lands on the lens is no contact where lamps have different colours."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.sim import open_scene
from tactflow.tools.stress.perturbation import specks
from tactflow.vision.contact import ContactDetector, ContactResult
from tactflow.vision.contact.dirt import attenuated_cells, light_directions
from tactflow.vision.geometry import Preprocessor

Image = NDArray[np.uint8]
DEEP = 60
"""A frame of the scenes with a deep contact."""


def _frames(scene: str) -> tuple[Image, Image]:
    """The untouched gel, and a deep press on it."""
    opened = open_scene(scene)
    small = Preprocessor(opened.size, downsample=2)
    untouched, touched = (np.ascontiguousarray(small(opened.frame(index))) for index in (0, DEEP))
    return untouched, touched


def _dirty(image: Image, count: int = 5, seed: int = 1) -> Image:
    passes = specks(image.shape, count, np.random.default_rng(seed))
    return np.rint(image * passes[..., None]).astype(np.uint8)


def _found(untouched: Image, *frames: Image) -> ContactResult:
    """The contact of the last frame."""
    detector = ContactDetector()
    detector.add_reference(untouched)
    return [detector.detect(frame) for frame in frames][-1]


def test_specks_on_the_lens_are_no_contact() -> None:
    untouched, _ = _frames("unmarked")
    dirty = _dirty(untouched)
    assert np.abs(dirty.astype(int) - untouched).max() > 50
    assert not _found(untouched, dirty, dirty, dirty).touching


@pytest.mark.parametrize("strength", [1.0, 0.25])
def test_specks_do_not_move_the_contact_beside_them(strength: float) -> None:
    # A strong contact raises the threshold of later ones for a while; the specks that came before do not.
    untouched, touched = _frames("unmarked")
    pressed = np.rint(untouched + strength * (touched.astype(float) - untouched)).astype(np.uint8)
    clean = _found(untouched, pressed).mask
    dirty = _found(untouched, *[_dirty(untouched, 30)] * 5, _dirty(pressed, 30)).mask
    centers = [np.argwhere(mask > 0).mean(axis=0) for mask in (clean, dirty)]
    assert np.hypot(*(centers[1] - centers[0])) < 1
    assert np.count_nonzero(clean & dirty) > 0.9 * np.count_nonzero(clean | dirty)


def test_a_contact_that_darkens_a_gel_in_white_light_is_found() -> None:
    gel = np.full((120, 160, 3), 150, np.uint8)
    darker = gel.copy()
    cv2.circle(darker, (80, 60), 20, (90, 90, 90), -1)
    assert _found(gel, cv2.GaussianBlur(darker, (0, 0), 4.0)).touching


@pytest.mark.parametrize(
    ("change", "is_dirt"), [((-30, -40, -50), True), ((30, 40, 50), False), ((-50, 0, 0), False)]
)
def test_only_a_loss_of_light_in_proportion_is_dirt(change: tuple[int, ...], is_dirt: bool) -> None:
    light = np.ones((3, 12, 12), np.float32) * np.array([30, 40, 50], np.float32)[:, None, None]
    light[:, :, 6:] = np.array([50, 40, 30], np.float32)[:, None, None]
    colours = light_directions(light, None)
    assert colours is not None
    changed = np.zeros((12, 12), bool)
    changed[4:8, 1:4] = True
    signed = changed * np.array(change, np.float32)[:, None, None]
    found = attenuated_cells(signed, colours, changed)
    assert (found is not None) == is_dirt
    assert found is None or found[changed].all()


def test_a_gel_without_light_has_no_colours() -> None:
    assert light_directions(np.ones((3, 4, 5), np.float32), np.zeros((4, 5), np.bool_)) is None
