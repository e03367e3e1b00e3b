"""Recordings of others, tables and datasets when something is wrong: the rows of docs/bad-input.md."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="the extra bags is not installed")
pytest.importorskip("h5py", reason="the extra hdf5 is not installed")
pytest.importorskip("zarr", reason="the extra zarr is not installed")
pytest.importorskip("pyarrow", reason="the extra parquet is not installed")
pytest.importorskip("av", reason="the extra av is not installed")

from tactflow.cli.main import main
from tests.adapters.bags import TOPIC, write_bag
from tests.adapters.test_bags import pictures
from tests.adapters.test_datasets import KEY, write_hdf5, write_lerobot, write_zarr
from tests.conftest import REPOSITORY
from tests.faults.rig import array, run

PAGE = (REPOSITORY / "docs" / "bad-input.md").read_text()
IMAGES = np.stack(pictures(5))


class Row(NamedTuple):
    """What is tried, what is wrong with it, the exit code, and words of what is said.

    make : prepares it in an empty folder, and gives the source. without : a package that is missing.
    """

    part: str
    wrong: str
    exit: int
    said: str
    make: Callable[[Path], str]
    without: str = ""


def bag(folder: Path, kind: str = "sqlite3", encoding: str = "bgr8") -> Path:
    return write_bag(folder / ("press.bag" if kind == "ros1" else "press"), list(IMAGES), kind, encoding)


def one_file(folder: Path, kind: str) -> Path:
    """The only file of a rosbag2."""
    (file,) = bag(folder, kind).glob("*.db3" if kind == "sqlite3" else "*.mcap")
    return file


def cut(path: Path, share: float = 0.5) -> Path:
    os.truncate(path, round(path.stat().st_size * share))
    return path


def topic(path: Path, name: str = TOPIC) -> str:
    return f"{path}?topic={name}"


def overwritten(path: Path, what: bytes, by: bytes) -> Path:
    data = path.read_bytes()
    assert what in data
    path.write_bytes(data.replace(what, by))
    return path


def hdf5(folder: Path) -> Path:
    return write_hdf5(folder / "press.h5", frames=IMAGES, force=np.zeros((5, 3)))


def zarr(folder: Path) -> Path:
    return write_zarr(folder / "press.zarr", frames=IMAGES)


def damaged_zarr(folder: Path) -> Path:
    path = zarr(folder)
    for file in (path / "gel" / "frames" / "c").rglob("0"):
        if file.is_file():
            file.write_bytes(b"damaged")
    return path


def lerobot(folder: Path, dtype: str = "image") -> Path:
    return write_lerobot(folder / "press", np.zeros((5, 48, 64, 3), np.uint8), "v3.0", dtype)


def episode(root: Path) -> str:
    return f"lerobot:{root}?camera={KEY}&episode=1"


def cut_film(folder: Path) -> Path:
    root = lerobot(folder, "video")
    cut(next(root.rglob("*.mp4")))
    return root


def without_info(folder: Path) -> Path:
    root = lerobot(folder)
    (root / "meta" / "info.json").unlink()
    return root


ROSBAGS = "need rosbags: pip install 'tactflow[bags]'"
ROWS = [
    Row(
        "rosbag2, `.mcap`, `.bag`",
        "no `?topic=`",
        4,
        "add ?topic= one of: /gel/image (",
        lambda f: str(bag(f)),
    ),
    Row("", "no such topic", 4, "there is no topic /x; required one of:", lambda f: topic(bag(f), "/x")),
    Row("", "a topic without pictures", 4, "which hold no picture", lambda f: topic(bag(f), "/chatter")),
    Row(
        "",
        "unknown encoding",
        4,
        "pictures are encoded as 'xyz8'; required one of: bgr8",
        lambda f: topic(overwritten(one_file(f, "mcap"), b"\x05\0\0\0bgr8\0", b"\x05\0\0\0xyz8\0")),
    ),
    Row(
        "",
        "fewer bytes than the picture needs",
        4,
        "need rows of 64 bytes; got 576 bytes in rows of 48",
        lambda f: topic(overwritten(one_file(f, "mcap"), b"\x05\0\0\0bgr8\0", b"\x05\0\0\08UC4\0")),
    ),
    Row("`.mcap`", "cut off", 0, "", lambda f: topic(cut(one_file(f, "mcap"), 0.8))),
    Row(
        "",
        "not one",
        4,
        "is not an MCAP file",
        lambda f: topic(overwritten(one_file(f, "mcap"), b"MCAP", b"ABCD")),
    ),
    Row(
        "",
        "of another program, no `?topic=`",
        4,
        "no frames that tactflow recorded; to play one of its topics, add",
        lambda f: str(one_file(f, "mcap")),
    ),
    Row(
        "rosbag2 (sqlite3)",
        "cut off",
        4,
        "is damaged or cut off",
        lambda f: topic(cut(one_file(f, "sqlite3"))),
    ),
    Row("`.bag`", "cut off", 4, "is damaged or cut off", lambda f: topic(cut(bag(f, "ros1")))),
    Row("all of these", "rosbags is missing", 4, ROSBAGS, lambda f: topic(bag(f)), "rosbags"),
    Row(
        "`.h5`, `.zarr`",
        "no `?dataset=`",
        4,
        "add ?dataset= one of: /gel/force (float64 5 x 3), /gel/frames",
        lambda f: str(hdf5(f)),
    ),
    Row(
        "",
        "no such array",
        4,
        "there is no /x; required one of: /gel/frames",
        lambda f: f"{zarr(f)}?dataset=/x",
    ),
    Row(
        "",
        "no frames",
        4,
        "required uint8 or uint16 of N x H x W x 3",
        lambda f: f"{hdf5(f)}?dataset=/gel/force",
    ),
    Row("`.h5`", "cut off", 4, "is damaged or cut off", lambda f: f"{cut(hdf5(f))}?dataset=/gel/frames"),
    Row(
        "",
        "h5py is missing",
        4,
        "need h5py: pip install 'tactflow[hdf5]'",
        lambda f: f"{hdf5(f)}?dataset=/x",
        "h5py",
    ),
    Row(
        "`.zarr`",
        "a chunk is damaged",
        4,
        "is damaged or cut off",
        lambda f: f"{damaged_zarr(f)}?dataset=/gel/frames",
    ),
    Row(
        "",
        "zarr is missing",
        4,
        "need zarr: pip install 'tactflow[zarr]'",
        lambda f: f"{zarr(f)}?dataset=/x",
        "zarr",
    ),
    Row(
        "`lerobot:`",
        "no camera or episode",
        4,
        f"cameras: {KEY}; episodes: 0 to 1",
        lambda f: f"lerobot:{lerobot(f)}",
    ),
    Row(
        "",
        "not a dataset",
        4,
        "this LeRobot dataset: cannot be read",
        lambda f: episode(without_info(f)),
    ),
    Row("", "a video that was cut off", 4, "is damaged or cut off", lambda f: episode(cut_film(f))),
    Row(
        "",
        "pyarrow is missing",
        4,
        "need pyarrow: pip install 'tactflow[lerobot]'",
        lambda f: episode(lerobot(f)),
        "pyarrow",
    ),
]
"""An empty part is that of the row above."""


def line(row: Row | tuple[str, str, int, str]) -> str:
    """A row of the page."""
    part, wrong, code, said = row[:4]
    return f"| {part} | {wrong} | {code} | {said or 'it is played up to there'} |"


@pytest.mark.parametrize("row", ROWS, ids=lambda row: f"{row.part}: {row.wrong}")
def test_a_bad_source_ends_the_run_and_says_what_to_do(
    row: Row, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert line(row) in PAGE
    source = row.make(tmp_path)
    if row.without:
        monkeypatch.setitem(sys.modules, row.without, None)
    _, seen = run(tmp_path, {}, source=source)
    assert seen.exit == row.exit, seen.said
    assert row.said in seen.said
    assert row.said or seen.said == ""


SINKS = [
    ("sink `parquet`", "tables are there", 3, "holds tables already; set overwrite: true"),
    ("", "a file in its place", 3, "out is a file, not a folder"),
    ("", "pyarrow is missing", 3, "need pyarrow: pip install 'tactflow[parquet]'"),
]


@pytest.mark.parametrize("row", SINKS, ids=lambda row: row[1])
def test_a_sink_that_cannot_write_ends_the_run_and_says_what_to_do(
    row: tuple[str, str, int, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert line(row) in PAGE
    _, wrong, code, said = row
    out = tmp_path / "out"
    if "there" in wrong:
        (out / "frames").mkdir(parents=True)
        (out / "frames" / "part-00000.parquet").touch()
    elif "file" in wrong:
        out.touch()
    else:
        monkeypatch.setitem(sys.modules, "pyarrow", None)
    _, seen = run(tmp_path, {"parquet": {"path": str(out)}}, source=str(array(tmp_path, 12)))
    assert seen.exit == code, seen.said
    assert said in seen.said


EXPORTS = [
    ("`tactflow export`", "the folder is there", 2, "is already there; give another folder", ""),
    ("", "no rate is known", 2, "does not say how many frames come in a second; give --fps", ""),
    ("", "a camera", 2, "required a recording, not a camera or a stream", ""),
    ("", "av is missing", 3, "need av: pip install 'tactflow[lerobot]'", "av"),
]


def test_an_export_that_cannot_be_says_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "there").mkdir()
    source = str(array(tmp_path, 3))
    unrated = topic(write_bag(tmp_path / "press", list(IMAGES), "mcap"))
    live = "udp://127.0.0.1:9"
    monkeypatch.setattr("tactflow.sources.open_source", _live(live))
    tried = ((source, "there"), (unrated, "new"), (live, "new"), (source, "new"))
    for row, (recording, out) in zip(EXPORTS, tried, strict=True):
        assert line(row[:4]) in PAGE
        if row[4]:
            monkeypatch.setitem(sys.modules, row[4], None)
        code = main(["export", "lerobot", recording, "--out", str(tmp_path / out)])
        assert (code, row[3] in capsys.readouterr().err) == (row[2], True)
        assert not (tmp_path / "new").exists()


def _live(spec: str) -> Callable[..., object]:
    """Opens what `open_source` opens, but this one as a live source, which nobody has to serve."""
    from tactflow.sources import open_source
    from tests.sources.flaky import Flaky

    return lambda name, **options: Flaky().open() if name == spec else open_source(name, **options)


def test_the_page_has_no_other_row() -> None:
    rows = len(ROWS) + len(SINKS) + len(EXPORTS)
    assert PAGE.count("\n| ") == rows + 2
