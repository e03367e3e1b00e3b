"""`tactflow export replay-buffer`: what it writes is what was found, in the layout of Diffusion Policy."""

from __future__ import annotations

import json
from contextlib import redirect_stderr
from io import StringIO
from pathlib import Path

import numpy as np
import pytest

import tactflow
from plugins.lerobot.tests.test_export import ORIGIN, frames_of, moved
from tactflow.cli.main import main
from tactflow.engine.errors import StageError
from tactflow.message.result import Result
from tactflow.plugins.replay_buffer.export import ReplayBufferWriter, fit_embedding
from tactflow.sources import open_source

zarr = pytest.importorskip("zarr", reason="the extra zarr is not installed")

SPECS = ["sim:press?frames=30", "sim:slide?frames=20&seed=2"]
LENGTHS = [30, 20]
FRACTIONS = ("main_marker_offset", "main_initial_marker")
"""Arrays in fractions of the picture's width and height."""


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Result]]:
    """The folder of a dataset of two recordings, and what the pipeline finds in them."""
    out = tmp_path_factory.mktemp("export") / "press"
    with redirect_stderr(StringIO()):
        assert main(["export", "replay-buffer", *SPECS, "--out", str(out)]) == 0
    settings = {"sinks": {}}
    return out, [r for spec in SPECS for r in tactflow.stream(source=spec, settings=settings, images=True)]


def test_a_buffer_holds_what_was_found_to_the_bit(exported: tuple[Path, list[Result]]) -> None:
    out, results = exported
    root = zarr.open_group(out / "replay_buffer.zarr", mode="r")
    assert root["meta/episode_ends"][:].tolist() == [30, 50]
    markers = [result.markers for result in results if result.markers is not None]
    assert len(markers) == 50
    size = np.array([300, 400])
    expected = {
        "main_img": np.stack([r.image for r in results if r.image is not None])[..., ::-1],
        "main_marker_offset": np.stack([m.displacement for m in markers]) / size,
        "main_initial_marker": np.stack([m.origin for m in markers]) / size,
        "main_marker_status": np.stack([m.status for m in markers]),
        "timestamp": np.array([r.t for r in results]),
    }
    for name, values in expected.items():
        stored = root[f"data/{name}"]
        exact = values.astype(np.float32) if name in FRACTIONS else values
        assert stored.dtype == exact.dtype, name
        # The second recording may number its dots in another order.
        assert np.array_equal(stored[:30], exact[:30]), name
    assert np.array_equal(root["data/main_img"][:], expected["main_img"])
    assert np.array_equal(root["data/timestamp"][:], expected["timestamp"])
    assert np.abs(root["data/main_marker_offset"][30:]).max() > 1 / 400


def test_the_layout_is_that_of_diffusion_policy(exported: tuple[Path, list[Result]]) -> None:
    out, _ = exported
    root = zarr.open_group(out / "replay_buffer.zarr", mode="r")
    # As its ReplayBuffer checks: all arrays of `data` have the length that the last episode ends at.
    names = {name: array.shape for name, array in root["data"].arrays()}
    assert names == {
        "main_img": (50, 400, 300, 3),
        "main_initial_marker": (50, 80, 2),
        "main_marker_offset": (50, 80, 2),
        "main_marker_offset_emb": (50, 15),
        "main_marker_status": (50, 80),
        "timestamp": (50,),
    }
    # Of format 2, which is all that its version of zarr reads, with a compression that this one knows.
    for name in names:
        described = json.loads((out / "replay_buffer.zarr" / "data" / name / ".zarray").read_text())
        assert described["zarr_format"] == 2
        assert described["compressor"]["id"] == "blosc"
        assert described["chunks"][0] == 16
        assert described["chunks"][1:] == list(names[name][1:])
    ends = json.loads((out / "replay_buffer.zarr" / "meta" / "episode_ends" / ".zarray").read_text())
    assert (ends["dtype"], ends["compressor"], ends["chunks"]) == ("<i8", None, [2])


def test_each_episode_is_a_source_again(exported: tuple[Path, list[Result]]) -> None:
    out, results = exported
    begin = 0
    for episode, length in enumerate(LENGTHS):
        query = f"dataset=/data/main_img&times=/data/timestamp&order=rgb&episode={episode}"
        reader = open_source(f"{out / 'replay_buffer.zarr'}?{query}")
        frames = list(iter(reader.read, None))
        reader.close()
        assert len(frames) == length
        for (image, t), result in zip(frames, results[begin : begin + length], strict=True):
            assert np.array_equal(image, result.image)
            assert t == pytest.approx(result.t)
        begin += length


def test_the_embedding_can_be_computed_again_from_its_files(exported: tuple[Path, list[Result]]) -> None:
    folder, _ = exported
    data = zarr.open_group(folder / "replay_buffer.zarr", mode="r")["data"]
    transform, mean = (np.load(folder / f"pca_{name}_matrix.npy") for name in ("transform", "mean"))
    vectors, embedded = data["main_marker_offset"][:].reshape(50, -1), data["main_marker_offset_emb"][:]
    assert np.array_equal((vectors - mean) @ transform, embedded)
    assert np.allclose(transform.T @ transform, np.eye(15), atol=1e-5)
    # No 15 numbers say more of these vectors.
    singular = np.linalg.svd(vectors - vectors.mean(0), compute_uv=False)
    lost = ((embedded @ transform.T + mean - vectors) ** 2).sum()
    assert lost == pytest.approx((singular[15:] ** 2).sum(), rel=1e-2)


