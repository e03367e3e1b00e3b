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
    # Version 3 has no strings of a fixed length.
    version = 2 if any(array.dtype.kind in "SV" for array in arrays.values()) else 3
    group = zarr.open_group(str(path), mode="w", zarr_format=version)
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


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize("name", KINDS)
def test_pictures_kept_as_files_are_decoded(name: str, suffix: str, tmp_path: Path) -> None:
    files = [cv2.imencode(suffix, image)[1].ravel() for image in IMAGES]
    longest = max(map(len, files)) + 3
    padded = np.zeros((5, longest), np.uint8)
    for row, file in zip(padded, files, strict=True):
        row[: len(file)] = file
    texts = np.array([file.tobytes() for file in files])
    opaque = np.array([np.void(row.tobytes()) for row in padded])
    assert (texts.dtype.kind, opaque.dtype.kind) == ("S", "V")
    any_length = {"any_length": files} if name == "press.h5" else {}
    path = KINDS[name](tmp_path / name, padded=padded, texts=texts, opaque=opaque, **any_length)
    expected = [cv2.imdecode(file, cv2.IMREAD_COLOR) for file in files]
    for dataset in ("padded", "texts", "opaque", *any_length):
        found = [image for image, _ in played(f"{path}?dataset=/gel/{dataset}")]
        assert np.array_equal(found, expected), dataset


def write_replay_buffer(path: Path, frames: NDArray[Any] = IMAGES, ends: Any = (2, 5)) -> Path:
    """Frames and the ends of their episodes, as Diffusion Policy keeps them. path : also .h5 or .zarr.zip."""
    arrays = {"data/camera0_rgb": frames, "meta/episode_ends": np.asarray(ends)}
    if path.suffix == ".h5":
        h5py = pytest.importorskip("h5py", reason="the extra hdf5 is not installed")
        with h5py.File(path, "w") as file:
            for name, array in arrays.items():
                file[name] = array
        return path
    zarr = pytest.importorskip("zarr", reason="the extra zarr is not installed")
    store = zarr.storage.ZipStore(path, mode="w") if path.suffix == ".zip" else zarr.storage.LocalStore(path)
    group = zarr.open_group(store, mode="w", zarr_format=2)
    for name, array in arrays.items():
        group.create_array(name, data=array, chunks=(2, *array.shape[1:]))
    store.close()
    return path


BUFFERS = ["replay_buffer.h5", "replay_buffer.zarr", "replay_buffer.zarr.zip"]


@pytest.mark.parametrize("name", BUFFERS)
def test_an_episode_of_a_replay_buffer_is_played_alone_or_as_an_epoch(name: str, tmp_path: Path) -> None:
    spec = f"{write_replay_buffer(tmp_path / name)}?dataset=data/camera0_rgb"
    for episode, expected in enumerate((IMAGES[:2], IMAGES[2:])):
        reader = open_source(f"{spec}&episode={episode}")
        arrivals = list(iter(reader.read_arrival, None))
        reader.close()
        assert reader.total == len(expected)
        assert np.array_equal([arrival.image for arrival in arrivals], expected)
        assert [(arrival.seq, arrival.epoch) for arrival in arrivals] == [
            (i, 0) for i in range(len(expected))
        ]
        assert [arrival.t for arrival in arrivals] == [index / 30 for index in range(len(expected))]
    reader = open_source(spec)
    arrivals = list(iter(reader.read_arrival, None))
    reader.close()
    assert np.array_equal([arrival.image for arrival in arrivals], IMAGES)
    assert [arrival.epoch for arrival in arrivals] == [0, 0, 1, 1, 1]
    assert [arrival.seq for arrival in arrivals] == [0, 1, 2, 3, 4]
    with pytest.raises(SourceError, match="episode=2: required one of the episodes 0 to 1"):
        open_source(f"{spec}&episode=2")


