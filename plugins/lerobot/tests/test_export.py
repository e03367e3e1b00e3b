"""`tactflow export lerobot`: what it writes is read back, also by LeRobot itself where that is installed."""

from __future__ import annotations

import json
import subprocess
import sys
from contextlib import redirect_stderr
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import tactflow
from plugins.lerobot.tests.lerobot_env import needs_datasets, run_with_lerobot
from tactflow.cli.main import main
from tactflow.engine.errors import StageError
from tactflow.engine.frame import Absent, Frame, Tick
from tactflow.message.episodes import MarkerOrder
from tactflow.message.result import Result
from tactflow.plugins.lerobot.export import DatasetWriter
from tactflow.sources import open_source
from tactflow.vision.types import Contact, Depth, Flow, Force, Markers, Pose, Scale
from tests.messages import Results, result_of

pytest.importorskip("pyarrow", reason="the extra lerobot is not installed")
pytest.importorskip("av", reason="the extra lerobot is not installed")

import pyarrow.parquet as pq

KEY = "observation.images.main"
SPECS = ["sim:press?frames=40&noise=0", "sim:press?frames=30"]
MARKERS = "sim:press?frames=100"
ORIGIN = np.array([[10.0, 10.0], [30.0, 10.0], [50.0, 10.0], [10.0, 30.0], [30.0, 30.0], [50.0, 30.0]])
MAIN = "observation.tactile.main"


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("export") / "press"
    options = ["--out", str(out), "--task", "press", "--pipeline", "markerless"]
    with redirect_stderr(StringIO()) as said:
        assert main(["export", "lerobot", *SPECS, *options]) == 0
    assert "tactflow: INFO: 800 x 600 becomes 300 x 400 by downsample and rotate" in said.getvalue()
    return out