def test_an_embedding_of_few_markers_is_filled_with_zeros() -> None:
    vectors = np.random.default_rng(0).normal(size=(20, 4))
    transform, _ = fit_embedding(vectors)
    assert transform.shape == (4, 15)
    assert not transform[:, 4:].any()


def test_markers_keep_their_place_in_recordings_that_found_others(tmp_path: Path) -> None:
    writer = ReplayBufferWriter(tmp_path / "buffer.zarr")
    fewer = ORIGIN[[5, 3, 2, 1, 0]] + 2.0
    writer.add(frames_of(None, moved((1.0, 0.0))))
    writer.add(frames_of(moved((3.0, 0.0), fewer)))
    writer.finish()
    data = zarr.open_group(tmp_path / "buffer.zarr", mode="r")["data"]
    assert data["main_marker_status"][:].tolist() == [[2] * 6, [0] * 6, [0, 0, 0, 0, 2, 0]]
    places = np.where(np.arange(6)[:, None] == 4, ORIGIN, ORIGIN + 2) / [64, 48]
    assert np.array_equal(data["main_initial_marker"][2], places.astype(np.float32))
    assert np.array_equal(data["main_marker_offset"][:, :, 0] * 64, np.outer([0, 1, 3], [1] * 6))


def test_a_gel_without_dots_gives_a_buffer_of_pictures(tmp_path: Path) -> None:
    out = tmp_path / "press"
    words = ["export", "replay-buffer", "sim:press?frames=5", "--pipeline", "markerless", "--out", str(out)]
    assert main(words) == 0
    assert [path.name for path in out.iterdir()] == ["replay_buffer.zarr"]
    root = zarr.open_group(out / "replay_buffer.zarr", mode="r")
    assert sorted(root["data"].array_keys()) == ["main_img", "timestamp"]


def test_recordings_that_do_not_belong_together_are_refused(tmp_path: Path) -> None:
    writer = ReplayBufferWriter(tmp_path / "buffer.zarr")
    writer.add(frames_of(None))
    with pytest.raises(StageError, match="has markers, and the recordings before have none"):
        writer.add(frames_of(moved((0.0, 0.0))))
    with pytest.raises(StageError, match="there is no frame in it"):
        writer.add([])
    writer = ReplayBufferWriter(tmp_path / "other.zarr")
    writer.add(frames_of(moved((0.0, 0.0))))
    with pytest.raises(StageError, match="only 0 of 6 markers are where"):
        writer.add(frames_of(moved((0.0, 0.0), ORIGIN + 10.5)))
    (small,) = frames_of(moved((0.0, 0.0)))
    with pytest.raises(StageError, match="32 x 48 pixels; the earlier ones are main, 64 x 48"):
        writer.add([small.replace(image=np.zeros((48, 32, 3), np.uint8))])
    with pytest.raises(StageError, match="needs a stage preprocess"):
        writer.add([small.replace(image=None)])


def test_a_failed_export_leaves_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "press"
    words = [
        "export",
        "replay-buffer",
        "sim:press?frames=3",
        str(tmp_path / "no-such.mcap"),
        "--out",
        str(out),
    ]
    assert main(words) == 4
    assert "no-such.mcap: no such file" in capsys.readouterr().err
    assert not out.exists()


def test_batch_makes_one_buffer_of_all_recordings_that_are_done(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recordings, out = tmp_path / "recordings", tmp_path / "out"
    recordings.mkdir()
    images = [r.image for r in tactflow.stream(source=SPECS[0], settings={"sinks": {}}, images=True)]
    for index in range(2):
        np.save(recordings / f"press-{index}.npy", np.stack(images[10 * index : 10 * index + 10]))
    (recordings / "press-2.npy").write_bytes(b"damaged")
    common = ["batch", "markerless", str(recordings), "--out", str(out), "--format", "csv", "--workers", "1"]
    # The size of a picture tells that `--set` applies to the data set, too.
    settings = ["--set", "stages.preprocess={use: preprocess, downsample: 1, rotate: 0}"]
    assert main([*common, *settings, "--dataset", "replay-buffer", "--fps", "15"]) == 3
    assert "out/replay-buffer: 2 episodes at 15 fps" in capsys.readouterr().err
    root = zarr.open_group(out / "replay-buffer" / "replay_buffer.zarr", mode="r")
    # 10 frames at 30 Hz; the last one is at 0.3 s.
    assert root["meta/episode_ends"][:].tolist() == [5, 10]
    for begin, recording in ((0, images[:10:2]), (5, images[10:20:2])):
        stored = root["data/main_img"][begin : begin + 5]
        assert np.array_equal(stored, np.stack(recording)[..., ::-1])
    assert main([*common, "--dataset", "no-such"]) == 2
    assert "there is no format no-such" in capsys.readouterr().err
