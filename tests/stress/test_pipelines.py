"""Whole pipelines over degenerate recordings: a defined answer, or a clear refusal."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import tactflow
from tactflow.engine.errors import TactflowError
from tactflow.message.result import Result
from tests.stress.builders import Image, assert_defined, gel

PIPELINES = ("default", "classic", "markerless")
PLAIN = {"stages.preprocess.rotate": 0, "stages.preprocess.downsample": 2}


def results(name: str, frames: list[Image] | Path, settings: Mapping[str, Any] | None = None) -> list[Result]:
    """Run a packaged pipeline on these frames, or on a folder of them."""
    return list(tactflow.stream(name, source=frames, settings=settings, images=True))


def raw(picture: Image) -> Image:
    """A frame of which `downsample: 2` gives the picture."""
    return picture.repeat(2, axis=0).repeat(2, axis=1)


def parts(result: Result) -> list[object]:
    return [p for p in (result.image, result.contact, result.flow, result.markers) if p is not None]


@pytest.mark.parametrize("turn", [90, 180])
def test_rotating_in_preprocess_equals_rotating_the_sensor(turn: int) -> None:
    pictures = [gel().reference, gel().touched, gel().touched]
    turned = [raw(np.rot90(picture, -turn // 90)) for picture in pictures]
    by_stage = results("default", list(map(raw, pictures)), {**PLAIN, "stages.preprocess.rotate": turn})
    by_hand = results("default", turned, PLAIN)
    assert by_hand[-1].contact is not None
    for a, b in zip(by_stage, by_hand, strict=True):
        assert a.markers is not None
        assert b.markers is not None
        assert np.array_equal(np.asarray(a.image), np.asarray(b.image))
        assert np.array_equal(a.markers.position, b.markers.position)
        assert (a.contact is None) == (b.contact is None)
        assert a.contact is None or a.contact.center == b.contact.center  # type: ignore[union-attr]


STILL = {
    "black": np.zeros((60, 80, 3), np.uint8),
    "white": np.full((60, 80, 3), 255, np.uint8),
    "checkerboard": raw(np.tile(np.array([[0, 255], [255, 0]], np.uint8)[..., None], (15, 20, 3))),
}


@pytest.mark.parametrize("kind", STILL)
@pytest.mark.parametrize("name", PIPELINES)
def test_a_still_degenerate_scene_is_no_contact_or_a_clear_refusal(name: str, kind: str) -> None:
    try:
        found = results(name, [STILL[kind]] * 12)
    except TactflowError as error:
        assert name != "markerless"
        assert "markers found" in str(error)  # noqa: PT017
        return
    assert len(found) == 12
    for result in found:
        assert_defined(parts(result))
        assert result.contact is None


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (3, 5), (37, 51)], ids=str)
@pytest.mark.parametrize("name", PIPELINES)
def test_tiny_and_odd_frames_end_in_an_answer_or_in_words(name: str, shape: tuple[int, int]) -> None:
    frames = list(np.random.default_rng(0).integers(0, 256, (4, *shape, 3), dtype=np.uint8))
    try:
        found = results(name, frames)
    except TactflowError as error:
        assert "required" in str(error) or "markers found" in str(error)  # noqa: PT017
        return
    for result in found:
        assert_defined(parts(result))


@pytest.mark.parametrize("name", ["default", "markerless"])
def test_the_same_frame_for_ever_is_never_contact_and_never_moves(name: str) -> None:
    found = results(name, [raw(gel(dots=name == "default").reference)] * 90, PLAIN)
    assert len(found) == 90
    assert all(result.contact is None for result in found)
    if name == "default":
        positions = [result.markers.position for result in found if result.markers is not None]
        assert all(np.array_equal(position, positions[0]) for position in positions)
