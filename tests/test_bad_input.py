"""Recordings of others, tables and datasets when something is wrong: the message says what to do."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="the extra bags is not installed")
pytest.importorskip("h5py", reason="the extra hdf5 is not installed")
pytest.importorskip("zarr", reason="the extra zarr is not installed")
pytest.importorskip("pyarrow", reason="the extra parquet is not installed")
pytest.importorskip("av", reason="the extra lerobot is not installed")

from plugins.arrays.tests.test_datasets import (
    KEY,
    write_hdf5,
    write_lerobot,
    write_replay_buffer,
    write_zarr,
)
from plugins.rosbags.tests.bags import TOPIC, write_bag
from plugins.rosbags.tests.test_bags import pictures
from tactflow.cli.main import main
from tests.faults.rig import array, run
from tests.sources.flaky import Flaky

IMAGES = np.stack(pictures(5))


def bag(folder: Path, kind: str = "sqlite3", encoding: str = "bgr8", others: Sequence[str] = ()) -> Path:
    path = folder / ("press.bag" if kind == "ros1" else "press")
    return write_bag(path, list(IMAGES), kind, encoding, others)


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
    return write_lerobot(folder / "press", np.zeros((5, 48, 64, 3), np.uint8), dtype)


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


def table(folder: Path, **columns: Sequence[object]) -> Path:
    import pyarrow as pa
    import pyarrow.parquet as pq

    pq.write_table(pa.table(columns), folder / "press.parquet")
    return folder / "press.parquet"


def jpeg_bag(folder: Path) -> Path:
    """A bag whose compressed pictures are not files of images."""
    path = bag(folder, "mcap", "jpeg")
    (file,) = path.glob("*.mcap")
    return overwritten(file, b"\xff\xd8\xff", b"\0\0\1")


SOURCES: list[tuple[str, Callable[[Path], str], int, str]] = [
    ("a bag of two cameras", lambda f: str(bag(f, others=["/b"])), 4, "add ?topic= one of: /b ("),
    ("no such topic", lambda f: topic(bag(f), "/x"), 4, "there is no topic /x; required one of:"),
    ("a topic without pictures", lambda f: topic(bag(f), "/chatter"), 4, "which hold no picture"),
    (
        "unknown encoding",
        lambda f: topic(overwritten(one_file(f, "mcap"), b"\x05\0\0\0bgr8\0", b"\x05\0\0\0xyz8\0")),
        4,
        "pictures are encoded as 'xyz8'; required one of: bgr8",
    ),
    (
        "fewer bytes than the picture needs",
        lambda f: topic(overwritten(one_file(f, "mcap"), b"\x05\0\0\0bgr8\0", b"\x05\0\0\08UC4\0")),
        4,
        "need rows of 64 bytes; got 576 bytes in rows of 48",
    ),
    ("an MCAP file that was cut off", lambda f: topic(cut(one_file(f, "mcap"), 0.8)), 0, ""),
    (
        "an MCAP file of another program from a time on",
        lambda f: f"{one_file(f, 'mcap')}?start=1",
        4,
        "no frames that tactflow recorded; choose by ?topic= one of /chatter, /gel/image",
    ),
    ("a rosbag2 that was cut off", lambda f: topic(cut(one_file(f, "sqlite3"))), 4, "is damaged or cut off"),
    ("a ROS 1 bag that was cut off", lambda f: topic(cut(bag(f, "ros1"))), 4, "is damaged or cut off"),
    (
        "HDF5 without ?dataset=",
        lambda f: str(hdf5(f)),
        4,
        "add ?dataset= one of: /gel/force (float64 5 x 3), /gel/frames",
    ),
    ("no such array", lambda f: f"{zarr(f)}?dataset=/x", 4, "there is no /x; required one of: /gel/frames"),
    ("HDF5 that was cut off", lambda f: f"{cut(hdf5(f))}?dataset=/gel/frames", 4, "is damaged or cut off"),
    (
        "a damaged chunk",
        lambda f: f"{damaged_zarr(f)}?dataset=/gel/frames",
        4,
        "is damaged or cut off",
    ),
    (
        "no such episode of a replay buffer",
        lambda f: f"{write_replay_buffer(f / 'press.zarr.zip')}?dataset=data/camera0_rgb&episode=2",
        4,
        "episode=2: required one of the episodes 0 to 1",
    ),
    (
        "a table without pictures",
        lambda f: str(table(f, t=[1.0, 2.0])),
        4,
        "no column holds pictures (bytes, or bytes and path); there are t (double)",
    ),
    ("a table that was cut off", lambda f: str(cut(table(f, image=[b"jpeg"]))), 4, "is damaged or cut off"),
    (
        "a film in messages",
        lambda f: topic(overwritten(jpeg_bag(f), b"\x05\0\0\0jpeg\0", b"\x05\0\0\0h264\0")),
        4,
        "the format of its pictures is 'h264'; required JPEG, PNG or another image file",
    ),
    ("not a dataset", lambda f: episode(without_info(f)), 4, "this LeRobot dataset: cannot be read"),
    ("a video that was cut off", lambda f: episode(cut_film(f)), 4, "is damaged or cut off"),
]
"""What is wrong, the source, the exit code, and words of what is said."""

MISSING: list[tuple[str, Callable[[Path], str], str]] = [
    ("rosbags", lambda f: topic(bag(f)), "need rosbags: pip install 'tactflow[bags]'"),
    ("mcap", lambda f: str(one_file(f, "mcap")), "need mcap: pip install 'tactflow[record]'"),
    ("h5py", lambda f: f"{hdf5(f)}?dataset=/x", "need h5py: pip install 'tactflow[hdf5]'"),
    ("zarr", lambda f: f"{zarr(f)}?dataset=/x", "need zarr: pip install 'tactflow[zarr]'"),
    ("pyarrow", lambda f: episode(lerobot(f)), "need pyarrow: pip install 'tactflow[lerobot]'"),
]
"""A package, a source that needs it, and what is said without it."""


@pytest.mark.parametrize(("wrong", "make", "code", "said"), SOURCES, ids=[row[0] for row in SOURCES])
def test_a_bad_source_ends_the_run_and_says_what_to_do(
    wrong: str, make: Callable[[Path], str], code: int, said: str, tmp_path: Path
) -> None:
    _, seen = run(tmp_path, {}, source=make(tmp_path))
    assert seen.exit == code, (wrong, seen.said)
    assert said in seen.said
    assert said or seen.said == ""


@pytest.mark.parametrize(("package", "make", "said"), MISSING, ids=[row[0] for row in MISSING])
def test_a_source_without_its_package_says_what_to_install(
    package: str, make: Callable[[Path], str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = make(tmp_path)
    monkeypatch.setitem(sys.modules, package, None)
    _, seen = run(tmp_path, {}, source=source)
    assert seen.exit == 4
    assert said in seen.said


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ("a file in its place", "out is a file, not a folder"),
        ("pyarrow is missing", "need pyarrow: pip install 'tactflow[parquet]'"),
    ],
)
def test_tables_that_cannot_be_written_end_the_run(
    wrong: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    if "file" in wrong:
        out.touch()
    else:
        monkeypatch.setitem(sys.modules, "pyarrow", None)
    _, seen = run(tmp_path, {"parquet": {"path": str(out)}}, source=str(array(tmp_path, 12)))
    assert seen.exit == 3
    assert said in seen.said


@pytest.mark.parametrize(
    ("wrong", "code", "said"),
    [
        ("no rate is known", 2, "does not state its frame rate; give --fps"),
        ("a camera", 2, "required a recording, not a camera or a stream"),
        ("av is missing", 3, "need av: pip install 'tactflow[lerobot]'"),
    ],
)
def test_an_export_that_is_impossible_says_what_to_do(
    wrong: str,
    code: int,
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    recording, out = str(array(tmp_path, 3)), tmp_path / "new"
    if wrong == "no rate is known":
        recording = topic(write_bag(tmp_path / "press", list(IMAGES), "mcap"))
    elif wrong == "a camera":
        monkeypatch.setattr("tactflow.sources.open_source", lambda _: Flaky().open())
    else:
        monkeypatch.setitem(sys.modules, "av", None)
    assert main(["export", "lerobot", recording, "--out", str(out)]) == code
    assert said in capsys.readouterr().err
    assert not out.exists()
