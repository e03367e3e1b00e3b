"""What is no picture of the gel is never the reference, and never a contact."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

import tactflow
from tactflow import Result

Picture = NDArray[np.uint8]

SCENE = tactflow.open_scene("unmarked?frames=60")
FRAMES = [SCENE.frame(index)[::2, ::2].copy() for index in range(24)]
"""A press begins in frame 7."""
TOUCHED = [SCENE.truth(index).touching for index in range(24)]
SHAPE = FRAMES[0].shape
BLACK = np.zeros(SHAPE, np.uint8)
GREEN = np.full(SHAPE, (0, 135, 0), np.uint8)
ELSEWHERE = tactflow.open_scene("stray?frames=60&seed=3").frame(20)[::2, ::2].copy()
"""A picture of another session."""
HALF = FRAMES[1].copy()
HALF[150:] = 128
SETTINGS: Mapping[str, Any] = {"stages.preprocess": {"rotate": 0, "downsample": 1}}


def results(frames: Sequence[Picture], pipeline: str = "markerless", **settings: Any) -> list[Result]:
    """The results of a pipeline without sinks."""
    return list(tactflow.stream(pipeline, source=list(frames), settings={**SETTINGS, **settings}))


def touches(found: Sequence[Result]) -> list[bool]:
    """Whether each frame has a contact."""
    return [result.contact is not None for result in found]


ALONE = touches(results(FRAMES))
LEADS = {
    "a black picture": [BLACK],
    "three black pictures": [BLACK] * 3,
    "three green pictures": [GREEN] * 3,
    "three times a picture of another session": [ELSEWHERE] * 3,
    "three times a picture of an earlier contact": [FRAMES[15]] * 3,
    "half a picture": [HALF],
}


@pytest.mark.parametrize("settle", [0, 3])
@pytest.mark.parametrize("lead", [name for name in LEADS if "another" not in name])
def test_the_first_picture_of_the_gel_is_the_reference(
    lead: str, settle: float, caplog: pytest.LogCaptureFixture
) -> None:
    before = LEADS[lead]
    if settle == 0 and not ("black" in lead or "green" in lead):
        pytest.skip("settle: 0 takes the first picture that shows anything")
    with caplog.at_level(logging.INFO, "tactflow"):
        found = results([*before, *FRAMES], **{"stages.capture.settle": settle})
    assert touches(found) == [False] * len(before) + ALONE
    assert {result.skipped["contact"] for result in found[: len(before)]} == {"damaged"}
    assert sum("the reference is frame" in message for message in caplog.messages) == 1


def test_a_gel_seen_at_another_session_is_not_the_reference() -> None:
    found = results([*LEADS["three times a picture of another session"], *FRAMES])
    assert touches(found) == [False] * 3 + ALONE


def test_dots_are_found_after_black_pictures() -> None:
    scene = tactflow.open_scene("press?frames=60")
    frames = [scene.frame(index) for index in range(12)]
    found = results(
        [np.zeros_like(frames[0])] * 3 + frames, "default", **{"stages.preprocess": {"rotate": 0}}
    )
    assert [len(result.markers.position) for result in found if result.markers][-1] == 80


def test_a_film_of_compressed_black_pictures_before_the_gel(tmp_path: Path) -> None:
    film = cv2.VideoWriter(str(tmp_path / "film.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 30, SHAPE[1::-1])
    for frame in [BLACK] * 3 + FRAMES:
        film.write(frame)
    film.release()
    found = list(tactflow.stream("markerless", source=str(tmp_path / "film.avi"), settings=SETTINGS))
    assert touches(found)[:9] == [False] * 9
    assert all(touches(found)[-8:])


@pytest.mark.parametrize("damage", ["half", "noise", "black"])
@pytest.mark.parametrize("place", [4, 18])
@pytest.mark.parametrize("skipping", [True, False])
def test_the_last_values_hold_for_a_damaged_picture(damage: str, place: int, skipping: bool) -> None:
    noise = np.random.default_rng(1).integers(0, 256, SHAPE, np.uint8)
    bad = {"half": HALF, "noise": noise, "black": BLACK}[damage]
    found = results([*FRAMES[:place], bad, *FRAMES[place:]], skipping=skipping)
    before, now = found[place - 1], found[place]
    assert now.skipped["contact"] == "damaged"
    assert (now.contact is None) == (before.contact is None)
    if before.contact is not None and now.contact is not None:
        assert now.contact.area == before.contact.area
        np.testing.assert_array_equal(now.contact.hull, before.contact.hull)
    assert now.frame.damaged
    assert touches(found[:place] + found[place + 1 :]) == ALONE


def test_damaged_pictures_are_counted_in_the_statistics() -> None:
    pipeline = tactflow.load("markerless", source=[*FRAMES[:5], HALF, *FRAMES[5:]], settings=SETTINGS)
    stats = tactflow.run(pipeline).stats
    assert stats["stages"]["capture"]["skips"] == {"damaged": 1}
    assert stats["stages"]["difference"]["skips"]["damaged"] == 1
    assert stats["frames"] == 25


def test_damaged_pictures_are_processed_on_request() -> None:
    found = results([*FRAMES[:5], HALF, *FRAMES[5:]], **{"stages.capture.skip_damaged": False})
    assert found[5].contact is not None


def test_a_tap_of_one_frame_stays_a_tap() -> None:
    scene = tactflow.open_scene("tap?frames=60&markers=none")
    frames = [scene.frame(index)[::2, ::2].copy() for index in range(60)]
    found = results(frames)
    assert touches(found) == [scene.truth(index).touching for index in range(60)]


def test_a_recording_without_any_gel_runs_and_says_so(caplog: pytest.LogCaptureFixture) -> None:
    found = results([GREEN] * 6)
    assert touches(found) == [False] * 6
    assert any("black or uniform" in message for message in caplog.messages)
    assert any("all 6 pictures are the same" in message for message in caplog.messages)


def test_drawn_pictures_without_noise_are_taken_as_they_are() -> None:
    clean = tactflow.open_scene("unmarked?frames=60&noise=0")
    frames = [clean.frame(index)[::2, ::2].copy() for index in itertools.chain([0] * 6, range(5, 20))]
    found = results(frames)
    assert touches(found)[:6] == [False] * 6
    assert touches(found)[-1]
    assert "damaged" not in {result.skipped.get("contact") for result in found}


def test_a_uniform_picture_is_refused_as_the_reference(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "black.png"), BLACK)
    with pytest.raises(tactflow.TactflowError, match="black or uniform"):
        results(FRAMES, **{"stages.capture.reference": str(tmp_path / "black.png")})