@pytest.fixture(scope="module")
def with_markers(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("export") / "markers"
    with redirect_stderr(StringIO()):
        assert main(["export", "lerobot", MARKERS, "--out", str(out), "--pictures", "png"]) == 0
    return out


def test_each_recording_is_an_episode_with_its_contacts(dataset: Path) -> None:
    info = json.loads((dataset / "meta" / "info.json").read_text())
    assert (info["codebase_version"], info["fps"], info["total_frames"]) == ("v3.0", 60, 70)
    for episode, spec in enumerate(SPECS):
        results = list(tactflow.stream("markerless", source=spec, settings={"sinks": {}}, images=True))
        rows = pq.read_table(dataset / f"data/chunk-000/file-00{episode}.parquet").to_pylist()
        assert [row["frame_index"] for row in rows] == list(range(len(results)))
        assert [row["index"] for row in rows] == list(range(40 * episode, 40 * episode + len(results)))
        for row, result in zip(rows, results, strict=True):
            contact = row["observation.tactile.contact"]
            assert contact[0] == (result.contact is not None)
            if result.contact is not None:
                assert np.allclose(contact[1:4], [*result.contact.center, result.contact.area])
        reader = open_source(f"lerobot:{dataset}?camera={KEY}&episode={episode}")
        frames = list(iter(reader.read, None))
        reader.close()
        assert [t for _, t in frames] == [index / 60 for index in range(len(results))]
        # A video loses some of the colour.
        errors = [
            np.abs(image - 1.0 * result.image).mean()
            for (image, _), result in zip(frames, results, strict=True)
        ]
        assert max(errors) < 4


def test_statistics_are_those_of_the_numbers(dataset: Path) -> None:
    stats = json.loads((dataset / "meta" / "stats.json").read_text())
    rows = pq.read_table(dataset / "data")["observation.tactile.contact"].to_pylist()
    assert np.allclose(stats["observation.tactile.contact"]["mean"], np.mean(rows, 0), rtol=1e-5)
    assert np.allclose(stats["observation.tactile.contact"]["std"], np.std(rows, 0), rtol=1e-5)
    assert np.shape(stats[KEY]["mean"]) == (3, 1, 1)


POSE_NAMES = ["known", "x_mm", "y_mm", "z_mm", "rx_deg", "ry_deg", "rz_deg"]
POSE = Pose("tracked", 0, (0.0, 0.0, 0.0), (0.1, 0.2, -0.3), (0.0, 5.0, -10.0), np.eye(6))
LOST = replace(POSE, status="lost")


def touched(scale: Scale | None, depth: Depth | None = None, force: Force | None = None) -> Result:
    """A frame with a contact whose centre is 10 px right of the middle, 5 px below it."""
    contact = Contact(400.0, (41.5, 28.5), 90.0, None, np.zeros((0, 2)), None)
    image = np.zeros((48, 64, 3), np.uint8)
    flow = Flow((2.0, -1.0), 3)
    results = Results(image, contact, flow, scale=scale, depth=depth, force=force)
    return result_of(Tick(Frame("main", 0, 0.0, image)), results)


def test_a_calibrated_recording_has_millimetres_and_newtons(tmp_path: Path) -> None:
    scale = Scale(0.1, 0.2, (0.001, 0.001), (31.5, 23.5))
    depth = Depth(np.zeros((48, 64), np.float32), 0.75, None, 3.5, None)
    results = [
        touched(scale, depth, Force((0.5, -0.25, 2.5), (0.1, 0.1, 0.1), in_range=True)).replace(pose=POSE),
        touched(scale, depth, Force((None, None, 4.5), (None, None, 0.1), in_range=False)).replace(pose=LOST),
        touched(scale),
        touched(scale).replace(contact=None, flow=None),
    ]
    frames = [
        Result(replace(result.frame, seq=index, t=index / 10), dict(result))
        for index, result in enumerate(results)
    ]
    writer = DatasetWriter(tmp_path, 10, "press")
    writer.add(frames)
    writer.finish()
    table = pq.read_table(tmp_path / "data").to_pydict()
    info = json.loads((tmp_path / "meta" / "info.json").read_text())
    stats = json.loads((tmp_path / "meta" / "stats.json").read_text())
    place, nowhere = [1.0, 1.0, 1.0, 8.0], [0.0, 0.0, 0.0, 0.0]
    for name, names, values in (
        ("contact_mm", ["touching", "x_mm", "y_mm", "area_mm2"], [place, place, place, nowhere]),
        ("flow_mm", ["known", "dx_mm", "dy_mm"], [[1, 0.2, -0.2]] * 3 + [[0, 0, 0]]),
        ("depth", ["known", "depth_mm", "volume_mm3"], [[1, 0.75, 3.5]] * 2 + [[0, 0, 0]] * 2),
        ("force", ["known", "z_N", "in_range"], [[1, 2.5, 1], [1, 4.5, 0], [0, 0, 0], [0, 0, 0]]),
        ("drag", ["known", "x_N", "y_N"], [[1, 0.5, -0.25]] + [[0, 0, 0]] * 3),
        ("pose", POSE_NAMES, [[1, 0.1, 0.2, -0.3, 0, 5, -10]] + [[0] * 7] * 3),
    ):
        feature = f"observation.tactile.{name}"
        assert np.allclose(table[feature], values), name
        assert info["features"][feature] == {"dtype": "float32", "shape": [len(names)], "names": names}
        assert np.allclose(stats[feature]["mean"], np.mean(values, 0))


@pytest.mark.parametrize(("first", "said"), [(True, "without"), (False, "with")])
def test_a_dataset_is_not_calibrated_in_part(tmp_path: Path, first: bool, said: str) -> None:
    scale = Scale(0.1, 0.1, (0.001, 0.001), (31.5, 23.5))
    writer = DatasetWriter(tmp_path, 10, "press")
    writer.add([touched(scale if first else None)])
    with pytest.raises(StageError, match=f"{said} calibration; the earlier ones"):
        writer.add([touched(None if first else scale)])


def test_a_recording_brings_its_calibration_into_the_dataset(tmp_path: Path) -> None:
    pytest.importorskip("mcap", reason="the extra record is not installed")
    source, recording = "sim:press?frames=20", tmp_path / "press.mcap"
    calibrate = ["calibrate", "--from", source, "--pitch", "1.724", "--out", str(tmp_path / "main.yaml")]
    assert main(calibrate) == 0
    settings = {"calibration": str(tmp_path / "main.yaml"), "sinks": {"record": {"path": str(recording)}}}
    assert tactflow.run(source=source, settings=settings).exit_code == 0
    assert main(["export", "lerobot", str(recording), "--out", str(tmp_path / "press")]) == 0
    rows = pq.read_table(tmp_path / "press" / "data").to_pylist()
    results = list(tactflow.stream(source=str(recording), settings={"sinks": {}}))
    for row, result in zip(rows, results, strict=True):
        known, x, _, _ = row["observation.tactile.contact_mm"]
        assert known == (result.contact is not None)
        if result.contact is not None and result.scale is not None:
            assert x == pytest.approx(result.scale.point(result.contact.center)[0])
    assert any(row["observation.tactile.contact_mm"][0] for row in rows)


def test_a_dataset_holds_the_markers_that_were_found(with_markers: Path) -> None:
    results = list(tactflow.stream(source=MARKERS, settings={"sinks": {}}))
    found = np.stack([r.markers.displacement for r in results if r.markers is not None])
    status = np.stack([r.markers.status for r in results if r.markers is not None])
    assert found.shape == (100, 80, 2)
    assert np.abs(found).max() > 1

    table = pq.read_table(with_markers / "data").to_pydict()
    assert np.array_equal(np.array(table[f"{MAIN}.marker_offset"], np.float32), found.astype(np.float32))
    assert np.array_equal(table[f"{MAIN}.marker_status"], status)


def frames_of(*markers: Markers | None, scale: Scale | None = None, depth: Any = None) -> list[Result]:
    """A result for each, ten a second, of 64 x 48 pixels."""
    image = np.zeros((48, 64, 3), np.uint8)
    return [
        result_of(
            Tick(Frame("main", index, index / 10, image)),
            Results(image, markers=found, scale=scale, depth=depth),
        )
        for index, found in enumerate(markers)
    ]


def moved(offset: tuple[float, float], origin: np.ndarray = ORIGIN, status: int = 0) -> Markers:
    count = len(origin)
    return Markers(origin, origin + offset, np.full(count, status, np.uint8), np.zeros(count))


def test_markers_keep_their_place_in_recordings_that_found_others(tmp_path: Path) -> None:
    fewer = ORIGIN[[5, 3, 2, 1, 0]] + 2.0
    writer = DatasetWriter(tmp_path, 10, "press")
    for markers in (moved((1.0, 0.0)), moved((3.0, 0.0), fewer)):
        writer.add(frames_of(None, markers))
    writer.finish()
    table = pq.read_table(tmp_path / "data").to_pydict()
    status = [[2] * 6, [0] * 6, [2] * 6, [0, 0, 0, 0, 2, 0]]
    assert table[f"{MAIN}.marker_status"] == status
    assert np.array_equal(np.array(table[f"{MAIN}.marker_offset"])[:, :, 0], np.outer([0, 1, 0, 3], [1] * 6))


def test_a_gel_that_was_moved_is_refused() -> None:
    order = MarkerOrder()
    order.align(moved((0.0, 0.0)))
    with pytest.raises(StageError, match="only 0 of 6 markers are where"):
        order.align(moved((0.0, 0.0), ORIGIN + 10.5))
    with pytest.raises(StageError, match="only 0 of 6"):
        order.align(moved((0.0, 0.0), np.zeros((0, 2))))


def test_a_recording_with_markers_after_one_without_is_refused(tmp_path: Path) -> None:
    writer = DatasetWriter(tmp_path, 10, "press")
    writer.add(frames_of(None))
    with pytest.raises(StageError, match="has markers, and the recordings before have none"):
        writer.add(frames_of(moved((0.0, 0.0))))


def test_points_are_in_millimetres_and_what_is_unknown_is_masked(tmp_path: Path) -> None:
    heights = np.zeros((48, 64), np.float32)
    heights[:, :20] = 0.5
    scale, depth = Scale(0.1, 0.2, (0.001, 0.001), (31.5, 23.5)), Depth(heights, 0.5, None, 1.0, None)
    status = np.array([0, 0, 1, 0, 0, 2], np.uint8)
    markers = replace(moved((2.0, -1.0)), status=status)
    writer = DatasetWriter(tmp_path, 10, "press")
    for found in (depth, None, Absent("no_contact")):
        writer.add(frames_of(markers, scale=scale, depth=found))
    writer.finish()
    table = pq.read_table(tmp_path / "data").to_pydict()
    pressed, without_depth, untouched = points = np.array(table[f"{MAIN}.points"])
    assert np.allclose(pressed[:5, :3], [[0.2, -0.2, -0.5 * (x < 20)] for x, _ in ORIGIN[:5]])
    assert np.isnan(without_depth[:, 2]).all()
    assert np.allclose(untouched[:5, :3], [0.2, -0.2, 0.0])
    # The forces on single markers, and all of the lost one.
    assert np.isnan(points[:, :, 3:]).all()
    assert np.isnan(points[:, 5]).all()
    assert np.array_equal(np.isfinite(points), table[f"{MAIN}.points_mask"])
    info = json.loads((tmp_path / "meta" / "info.json").read_text())["features"]
    components = {"components": ["dx_mm", "dy_mm", "dz_mm", "Fx_N", "Fy_N", "Fz_N"]}
    assert info[f"{MAIN}.points"] == {"dtype": "float32", "shape": [6, 6], "names": components}
    assert info[f"{MAIN}.points_mask"]["dtype"] == "bool"
    mean = json.loads((tmp_path / "meta" / "stats.json").read_text())[f"{MAIN}.points"]["mean"]
    assert np.allclose(mean[0], [0.2, -0.2, -0.25, 0, 0, 0])


def test_points_of_an_uncalibrated_sensor_are_in_pixels(tmp_path: Path) -> None:
    writer = DatasetWriter(tmp_path, 10, "press")
    writer.add(frames_of(moved((2.0, -1.0)), depth=Absent("no_contact")))
    writer.finish()
    points = np.array(pq.read_table(tmp_path / "data").to_pydict()[f"{MAIN}.points"])[0]
    assert np.array_equal(points[:, :2], [[2.0, -1.0]] * 6)
    assert np.isnan(points[:, 2:]).all()
    info = json.loads((tmp_path / "meta" / "info.json").read_text())["features"]
    assert info[f"{MAIN}.points"]["names"]["components"][:2] == ["dx_px", "dy_px"]


def test_a_window_holds_all_results_since_the_frame_before(tmp_path: Path) -> None:
    writer = DatasetWriter(tmp_path, 5, "press")
    results = frames_of(*[moved((0.0, 0.0))] * 6)
    results[1] = Result(results[1].frame, dict(results[1]) | dict(touched(None)))
    del results[3]
    writer.add(results)
    writer.add(frames_of(moved((0.0, 0.0))))
    writer.finish()
    windows = np.array(pq.read_table(tmp_path / "data").to_pydict()[f"{MAIN}.window"])
    # Frames at 0, 0.2 and 0.4 s, of which that at 0.3 s is missing, and at 0 s of the second episode.
    assert windows.shape == (4, 2, 10)
    assert windows[:, :, 0].tolist() == [[0, 1], [1, 1], [0, 1], [0, 1]]
    assert np.allclose(windows[:, :, 1], [[0, 0], [-0.1, 0], [0, 0], [0, 0]])
    assert np.allclose(windows[1, 0, 2:], [1, 41.5, 28.5, 400, np.pi / 2, 1, 2, -1])
    assert not windows[1, 1, 2:].any()
    info = json.loads((tmp_path / "meta" / "info.json").read_text())["features"]
    components = info[f"{MAIN}.window"]["names"]["components"]
    assert components[:4] == ["known", "t_s", "contact.touching", "contact.x"]
    assert len(components) == 10


def test_a_dataset_at_the_rate_of_the_recording_needs_no_window(with_markers: Path) -> None:
    info = json.loads((with_markers / "meta" / "info.json").read_text())
    assert not [name for name in info["features"] if name.endswith(".window")]


OPENED = """
import sys
from lerobot.datasets.lerobot_dataset import LeRobotDataset
dataset = LeRobotDataset("tactflow/press", root=sys.argv[1], video_backend="pyav")
item = dataset[45]
print(dataset.num_episodes, dataset.num_frames, dataset.fps, item["task"], int(item["episode_index"]),
    *(tuple(item[name].shape) for name in sys.argv[2:]), sep="; ")
"""


FULL_DISK = """
import sys
import tactflow
from pathlib import Path
from tactflow.plugins.lerobot.export import DatasetWriter
settings = {"sinks": {}}
try:
    DatasetWriter(Path(sys.argv[1]), 60, "press").add(
        tactflow.stream("markerless", source=sys.argv[2], settings=settings, images=True))
except OSError as error:
    print(error.strerror)
"""


LOADED = """
import sys
import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset
dataset = LeRobotDataset("tactflow/press", root=sys.argv[1])
items = [dataset[index] for index in range(len(dataset))]
np.savez(sys.argv[2], **{name: np.stack([np.asarray(item[name]) for item in items])
    for name in items[0] if name.startswith("observation.")})
"""


@needs_datasets
def test_lerobot_loads_every_number_and_picture_to_the_bit(tmp_path: Path) -> None:
    out, loaded_path = tmp_path / "press", tmp_path / "loaded.npz"
    results = list(tactflow.stream(source="sim:press?frames=59", settings={"sinks": {}}, images=True))
    writer = DatasetWriter(out, 30, "press", video=False)
    writer.add(results)
    writer.finish()
    run_with_lerobot(LOADED, str(out), str(loaded_path))
    loaded = dict(np.load(loaded_path))
    table = pq.read_table(out / "data").to_pydict()
    features = json.loads((out / "meta" / "info.json").read_text())["features"]
    assert features[f"{MAIN}.window"]["shape"] == [2, 10]
    for name in features:
        if name.startswith("observation.tactile."):
            stored = np.array(table[name], features[name]["dtype"])
            assert np.array_equal(loaded[name], stored, equal_nan=stored.dtype.kind == "f"), name
    pictures = np.stack([result.image for result in results[::2] if result.image is not None])[..., ::-1]
    assert np.array_equal(np.rint(loaded[KEY] * 255).astype(np.uint8), pictures.transpose(0, 3, 1, 2))
    found = [result.markers.displacement for result in results[::2] if result.markers is not None]
    offsets = np.stack(found).astype(np.float32)
    assert np.array_equal(loaded[f"{MAIN}.points"][..., :2], offsets)
    mask = [True, True, False, False, False, False]
    assert np.array_equal(loaded[f"{MAIN}.points_mask"], np.broadcast_to(mask, (30, 80, 6)))


@needs_datasets
def test_lerobot_opens_it(dataset: Path, with_markers: Path) -> None:
    opened = run_with_lerobot(OPENED, str(dataset), KEY, "observation.tactile.contact")
    assert opened == "2; 70; 60; press; 1; (3, 400, 300); (5,)"
    opened = run_with_lerobot(OPENED, str(with_markers), f"{MAIN}.marker_offset", f"{MAIN}.marker_status")
    assert opened == "1; 100; 60; touch; 0; (80, 2); (80,)"


def test_what_cannot_be_exported_is_refused_and_leaves_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data, out = tmp_path / "data", tmp_path / "press"
    data.mkdir()
    first, small, odd = (str(data / name) for name in ("first.npy", "small.npy", "odd.npy"))
    for path, width in ((first, 64), (small, 32), (odd, 62)):
        np.save(path, np.zeros((3, 48, width, 3), np.uint8))
    for arguments, code, said in (
        ([first, "no-such.mcap"], 4, "no-such.mcap: no such file"),
        (
            [first, small],
            3,
            "small.npy: observation.images.main, 24 x 16 pixels, without calibration; the earlier ones",
        ),
        ([odd], 3, "a video needs even numbers; give --pictures png"),
        ([first, "--fps", "0"], 2, "--fps: required 1 to 1000"),
        ([first, "--fps", "9" * 20], 2, "--fps: required 1 to 1000"),
    ):
        assert main(["export", "lerobot", *arguments, "--out", str(out), "--pipeline", "markerless"]) == code
        assert said in capsys.readouterr().err
        assert list(tmp_path.iterdir()) == [data]


@pytest.mark.skipif(sys.platform != "linux", reason="/dev/full stands for a full disk")
@pytest.mark.parametrize("frames", [1, 30])
def test_a_disk_that_is_full_from_the_first_byte_of_the_video_is_told(tmp_path: Path, frames: int) -> None:
    # In a process of its own: libav ends it where it is told to go on after such a failure.
    video = tmp_path / "press" / "videos" / KEY / "chunk-000" / "file-000.mp4"
    video.parent.mkdir(parents=True)
    video.symlink_to("/dev/full")
    command = [sys.executable, "-c", FULL_DISK, str(tmp_path / "press"), f"sim:press?frames={frames}"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "No space left on device\n"), done.stderr
