"""Several sensors in one LeRobot dataset: frames of the same time, and columns of their own."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from plugins.lerobot.tests.lerobot_env import needs_datasets, run_with_lerobot
from plugins.lerobot.tests.test_export import LOADED, moved
from tactflow.engine.errors import StageError
from tactflow.engine.frame import Frame
from tactflow.message.result import Result
from tactflow.plugins.lerobot.export import DatasetWriter
from tactflow.sources import open_source
from tactflow.vision.types import Scale
from tests.messages import Results
from tests.terminal import Terminal

pytest.importorskip("pyarrow", reason="the extra lerobot is not installed")
pytest.importorskip("av", reason="the extra lerobot is not installed")

import pyarrow.parquet as pq

LEFT, RIGHT = ("observation.images.left", "observation.images.right")
T = 1_700_000_000.0
"""Unix time of the first frame, s."""
PLAIN = """
stages:
  capture: {skip_damaged: false}
  preprocess: {downsample: 1, rotate: 0}
"""
"""A pipeline that changes no pixel."""


def picture(number: int, width: int = 64) -> NDArray[np.uint8]:
    """A picture that can be told from others."""
    return np.random.default_rng(number).integers(0, 256, (48, width, 3), np.uint8)


def results(
    sensor: str, times: NDArray[np.float64], width: int = 64, scale: Scale | None = None
) -> list[Result]:
    """A result for each time, with a displacement of as many pixels as its number."""
    return [
        Result(
            Frame(sensor, index, float(t), picture(index, width)),
            Results(picture(index, width), markers=moved((float(index), 0.0)), scale=scale)._asdict(),
        )
        for index, t in enumerate(times)
    ]


def written(folder: Path, *episodes: Any, fps: int = 10) -> tuple[dict[str, list[Any]], dict[str, Any]]:
    """The table and the features of a dataset."""
    writer = DatasetWriter(folder, fps, "pinch", video=False)
    for episode in episodes:
        writer.add(episode)
    writer.finish()
    info = json.loads((folder / "meta" / "info.json").read_text())
    return pq.read_table(folder / "data").to_pydict(), info["features"]


def offsets(table: dict[str, list[Any]], sensor: str) -> list[float]:
    """Displacement of the first marker in each frame: the number of its result."""
    return [markers[0][0] for markers in table[f"observation.tactile.{sensor}.marker_offset"]]


def test_frames_are_those_of_the_same_time(tmp_path: Path) -> None:
    # The right one begins 0.23 s later, is twice as fast, and ends earlier.
    first = {
        "left": results("left", T + np.arange(12) / 10),
        "right": results("right", T + 0.23 + np.arange(15) / 20),
    }
    second = {
        "left": results("left", T + np.arange(3) / 10),
        "right": results("right", T + np.arange(5) / 20),
    }
    table, _ = written(tmp_path, first, second)
    assert offsets(table, "left") == [2, 3, 4, 5, 6, 7, 8, 9, 0, 1, 2]
    assert offsets(table, "right") == [0, 2, 4, 6, 8, 10, 12, 14, 0, 2, 4]
    assert table["episode_index"] == [0] * 8 + [1] * 3
    assert table["timestamp"] == pytest.approx([*np.arange(8) / 10, 0, 0.1, 0.2])


def test_each_sensor_has_columns_of_its_own(tmp_path: Path) -> None:
    scale = Scale(0.1, 0.2, (0.001, 0.001), (31.5, 23.5))
    times = T + np.arange(4) / 10
    both = {"left": results("left", times, scale=scale), "right": results("right", times, width=32)}
    table, features = written(tmp_path, both)
    assert (features[LEFT]["shape"], features[RIGHT]["shape"]) == ([48, 64, 3], [48, 32, 3])
    numbers = {name.removeprefix("observation.tactile.") for name in features if "tactile" in name}
    assert {"left.contact", "left.contact_mm", "right.contact", "right.points"} <= numbers
    assert "right.contact_mm" not in numbers
    assert features["observation.tactile.right.contact"]["names"][0] == "touching"
    assert features["observation.tactile.left.points"]["names"]["components"][0] == "dx_mm"
    assert features["observation.tactile.right.points"]["names"]["components"][0] == "dx_px"
    for camera, width in ((LEFT, 64), (RIGHT, 32)):
        for number, stored in enumerate(table[camera]):
            image = cv2.imdecode(np.frombuffer(stored["bytes"], np.uint8), cv2.IMREAD_COLOR)
            assert np.array_equal(image, picture(number, width))
    stats = json.loads((tmp_path / "meta" / "stats.json").read_text())
    assert stats.keys() == {name for name in features if name.startswith("observation")}


def test_a_window_does_not_reach_before_the_first_frame(tmp_path: Path) -> None:
    both = {
        "left": results("left", T + np.arange(20) / 20),
        "right": results("right", T + 0.5 + np.arange(4) / 10),
    }
    table, features = written(tmp_path, both)
    windows = np.array(table["observation.tactile.left.window"])
    assert windows[:, :, 0].tolist() == [[0, 1], [1, 1], [1, 1], [1, 1]]
    assert np.allclose(windows[1:, :, 1], [-0.05, 0])
    assert "observation.tactile.right.window" not in features


def test_recordings_of_other_sessions_or_sensors_are_refused(tmp_path: Path) -> None:
    writer = DatasetWriter(tmp_path, 10, "pinch", video=False)
    apart = {"left": results("left", T + np.arange(3)), "right": results("right", T + 9 + np.arange(3))}
    with pytest.raises(StageError, match="no time in common: are they of one session"):
        writer.add(apart)
    with pytest.raises(StageError, match="sensors left, middle; the earlier ones are left, right"):
        writer.add({"left": [], "middle": []})


def recorded(path: Path, times: NDArray[np.float64]) -> Path:
    """A recording of another program, with Unix times."""
    pytest.importorskip("mcap_protobuf", reason="the extra record is not installed")
    from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
    from mcap_protobuf.writer import Writer

    with path.open("wb") as file, Writer(file) as writer:
        for number, t in enumerate(times):
            one = CompressedImage(format="png", data=cv2.imencode(".png", picture(number))[1].tobytes())
            one.timestamp.FromNanoseconds(round(t * 1e9))
            writer.write_message("/gel", one, log_time=round(t * 1e9), publish_time=round(t * 1e9))
    return path


@pytest.fixture
def session(tmp_path: Path) -> list[str]:
    """The options for two sensors, the right one of which begins 84 ms later and is twice as fast."""
    (tmp_path / "plain.yaml").write_text(PLAIN)
    left = recorded(tmp_path / "left.mcap", T + np.arange(10) / 25)
    right = recorded(tmp_path / "right.mcap", T + 0.084 + np.arange(11) / 50)
    return [
        *("--sensor", "left", str(left), "--sensor", "right", str(right)),
        *("--pipeline", str(tmp_path / "plain.yaml"), "--fps", "25", "--pictures", "png"),
    ]


def test_a_session_of_two_sensors_comes_back_as_it_was(
    session: list[str], tmp_path: Path, terminal: Terminal
) -> None:
    out = tmp_path / "pinch"
    assert terminal("export", "lerobot", *session, "--out", str(out)) == 0
    assert f"{out}: 1 episode at 25 fps" in terminal.err
    for camera, numbers in ((LEFT, [2, 3, 4, 5, 6, 7]), (RIGHT, [0, 2, 4, 6, 8, 10])):
        reader = open_source(f"lerobot:{out}?camera={camera}&episode=0")
        found = list(iter(reader.read, None))
        reader.close()
        assert [t for _, t in found] == pytest.approx(np.arange(6) / 25)
        assert all(
            np.array_equal(image, picture(number)) for (image, _), number in zip(found, numbers, strict=True)
        )


@needs_datasets
def test_lerobot_loads_both_sensors_to_the_bit(
    session: list[str], tmp_path: Path, terminal: Terminal
) -> None:
    out, loaded_path = tmp_path / "pinch", tmp_path / "loaded.npz"
    assert terminal("export", "lerobot", *session, "--out", str(out)) == 0
    run_with_lerobot(LOADED, str(out), str(loaded_path))
    loaded = dict(np.load(loaded_path))
    for camera, numbers in ((LEFT, range(2, 8)), (RIGHT, range(0, 12, 2))):
        pictures = np.stack([picture(number) for number in numbers])[..., ::-1].transpose(0, 3, 1, 2)
        assert np.array_equal(np.rint(loaded[camera] * 255).astype(np.uint8), pictures)


def test_recordings_without_unix_times_are_taken_to_begin_together(
    tmp_path: Path, terminal: Terminal
) -> None:
    (tmp_path / "plain.yaml").write_text(PLAIN)
    for name in ("left", "right"):
        np.save(tmp_path / f"{name}.npy", np.stack([picture(number) for number in range(4)]))
    sensors = [
        "--sensor",
        "left",
        str(tmp_path / "left.npy"),
        "--sensor",
        "right",
        str(tmp_path / "right.npy"),
    ]
    options = ["--pipeline", str(tmp_path / "plain.yaml"), "--fps", "30", "--out", str(tmp_path / "pinch")]
    assert terminal("export", "lerobot", *sensors, *options) == 0
    assert "no Unix times; all recordings are taken to begin together" in terminal.err
    assert len(pq.read_table(tmp_path / "pinch" / "data")) == 4
    for camera in (LEFT, RIGHT):
        reader = open_source(f"lerobot:{tmp_path / 'pinch'}?camera={camera}&episode=0")
        assert len(list(iter(reader.read, None))) == 4
        reader.close()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["lerobot", "--sensor", "left", "a.npy"], "required two or more, each once and with as many"),
        (["lerobot", "--sensor", "left", "a.npy", "--sensor", "right"], "got left with 1, right with 0"),
        (["lerobot", "--sensor", "left", "a.npy", "--sensor", "left", "b.npy"], "required two or more"),
        (
            ["lerobot", "c.npy", "--sensor", "left", "a.npy", "--sensor", "right", "b.npy"],
            "of every recording",
        ),
        (
            ["hdf5", "--sensor", "left", "a.npy", "--sensor", "right", "b.npy"],
            "hdf5 takes the recordings of one",
        ),
    ],
)
def test_sensors_that_do_not_fit_are_refused(
    arguments: list[str], words: str, tmp_path: Path, terminal: Terminal
) -> None:
    assert terminal("export", *arguments, "--out", str(tmp_path / "out")) == 2
    assert words in terminal.err
    assert not (tmp_path / "out").exists()
