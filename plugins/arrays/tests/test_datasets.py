"""Frames in HDF5, Zarr and LeRobot datasets: pictures, times, and what is said when something is wrong."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from plugins.rosbags.tests.test_bags import pictures, played
from tactflow.engine.errors import SourceError
from tactflow.sources import open_source

IMAGES = np.stack(pictures(5))
UNIX = 1_700_000_000


def write_hdf5(path: Path, **arrays: Any) -> Path:
    h5py = pytest.importorskip("h5py", reason="the extra hdf5 is not installed")
    with h5py.File(path, "w") as file:
        for name, array in arrays.items():
            if isinstance(array, list):
                kind = h5py.vlen_dtype(np.uint8)
                file.create_dataset(f"gel/{name}", (len(array),), kind)[:] = array
            else:
                file.create_dataset(f"gel/{name}", data=array, chunks=(2, *array.shape[1:]))
    return path


def write_zarr(path: Path, **arrays: Any) -> Path:
    zarr = pytest.importorskip("zarr", reason="the extra zarr is not installed")
    group = zarr.open_group(str(path), mode="w")
    for name, array in arrays.items():
        group.create_array(f"gel/{name}", data=array, chunks=(2, *array.shape[1:]))
    return path


KINDS = {"press.h5": write_hdf5, "press.zarr": write_zarr}


@pytest.mark.parametrize("name", KINDS)
def test_an_array_gives_its_frames_and_its_times(name: str, tmp_path: Path) -> None:
    seconds = np.array([5.0, 5.5, 5.25, 7.0, 8.0])
    whole = UNIX * 10**9 + np.arange(5) * 40_000_000
    path = KINDS[name](tmp_path / name, frames=IMAGES, rgb=IMAGES[..., ::-1], seconds=seconds, ns=whole)
    expected = {
        "dataset=/gel/frames": [0, 1 / 30, 2 / 30, 3 / 30, 4 / 30],
        "dataset=gel/frames&times=gel/seconds": [0.0, 0.5, 0.25, 2.0, 3.0],
        "dataset=/gel/rgb&order=rgb&times=/gel/ns": [0.0, 0.04, 0.08, 0.12, 0.16],
    }
    for query, times in expected.items():
        found = played(f"{path}?{query}")
        assert np.array_equal([image for image, _ in found], IMAGES)
        assert [t for _, t in found] == times


def test_pictures_kept_as_files_are_decoded(tmp_path: Path) -> None:
    files = [cv2.imencode(".png", image)[1].ravel() for image in IMAGES]
    padded = np.zeros((5, max(map(len, files)) + 3), np.uint8)
    for row, file in zip(padded, files, strict=True):
        row[: len(file)] = file
    path = write_hdf5(tmp_path / "press.h5", files=files, padded=padded)
    for name in ("files", "padded"):
        assert np.array_equal([image for image, _ in played(f"{path}?dataset=/gel/{name}")], IMAGES)


WRONG = {
    "?dataset=/gel/frames&times=/gel/frames": r"times are uint8 of shape .*; required 5 numbers",
    "?dataset=/gel/frames&order=gbr": "order=gbr: required bgr or rgb",
    "?set=/gel/frames": "set=/gel/frames: required dataset=name of the frames, times=",
}


@pytest.mark.parametrize("query", WRONG)
def test_what_is_no_frames_is_refused(query: str, tmp_path: Path) -> None:
    path = write_hdf5(tmp_path / "press.h5", frames=IMAGES)
    with pytest.raises(SourceError, match=WRONG[query]):
        open_source(f"{path}{query}")


def test_times_that_are_damaged_are_an_error_of_the_source(tmp_path: Path) -> None:
    path = write_zarr(tmp_path / "press.zarr", frames=IMAGES, t=np.arange(5.0))
    (path / "gel/t/c/0").write_bytes(b"damaged")
    with pytest.raises(SourceError, match="gel/frames: is damaged or cut off"):
        open_source(f"{path}?dataset=/gel/frames&times=/gel/t")


def test_pixels_in_another_file_are_not_read(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py", reason="the extra hdf5 is not installed")
    (tmp_path / "secret").write_bytes(bytes(IMAGES.nbytes))
    with h5py.File(tmp_path / "press.h5", "w") as file:
        outside = [(str(tmp_path / "secret"), 0, IMAGES.nbytes)]
        file.create_dataset("frames", IMAGES.shape, np.uint8, external=outside)
    with pytest.raises(SourceError, match="there is no /frames; required one of: none"):
        open_source(f"{tmp_path / 'press.h5'}?dataset=/frames")


def test_a_zarr_array_that_would_run_code_is_not_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("zarr", reason="the extra zarr is not installed")
    # As older versions do without being told.
    monkeypatch.setattr("numcodecs.pickles.ALLOW_UNSAFE_PICKLE_DECODE", True, raising=False)
    frames = tmp_path / "evil.zarr" / "frames"
    frames.mkdir(parents=True)
    (frames.parent / ".zgroup").write_text('{"zarr_format": 2}')
    described = {"zarr_format": 2, "shape": [4], "chunks": [4], "dtype": "|O", "order": "C"}
    codecs = {"filters": [{"id": "vlen-bytes"}], "compressor": {"id": "pickle"}, "fill_value": None}
    (frames / ".zarray").write_text(json.dumps(described | codecs))
    (frames / "0").write_bytes(b"cos\nmkdir\n(V" + str(tmp_path / "ran").encode() + b"\ntR.")
    with pytest.raises(SourceError, match="there is no /frames; required one of: none"):
        open_source(f"{frames.parent}?dataset=/frames")
    assert not (tmp_path / "ran").exists()


KEY = "observation.images.gel"


def write_film(path: Path, images: NDArray[np.uint8]) -> None:
    """A video at 25 Hz, as LeRobot encodes it."""
    av = pytest.importorskip("av", reason="the extra lerobot is not installed")
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as file:
        stream = file.add_stream("libsvtav1", rate=25, options={"crf": "10", "preset": "8"})
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for image in images:
            file.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="bgr24")))
        file.mux(stream.encode(None))
    if sys.platform == "linux":
        # Where the user is root, this encoder makes the calling thread a real-time one.
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def write_lerobot(root: Path, images: NDArray[np.uint8], dtype: str) -> Path:
    """Two episodes of two and three frames at 25 Hz, by the documents of the layout."""
    pa = pytest.importorskip("pyarrow", reason="the extra lerobot is not installed")
    import pyarrow.parquet as pq

    features = {KEY: {"dtype": dtype, "shape": [48, 64, 3]}, "action": {"dtype": "float32", "shape": [1]}}
    info = {"codebase_version": "v3.0", "fps": 25, "total_episodes": 2, "features": features}
    rows: list[dict[str, Any]] = [{"episode_index": int(index >= 2)} for index in range(5)]
    episodes = [{"episode_index": 0, "length": 2}, {"episode_index": 1, "length": 3}]
    if dtype == "image":
        for row, image in zip(rows, images, strict=True):
            row[KEY] = {"bytes": cv2.imencode(".png", image)[1].tobytes()}
    for folder in ("meta/episodes/chunk-000", "data/chunk-000"):
        (root / folder).mkdir(parents=True)
    (root / "meta" / "info.json").write_text(json.dumps(info))
    pq.write_table(pa.Table.from_pylist(rows), root / "data/chunk-000/file-000.parquet")
    for index, episode in enumerate(episodes):
        episode |= {"data/chunk_index": 0, "data/file_index": 0}
        if dtype == "video":
            place = {"chunk_index": 0, "file_index": 0, "from_timestamp": 0.08 * index}
            episode |= {f"videos/{KEY}/{key}": value for key, value in place.items()}
    if dtype == "video":
        write_film(root / "videos" / KEY / "chunk-000/file-000.mp4", images)
    pq.write_table(pa.Table.from_pylist(episodes), root / "meta/episodes/chunk-000/file-000.parquet")
    return root


@pytest.mark.parametrize("dtype", ["video", "image"])
def test_an_episode_of_a_lerobot_dataset_is_played(dtype: str, tmp_path: Path) -> None:
    levels = np.array([20, 60, 100, 140, 180], np.uint8)
    images = np.broadcast_to(levels[:, None, None, None], (5, 48, 64, 3)).copy()
    root = write_lerobot(tmp_path / "press", images, dtype)
    for episode, expected in ((0, [20, 60]), (1, [100, 140, 180])):
        found = played(f"lerobot:{root}?camera={KEY}&episode={episode}")
        # A video comes near the grey levels, which are 40 apart.
        assert np.allclose([image.mean() for image, _ in found], expected, atol=5)
        assert [t for _, t in found] == [index / 25 for index in range(len(expected))]
    with pytest.raises(SourceError, match="episodes: 0 to 1"):
        open_source(f"lerobot:{root}?camera={KEY}&episode=2")
    for video in root.rglob("*.mp4"):
        video.write_text("ffconcat version 1.0\nfile other.mp4\n")
    if dtype == "video":
        with pytest.raises(SourceError, match="a list of other files"):
            open_source(f"lerobot:{root}?camera={KEY}&episode=0")
