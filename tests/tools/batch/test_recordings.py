"""Words of a command line become recordings, or a mistake that says what to do."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from tactflow.engine.errors import ConfigError
from tactflow.tools.batch.recordings import find_recordings


@pytest.fixture
def data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name in ("b/press-10.npy", "b/press-2.npy", "a/press-2.npy", "a/notes.md", "pictures/1.png", "x.dat"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    monkeypatch.chdir(tmp_path)
    return tmp_path


def names(*words: str) -> list[str]:
    return [recording.name for recording in find_recordings(words)]


def test_a_folder_is_searched_and_one_of_pictures_is_a_recording(data: Path) -> None:
    found = find_recordings([str(data)])
    assert [recording.name for recording in found] == [
        "a/press-2.npy",
        "b/press-2.npy",
        "b/press-10.npy",
        "pictures",
    ]
    assert all(Path(recording.source).is_absolute() for recording in found)


def test_a_pattern_names_its_matches_and_pictures_are_one_recording(data: Path) -> None:
    assert names("*/press-2.npy") == ["a/press-2.npy", "b/press-2.npy"]
    (one,) = find_recordings(["pictures/*.png"])
    assert one.source.endswith("pictures/*.png")
    assert one.path == data / "pictures"


def test_options_behind_a_pattern_hold_for_all_that_match(data: Path) -> None:
    found = find_recordings(["b/*.npy?fps=30"])
    assert [recording.source for recording in found] == [
        f"{data}/b/press-{number}.npy?fps=30" for number in (2, 10)
    ]
    assert names("b/p*-?.npy") == ["press-2.npy"]
    assert names("b/press-2.npy?topic=/gel") == ["press-2.npy?topic=/gel"]
    assert names("lerobot:a?episode=1", "b/press-2.npy")[0] == f"lerobot:{data / 'a'}?episode=1"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["b/press-3.npy"], "did you mean b/press-2.npy"),
        (["nothing/*.mp4"], "no file matches"),
        (["a/empty"], "this folder contains no recordings"),
        (["0"], "is a live source"),
        (["rtsp://camera/1"], "is a live source"),
        (["pictures/1.png"], "name its folder"),
    ],
)
def test_words_that_name_no_recording_are_rejected(data: Path, words: list[str], message: str) -> None:
    (data / "a" / "empty").mkdir()
    with pytest.raises(ConfigError, match=message):
        find_recordings(words)


def test_all_mistakes_are_reported_at_once(data: Path) -> None:
    (data / "empty").mkdir()
    with pytest.raises(ConfigError) as raised:
        find_recordings(["no.npy", "none.npy", "empty"])
    assert len(raised.value.mistakes) == 3


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such names")
def test_a_file_may_be_named_like_a_pattern_or_as_if_options_followed(data: Path) -> None:
    for name in ("c[1].npy", "c*.npy", "c?fps=3.npy"):
        (data / "c" / name).parent.mkdir(exist_ok=True)
        (data / "c" / name).touch()
        assert find_recordings([f"c/{name}"])[0].path == data / "c" / name
    assert {recording.path for recording in find_recordings(["c"])} == set((data / "c").iterdir())


@pytest.mark.skipif(sys.platform != "linux", reason="file names are bytes on Linux alone")
def test_a_name_that_no_table_can_hold_is_refused(data: Path) -> None:
    Path(os.fsdecode(bytes(data / "a") + b"/\xff.npy")).touch()
    with pytest.raises(ConfigError, match="not UTF-8; rename it"):
        find_recordings(["a"])
