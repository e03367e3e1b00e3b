"""`doctor` names what is wrong with a recording, and nothing else."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.sim import open_scene
from tactflow.sources import FrameReader
from tactflow.tools.doctor import examine, observe
from tests.terminal import Terminal
from tests.vision.dots import grid, render

Image = NDArray[np.uint8]
FRAMES = 24


@pytest.fixture(scope="module")
def clean() -> list[Image]:
    """A press and a rest, at half the size: dots of radius 5 px."""
    scene = open_scene("press?frames=120")
    pictures = [scene.frame(5 * index) for index in range(FRAMES)]
    return [np.asarray(cv2.resize(p, (400, 300), interpolation=cv2.INTER_AREA), np.uint8) for p in pictures]


def blurred(image: Image, _: int) -> Image:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 3.0), np.uint8)


def clipped(image: Image, _: int) -> Image:
    return np.asarray(cv2.convertScaleAbs(image, alpha=1.9), np.uint8)


def banded(image: Image, index: int) -> Image:
    rows = np.arange(len(image)) / len(image)
    gain = 1 + 0.05 * np.sin(2 * np.pi * (2 * rows - 0.37 * index))
    return np.asarray(np.rint(image * gain[:, None, None]), np.uint8)


def untouched(image: Image, _: int) -> Image:
    return image


def written(path: Path, frames: list[Image], fps: float) -> Path:
    """A lossless video."""
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"HFYU"), fps, (400, 300))
    for frame in frames:
        video.write(frame)
    video.release()
    return path


@pytest.mark.parametrize(
    ("fault", "fps", "name"),
    [
        (untouched, 60.0, None),
        (blurred, 60.0, "focus"),
        (clipped, 60.0, "clipping"),
        (banded, 60.0, "banding"),
        (untouched, 8.0, "rate"),
    ],
)
def test_each_fault_is_named_and_no_other(
    clean: list[Image], fault: Callable[[Image, int], Image], fps: float, name: str | None, tmp_path: Path
) -> None:
    frames = [fault(image, index) for index, image in enumerate(clean)]
    findings = examine(observe(str(written(tmp_path / "recording.avi", frames, fps)), 60.0))
    bad = [finding for finding in findings if finding.verdict in ("warning", "fault")]
    assert [finding.name for finding in bad] == ([] if name is None else [name])
    assert all(finding.effect and finding.advice for finding in bad)
    assert not [finding.name for finding in findings if finding.verdict == "unknown"]


@pytest.mark.parametrize(("shown", "found"), [(1, False), (FRAMES, True)])
def test_spots_in_no_regular_grid_are_dots_only_where_the_next_frame_shows_them(
    tmp_path: Path, shown: int, found: bool
) -> None:
    # What compression makes of a gel without dots may look like an irregular grid, for a frame.
    marked = render((400, 300), grid(8, 10, 34.0, corner=(30, 25), jitter=4.0), 4.6)
    plain = render((400, 300), np.zeros((0, 2)), 4.6)
    path = written(tmp_path / "r.avi", [marked] * shown + [plain] * (FRAMES - shown), 60.0)
    assert (observe(str(path), 10.0).dots is not None) == found


def test_missing_and_repeated_frames_of_a_camera_are_counted(
    clean: list[Image], monkeypatch: pytest.MonkeyPatch
) -> None:
    times = np.delete(np.arange(FRAMES + 4) / 30.0, [5, 6, 7, 20])
    frames = [clean[max(0, index - index % 4)] for index in range(FRAMES)]

    class Stuttering(FrameReader):
        live, fps = True, 30.0

        def _frames(self) -> Iterator[tuple[Image, float]]:
            return zip(frames, times, strict=True)

    monkeypatch.setattr("tactflow.tools.doctor.observation.open_source", lambda _: Stuttering("a camera"))
    found = {finding.name: finding for finding in examine(observe("0", 1.0))}
    assert found["drop-outs"].verdict == "fault"
    assert "4 of " in found["drop-outs"].says


def test_the_table_and_json_say_the_same_and_a_fault_has_exit_code_3(
    clean: list[Image], tmp_path: Path, terminal: Terminal
) -> None:
    for index, image in enumerate(clean[:4]):
        cv2.imwrite(str(tmp_path / f"{index}.png"), cv2.GaussianBlur(image, (0, 0), 6.0))
    assert terminal("doctor", "--source", str(tmp_path)) == 3
    table = terminal.out
    assert "FAULT  focus" in table
    assert "change: focus the lens" in table
    assert "?      rate         single pictures have no times" in table
    assert terminal("doctor", "--source", str(tmp_path), "--json") == 3
    report = json.loads(terminal.out)
    assert report["verdict"] == "fault"
    (focus,) = [check for check in report["checks"] if check["name"] == "focus"]
    assert (focus["verdict"], focus["unit"]) == ("fault", "px")
    assert focus["says"] in table
    assert report["versions"]["python"]