def test_of_several_buffers_in_a_file_each_has_its_own_episodes(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py", reason="the extra hdf5 is not installed")
    with h5py.File(tmp_path / "two.h5", "w") as file:
        for name, ends in (("left", [5]), ("right", [1, 5])):
            file[f"{name}/data/img"] = IMAGES
            file[f"{name}/meta/episode_ends"] = ends
    for name, epochs in (("left", [0] * 5), ("right", [0, 1, 1, 1, 1])):
        reader = open_source(f"{tmp_path / 'two.h5'}?dataset={name}/data/img")
        assert [arrival.epoch for arrival in iter(reader.read_arrival, None)] == epochs
        reader.close()


@pytest.mark.parametrize(
    "ends", [[2, 6], [3, 2, 5], [-1, 5], [2, 4], [[2, 5]], [2.0, 5.0], []], ids=lambda ends: str(ends)
)
def test_ends_that_do_not_fit_the_frames_divide_nothing(
    ends: Any, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    spec = f"{write_replay_buffer(tmp_path / 'press.h5', ends=ends)}?dataset=data/camera0_rgb"
    reader = open_source(spec)
    assert [arrival.epoch for arrival in iter(reader.read_arrival, None)] == [0] * 5
    reader.close()
    assert "/meta/episode_ends does not divide the 5 frames into episodes" in caplog.text
    with pytest.raises(SourceError, match="episode=0: /meta/episode_ends does not divide the 5 frames"):
        open_source(f"{spec}&episode=0")


def test_an_episode_of_a_file_without_episodes_is_refused(tmp_path: Path) -> None:
    path = write_hdf5(tmp_path / "press.h5", frames=IMAGES)
    with pytest.raises(SourceError, match="episode=0: there is no array episode_ends"):
        open_source(f"{path}?dataset=/gel/frames&episode=0")


def forget_filters() -> None:
    """Undo what importing hdf5plugin does."""
    from h5py import h5z

    for number in FILTERS.values():
        if h5z.filter_avail(number):
            h5z.unregister_filter(number)
    for module in [name for name in sys.modules if name.partition(".")[0] == "hdf5plugin"]:
        del sys.modules[module]


FILTERS = {"Blosc": 32001, "Zstd": 32015, "Bitshuffle": 32008}
SMOOTH = np.repeat(np.arange(5, dtype=np.uint8), 12 * 16 * 3).reshape(5, 12, 16, 3) * 40
"""Frames that every filter makes smaller: what it cannot is kept unfiltered."""


@pytest.mark.parametrize("kind", FILTERS)
def test_an_array_with_a_filter_of_hdf5plugin_is_read_or_says_what_it_needs(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    h5py = pytest.importorskip("h5py", reason="the extra hdf5 is not installed")
    hdf5plugin = pytest.importorskip("hdf5plugin", reason="the extra codecs is not installed")
    path = tmp_path / "press.h5"
    with h5py.File(path, "w") as file:
        options = getattr(hdf5plugin, kind)()
        file.create_dataset("frames", data=SMOOTH, chunks=(2, 12, 16, 3), **options)
    spec = f"{path}?dataset=/frames"
    forget_filters()
    with monkeypatch.context() as patched:
        patched.setitem(sys.modules, "hdf5plugin", None)
        needs = rf"\(filter {FILTERS[kind]}\) need hdf5plugin: pip install 'tactflow\[codecs\]'"
        with pytest.raises(SourceError, match=needs):
            open_source(spec)
    assert np.array_equal([image for image, _ in played(spec)], SMOOTH)


def test_a_filter_that_hdf5plugin_does_not_have_is_named(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py", reason="the extra hdf5 is not installed")
    pytest.importorskip("hdf5plugin", reason="the extra codecs is not installed")
    path = tmp_path / "press.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset("frames", data=SMOOTH, chunks=(2, 12, 16, 3), compression="gzip")
    # The number of gzip, in the description of the chain of filters, becomes one that nobody has.
    data = path.read_bytes()
    chain = bytes([1, 1, 0, 0, 0, 0, 0, 0, 1, 0])
    assert data.count(chain) == 1
    path.write_bytes(data.replace(chain, chain[:-2] + (40000).to_bytes(2, "little")))
    with pytest.raises(SourceError, match=r"hdf5plugin does not have .*\(filter 40000\)"):
        open_source(f"{path}?dataset=/frames")


def test_a_zarr_array_with_a_codec_of_imagecodecs_is_read_or_says_what_it_needs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    zarr = pytest.importorskip("zarr", reason="the extra zarr is not installed")
    codecs = pytest.importorskip("imagecodecs.numcodecs", reason="the extra codecs is not installed")
    from numcodecs.registry import codec_registry, register_codec

    # As a process does that has not registered it.
    register_codec(codecs.Jpegxl)
    path = tmp_path / "press.zarr"
    group = zarr.open_group(str(path), mode="w", zarr_format=2)
    options = {"compressors": codecs.Jpegxl(lossless=True), "chunks": (1, 12, 16, 3)}
    group.create_array("data/img", shape=IMAGES.shape, dtype="u1", **options)[:] = IMAGES
    monkeypatch.delitem(codec_registry, "imagecodecs_jpegxl")
    spec = f"{path}?dataset=/data/img"
    with monkeypatch.context() as patched:
        patched.setitem(sys.modules, "imagecodecs", None)
        with pytest.raises(SourceError, match=r"imagecodecs_jpegxl need imagecodecs: .*tactflow\[codecs\]"):
            open_source(spec)
    assert np.array_equal([image for image, _ in played(spec)], IMAGES)


@pytest.mark.parametrize(
    ("codec", "says"),
    [
        ("pcodec", "the codec pcodec needs pcodec: pip install pcodec"),
        ("home_made", "the codec home_made is in no installed package"),
        ("imagecodecs_nonsense", "codec not available: .*imagecodecs_nonsense"),
    ],
)
def test_an_unknown_codec_of_zarr_is_named(codec: str, says: str, tmp_path: Path) -> None:
    pytest.importorskip("imagecodecs", reason="the extra codecs is not installed")
    path = write_replay_buffer(tmp_path / "press.zarr")
    about = path / "data/camera0_rgb/.zarray"
    about.write_text(json.dumps(json.loads(about.read_text()) | {"compressor": {"id": codec}}))
    with pytest.raises(SourceError, match=says):
        open_source(f"{path}?dataset=/data/camera0_rgb")


def test_a_zip_file_that_is_damaged_is_an_error_of_the_source(tmp_path: Path) -> None:
    path = write_replay_buffer(tmp_path / "press.zarr.zip")
    os.truncate(path, path.stat().st_size // 2)
    with pytest.raises(SourceError, match="is damaged or cut off"):
        open_source(f"{path}?dataset=/data/camera0_rgb")


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


def write_lerobot(root: Path, images: NDArray[np.uint8], dtype: str, version: str = "v3.0") -> Path:
    """Two episodes of two and three frames at 25 Hz, by the documents of the layout."""
    pa = pytest.importorskip("pyarrow", reason="the extra lerobot is not installed")
    import pyarrow.parquet as pq

    features = {KEY: {"dtype": dtype, "shape": [48, 64, 3]}, "action": {"dtype": "float32", "shape": [1]}}
    info = {"codebase_version": version, "fps": 25, "total_episodes": 2, "features": features}
    rows: list[dict[str, Any]] = [{"episode_index": int(index >= 2)} for index in range(5)]
    episodes = [{"episode_index": 0, "length": 2}, {"episode_index": 1, "length": 3}]
    if dtype == "image":
        for row, image in zip(rows, images, strict=True):
            row[KEY] = {"bytes": cv2.imencode(".png", image)[1].tobytes()}
    if version.startswith("v2"):
        return write_lerobot_v2(root, info, rows, images if dtype == "video" else None)
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


def write_lerobot_v2(
    root: Path, info: dict[str, Any], rows: list[dict[str, Any]], film: NDArray[np.uint8] | None
) -> Path:
    """The same in layout v2, with files of its own for each episode, here in folders of one."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    (root / "meta").mkdir(parents=True)
    (root / "meta" / "info.json").write_text(json.dumps(info | {"chunks_size": 1}))
    lengths = [{"episode_index": index, "tasks": ["press"], "length": 2 + index} for index in range(2)]
    (root / "meta" / "episodes.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lengths))
    for index, part in enumerate((slice(0, 2), slice(2, 5))):
        folder, name = f"chunk-{index:03d}", f"episode_{index:06d}"
        (root / "data" / folder).mkdir(parents=True)
        pq.write_table(pa.Table.from_pylist(rows[part]), root / "data" / folder / f"{name}.parquet")
        if film is not None:
            write_film(root / "videos" / folder / KEY / f"{name}.mp4", film[part])
    return root


@pytest.mark.parametrize("version", ["v2.0", "v2.1", "v3.0"])
@pytest.mark.parametrize("dtype", ["video", "image"])
def test_an_episode_of_a_lerobot_dataset_is_played(dtype: str, version: str, tmp_path: Path) -> None:
    levels = np.array([20, 60, 100, 140, 180], np.uint8)
    images = np.broadcast_to(levels[:, None, None, None], (5, 48, 64, 3)).copy()
    root = write_lerobot(tmp_path / "press", images, dtype, version)
    for episode, expected in ((0, [20, 60]), (1, [100, 140, 180])):
        found = played(f"lerobot:{root}?camera={KEY}&episode={episode}")
        # A video comes near the grey levels, which are 40 apart.
        assert np.allclose([image.mean() for image, _ in found], expected, atol=5)
        assert [t for _, t in found] == [index / 25 for index in range(len(expected))]
    with pytest.raises(SourceError, match="episodes: 0 to 1"):
        open_source(f"lerobot:{root}?camera={KEY}&episode=2")
    # The folder itself is a source: all episodes of its only camera, one epoch each.
    reader = open_source(str(root))
    arrivals = list(iter(reader.read_arrival, None))
    reader.close()
    assert reader.total == 5
    assert np.allclose([arrival.image.mean() for arrival in arrivals], levels, atol=5)
    assert [(arrival.seq, arrival.epoch) for arrival in arrivals] == [(0, 0), (1, 0), (2, 1), (3, 1), (4, 1)]
    assert [arrival.t for arrival in arrivals] == [index / 25 for index in range(5)]
    for video in root.rglob("*.mp4"):
        video.write_text("ffconcat version 1.0\nfile other.mp4\n")
    if dtype == "video":
        with pytest.raises(SourceError, match="a list of other files"):
            open_source(f"lerobot:{root}?camera={KEY}&episode=0")


def test_a_lerobot_dataset_of_an_unknown_layout_or_without_the_episode_is_refused(tmp_path: Path) -> None:
    images = np.zeros((5, 48, 64, 3), np.uint8)
    root = write_lerobot(tmp_path / "v1", images, "image", "v1.6")
    with pytest.raises(SourceError, match=r"has layout v1.6; required v2.0, v2.1 or v3.0"):
        open_source(str(root))
    root = write_lerobot(tmp_path / "v2", images, "image", "v2.1")
    episodes = root / "meta" / "episodes.jsonl"
    episodes.write_text(episodes.read_text().partition("\n")[0])
    with pytest.raises(SourceError, match="meta/episodes does not hold this episode"):
        open_source(f"{root}?episode=1")
    episodes.write_text("{")
    with pytest.raises(SourceError, match="this LeRobot dataset"):
        open_source(str(root))
