"""The law of skipping: an observer never changes values, and neither does leaving out work."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

import tactflow
from lab.skipping import differing
from tactflow import Result

FRAMES = 60
Frames = NDArray[np.uint8]


@lru_cache(maxsize=4)
def scene(name: str) -> Frames:
    """Its frames, (FRAMES, 300, 400, 3), after ten at rest."""
    opened = tactflow.open_scene(f"{name}?frames={FRAMES}")
    first = opened.frame(0)
    random = np.random.default_rng(0)
    still = [first.astype(np.float32) + random.normal(0, 2, first.shape) for _ in range(10)]
    frames = [*still, *(opened.frame(index) for index in range(FRAMES))]
    small = [
        cv2.resize(np.asarray(frame, np.float32), (400, 300), interpolation=cv2.INTER_AREA)
        for frame in frames
    ]
    return np.clip(np.rint(small), 0, 255).astype(np.uint8)


def each(
    change: Callable[[NDArray[np.float32], int], NDArray[np.float32]],
) -> Callable[[Frames, Path], Frames]:
    """A trouble that changes each frame, which is given in grey levels with its index."""

    def trouble(frames: Frames, _: Path) -> Frames:
        changed = [change(frame.astype(np.float32), index) for index, frame in enumerate(frames)]
        return np.clip(np.rint(changed), 0, 255).astype(np.uint8)

    return trouble


def jpeg(quality: int) -> Callable[[Frames, Path], Frames]:
    """Motion JPEG: each frame by itself."""

    def trouble(frames: Frames, _: Path) -> Frames:
        coded = [cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, quality])[1] for frame in frames]
        return np.stack([cv2.imdecode(data, cv2.IMREAD_COLOR) for data in coded]).astype(np.uint8)

    return trouble


def video(frames: Frames, folder: Path) -> Frames:
    """Frames as differences to those before, as MPEG-4 and H.264 store them."""
    path = str(folder / "coded.mp4")
    writer = cv2.VideoWriter(path, cv2.VideoWriter.fourcc(*"mp4v"), 30.0, frames.shape[2:0:-1])
    for frame in frames:
        writer.write(frame)
    writer.release()
    reader = cv2.VideoCapture(path)
    return np.stack([reader.read()[1] for _ in frames]).astype(np.uint8)


def rolling(frame: NDArray[np.float32], index: int) -> NDArray[np.float32]:
    rows = np.sin(2 * np.pi * (np.arange(len(frame)) / 150 + index / 5))
    return frame * (1 + 0.01 * rows[:, None, None]).astype(np.float32)


def dirty(frame: NDArray[np.float32], index: int) -> NDArray[np.float32]:
    return frame if index < 6 else cv2.circle(frame, (60, 60), 4, (40, 40, 40), -1)


def dragged(frame: NDArray[np.float32], index: int) -> NDArray[np.float32]:
    step = np.float32([[1, 0, 0.02 * index], [0, 1, 0]])
    return cv2.warpAffine(
        frame, step, frame.shape[1::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
    )


def tapped(frames: Frames, _: Path) -> Frames:
    """Nothing but one frame of the deepest contact, and a second one later."""
    still, tap = frames[:10], frames[10 + FRAMES // 2]
    parts = [*still, *still, tap, *still, tap, *still]
    return np.stack(parts)


TROUBLES: dict[str, Callable[[Frames, Path], Frames]] = {
    "none": lambda frames, _: frames,
    **{f"jpeg {quality}": jpeg(quality) for quality in (30, 60, 90)},
    "video": video,
    "flicker": each(lambda frame, index: frame * np.float32(1 + 0.02 * np.sin(index * 2 * np.pi / 5))),
    "fading lamps": each(lambda frame, index: frame * np.float32(1 - 0.004 * index)),
    "auto exposure": each(lambda frame, index: frame * np.float32(1 - 0.05 * (index // 8 % 3))),
    "warming up": each(lambda frame, index: frame + np.float32([0.03, 0, -0.03]) * index),
    "bands": each(rolling),
    "dirt": each(dirty),
    "drag": each(dragged),
    "twice": lambda frames, _: frames.repeat(2, axis=0),
    "taps": tapped,
}


def run(pipeline: str, frames: Frames, **settings: object) -> list[Result]:
    upright = {"stages.preprocess.rotate": 0, "stages.preprocess.downsample": 1}
    return list(tactflow.stream(pipeline, source=frames, settings=upright | settings))


def assert_law(pipeline: str, frames: Frames) -> list[Result]:
    """Nothing may differ for more than one frame; returns the results with skipping."""
    skipping, fresh = (run(pipeline, frames, skipping=on) for on in (True, False))
    assert [result.seq for result in skipping] == [result.seq for result in fresh] == list(range(len(frames)))
    assert not any({"unchanged", "at_rest"} & set(result.skipped.values()) for result in fresh)
    before: set[str] = set()
    for one, other in zip(skipping, fresh, strict=True):
        differ = differing(one, other)
        assert not differ & before, f"frame {one.seq}"
        before = differ
    return skipping


@pytest.mark.parametrize("trouble", TROUBLES)
def test_a_result_differs_from_a_fresh_one_by_no_more_than_its_tolerance(
    trouble: str, tmp_path: Path
) -> None:
    results = assert_law("default", TROUBLES[trouble](scene("press"), tmp_path))
    assert sum("at_rest" in result.skipped.values() for result in results[1:10]) >= 5


@pytest.mark.parametrize(
    ("pipeline", "name"),
    [("default", "creep"), ("default", "slide"), ("markerless", "unmarked"), ("mini_plain", "unmarked")],
)
def test_so_it_is_in_other_scenes_and_pipelines(pipeline: str, name: str) -> None:
    assert_law(pipeline, scene(name))


@pytest.mark.parametrize(("pipeline", "name"), [("default", "press"), ("markerless", "unmarked")])
def test_most_of_a_rest_is_left_out_and_every_frame_says_so(pipeline: str, name: str) -> None:
    frames = scene(name)[np.arange(40) % 10]
    results = assert_law(pipeline, frames)
    assert sum("at_rest" in result.skipped.values() for result in results) >= 0.85 * 35
    assert all(result.contact is None for result in results)
