"""The video sink: what was drawn can be watched, or compared bit by bit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import ValidationError

from tactflow.engine.errors import StageError
from tactflow.engine.frame import Frame, Tick
from tactflow.sinks.video import Video

Pixels = NDArray[np.uint8]


def pictures(count: int, height: int = 48, width: int = 64) -> list[Pixels]:
    """Noise: detail in every channel and pixel."""
    return list(np.random.default_rng(1).integers(0, 256, (count, height, width, 3), np.uint8))


def film(path: Path, shown: list[Pixels], step: float = 0.05, **params: Any) -> Video:
    sink = Video(Video.Params(path=str(path), **params))
    sink.open()
    try:
        for index, picture in enumerate(shown):
            sink.write(Tick(Frame("main", index, 1e9 + index * step, picture)), picture)
    finally:
        sink.close()
    return sink


def play(path: Path) -> tuple[list[Pixels], float]:
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    frames = []
    while (item := capture.read())[0]:
        frames.append(np.asarray(item[1], np.uint8))
    fps = capture.get(cv2.CAP_PROP_FPS)
    capture.release()
    return frames, fps


@pytest.mark.parametrize(
    ("suffix", "count"), [(".avi", 30), (".mkv", 5), (".mp4", 30), (".m4v", 1), (".mov", 5), (".AVI", 1)]
)
def test_every_frame_is_in_the_film(suffix: str, count: int, tmp_path: Path) -> None:
    path = tmp_path / "new" / f"film{suffix}"
    levels = np.linspace(20, 235, count).astype(np.uint8)
    sink = film(path, [np.full((48, 64, 3), level, np.uint8) for level in levels])
    frames, _ = play(path)
    assert len(frames) == count
    assert sink.counters() == {"frames": count}
    # 6 grey levels: lossy codecs in 8-bit YUV of limited range; measured 3 for MPEG-4, 2 for MJPG.
    np.testing.assert_allclose([frame.mean() for frame in frames], levels, atol=6)
    assert [entry.name for entry in path.parent.iterdir()] == [path.name], "nothing else may be left there"


def test_odd_sizes_lose_no_row_and_no_column(tmp_path: Path) -> None:
    picture = np.zeros((47, 63, 3), np.uint8)
    picture[46] = picture[:, 62] = 200
    film(tmp_path / "film.avi", [picture] * 3)
    [frame, *_] = play(tmp_path / "film.avi")[0]
    assert frame.shape == (48, 64, 3)
    # Row 46 and column 62, the last ones, are bright: half of 200 tells them from dark ones after JPEG.
    assert frame[46, :40].mean() > 100
    assert frame[:40, 62].mean() > 100


@pytest.mark.parametrize(("step", "fps"), [(0.05, 20.0), (1 / 60, 60.0), (0.5, 2.0)])
def test_a_film_plays_at_the_pace_of_its_capture(step: float, fps: float, tmp_path: Path) -> None:
    film(tmp_path / "film.avi", pictures(15), step=step)
    # 0.01 %: times near 1e9 s have a resolution of 1e-7 s, and the file stores the rate as a fraction.
    assert play(tmp_path / "film.avi")[1] == pytest.approx(fps, rel=1e-4)


def test_the_pace_can_be_given(tmp_path: Path) -> None:
    film(tmp_path / "film.avi", pictures(3), fps=7.5)
    assert play(tmp_path / "film.avi")[1] == pytest.approx(7.5)


def test_without_any_frame_there_is_no_file(tmp_path: Path) -> None:
    film(tmp_path / "film.avi", [])
    assert list(tmp_path.iterdir()) == []


def test_a_picture_of_another_size_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(StageError, match="64 x 48, but this frame is 62 x 48"):
        film(tmp_path / "film.avi", [*pictures(2), *pictures(1, 48, 62)])


@pytest.mark.parametrize("name", ["film", "film.gif"])
def test_another_extension_is_refused(name: str) -> None:
    with pytest.raises(ValidationError, match="required a path that ends in"):
        Video.Params(path=name)
