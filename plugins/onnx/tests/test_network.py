"""Networks of one's own in the graph, from ONNX files that are made here."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

import tactflow
from tactflow.engine.errors import ConfigError, StageError
from tactflow.message.result import Result
from tactflow.plugins.onnx.network import Network
from tactflow.vision.depth.surface import Rest, Surface
from tactflow.vision.types import Depth, Markers, Scale
from tests.paths import REPOSITORY

pytest.importorskip("onnx", reason="the package onnx, which makes files, is not installed")
pytest.importorskip("onnxruntime", reason="the extra onnx is not installed")

import onnx
import onnxruntime
from onnx import TensorProto, helper, numpy_helper

EXAMPLES = REPOSITORY / "examples" / "networks"
GREY = np.full((6, 8, 3), 100, np.uint8)


def save(
    path: Path,
    nodes: list[Any],
    shapes: dict[str, Any],
    out: dict[str, Any],
    dtype: int = TensorProto.FLOAT,
    **weights: Any,
) -> Path:
    """Write a network. shapes, out : name -> axes. dtype : of the inputs. weights : name -> array."""
    infos = [
        [helper.make_tensor_value_info(name, kind, axes) for name, axes in side.items()]
        for side, kind in ((shapes, dtype), (out, TensorProto.FLOAT))
    ]
    constants = [numpy_helper.from_array(np.asarray(value), name) for name, value in weights.items()]
    graph = helper.make_graph(nodes, "network", *infos, constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    path.write_bytes(model.SerializeToString())
    return path


def echo(path: Path, *shape: Any) -> Path:
    """A network that gives back what it gets."""
    return save(path, [helper.make_node("Identity", ["x"], ["y"])], {"x": shape}, {"y": shape})


def network(file: Path, settings: dict[str, Any], outputs: dict[str, Any] | None = None) -> Network:
    stage: Any = tactflow.stage(
        "network",
        file=str(file),
        inputs={"x": settings},
        outputs=outputs or {"y": {"shape": ("C", "H", "W")}},
    )
    assert isinstance(stage, Network)
    assert isinstance(stage.params, tactflow.StageParams)
    return stage


def seen(file: Path, settings: dict[str, Any], *inputs: Any) -> NDArray[np.float32]:
    """What a network gets of one frame."""
    shape = tuple(f"n{axis}" for axis in range(len(onnx_axes(file)) - 1))
    (found,) = network(file, settings, {"y": {"shape": shape}}).process(*inputs)
    return np.asarray(found)


def onnx_axes(file: Path) -> list[Any]:
    return list(onnx.load(file).graph.input[0].type.tensor_type.shape.dim)


def test_a_picture_is_scaled_ordered_and_normalised_as_by_hand(tmp_path: Path) -> None:
    file = echo(tmp_path / "n.onnx", 1, 3, 6, 8)
    image = np.random.default_rng(0).integers(0, 256, (6, 8, 3), np.uint8)
    found = seen(file, {"colour": "rgb", "mean": (0.5, 0.4, 0.3), "std": (0.2, 0.3, 0.4)}, image)
    by_hand = (image[..., ::-1] / 255 - (0.5, 0.4, 0.3)) / (0.2, 0.3, 0.4)
    np.testing.assert_allclose(found, np.moveaxis(by_hand, -1, 0), atol=1e-5)


@pytest.mark.parametrize("background", ["subtract", "subtract_half", "concat"])
def test_the_untouched_gel_is_taken_off_or_added(tmp_path: Path, background: str) -> None:
    file = echo(tmp_path / "n.onnx", 1, 6 if background == "concat" else 3, 6, 8)
    rng = np.random.default_rng(1)
    image, rest = (rng.integers(0, 256, (6, 8, 3), np.uint8) for _ in range(2))
    found = seen(file, {"background": background, "mean": (0.5,), "std": (0.25,)}, image, rest)
    change = (image.astype(float) - rest) / 255
    by_hand = {
        "subtract": change,
        "subtract_half": np.clip(change + 0.5, 0, 1),
        "concat": np.concatenate([image, rest], axis=2) / 255,
    }[background]
    np.testing.assert_allclose(found, np.moveaxis((by_hand - 0.5) / 0.25, -1, 0), atol=1e-5)


def test_a_network_for_pixels_gets_colours_and_places(tmp_path: Path) -> None:
    file = echo(tmp_path / "n.onnx", "pixels", 5)
    image = np.arange(144, dtype=np.uint8).reshape(6, 8, 3)
    stage = network(file, {"layout": "pixels", "coordinates": True}, {"y": {"shape": ("N", 5)}})
    (found,) = stage.process(image)
    rows, columns = np.mgrid[:6, :8]
    by_hand = np.dstack([image / 255, columns / 8, rows / 6]).reshape(-1, 5)
    np.testing.assert_allclose(found, by_hand, atol=1e-6)


def test_a_picture_is_resized_to_the_size_of_the_input(tmp_path: Path) -> None:
    assert (seen(echo(tmp_path / "n.onnx", 1, 3, 16, 16), {"scale": 1.0}, GREY) == 100).all()


def test_several_frames_lie_a_stride_apart_and_the_first_fills_in(tmp_path: Path) -> None:
    stage = network(echo(tmp_path / "n.onnx", 1, 6, 6, 8), {"frames": 2, "stride": 2, "scale": 1.0})
    frames = [np.full((6, 8, 3), number, np.uint8) for number in range(4)]
    found = [stage.process(frame)[0][[0, 3], 0, 0].tolist() for frame in frames]
    assert found == [[0, 0], [0, 1], [0, 2], [1, 3]]
    stage.reset()
    assert stage.process(frames[3])[0][[0, 3], 0, 0].tolist() == [3, 3]


def test_channels_can_come_last(tmp_path: Path) -> None:
    file, outputs = echo(tmp_path / "n.onnx", 1, 6, 8, 3), {"y": {"shape": ("H", "W", 3)}}
    (found,) = network(file, {"layout": "hwc", "scale": 1.0}, outputs).process(GREY)
    np.testing.assert_array_equal(found, GREY)


def test_markers_depth_and_ports_of_others_are_inputs_too(tmp_path: Path) -> None:
    origin = np.array([[1.0, 2.0], [3.0, 4.0]])
    markers = Markers(origin, origin + 0.5, np.zeros(2, np.uint8), np.zeros(2))
    table = {"port": "markers", "layout": "pixels", "scale": 1.0}
    found = seen(echo(tmp_path / "m.onnx", 1, 2, 4), table, markers)
    assert found.tolist() == [[1, 2, 0.5, 0.5], [3, 4, 0.5, 0.5]]
    heights = np.random.default_rng(0).random((6, 8), np.float32)
    file = echo(tmp_path / "d.onnx", 1, 1, 6, 8)
    depth = Depth(heights, 1.0, None, 1.0, None)
    np.testing.assert_allclose(seen(file, {"port": "depth", "scale": 2.0}, depth)[0], 2 * heights)
    np.testing.assert_allclose(seen(file, {"port": "warmth", "scale": 1.0}, heights)[0], heights)
    six, means = np.arange(288, dtype=np.float32).reshape(6, 8, 6), tuple(map(float, range(6)))
    given = seen(
        echo(tmp_path / "s.onnx", 1, 6, 6, 8),
        {"port": "six", "scale": 1.0, "colour": "rgb", "mean": means},
        six,
    )
    np.testing.assert_allclose(given, np.moveaxis(six - means, -1, 0))
    with pytest.raises(StageError, match="required an array"):
        network(file, {"port": "warmth"}).process("warm")


@pytest.mark.parametrize(
    ("shape", "settings", "words"),
    [
        ((1, 6, 224, 224), {}, r"takes \(1, 6, 224, 224\), but the settings give \(3, 224, 224\)"),
        ((1, 3, 6, 8), {"size": (4, 4)}, r"takes \(1, 3, 6, 8\), but the settings give \(3, 4, 4\)"),
        (("N", 3), {"layout": "pixels", "coordinates": True}, r"\(any, 3\), but .* \(any, 5\)"),
        ((1, 6, 6, 8), {"frames": 3, "colour": "grey"}, r"\(1, 6, 6, 8\), but .* \(3, 6, 8\)"),
    ],
)
def test_shapes_that_do_not_fit_are_refused_at_load(
    tmp_path: Path, shape: tuple[Any, ...], settings: dict[str, Any], words: str
) -> None:
    file = echo(tmp_path / "n.onnx", *shape)
    with pytest.raises(StageError, match=words):
        network(file, settings)


@pytest.mark.parametrize(
    ("outputs", "words"),
    [
        ({"force": {}}, r"force: required 1 number \(z\) or 3 \(x, y, z\), got 144"),
        ({"gradients": {}}, r"required an output of the size of the input, \(2, 6, 8\), got \(1, 3, 6, 8\)"),
        ({"z": {"output": "z"}}, "there is no output z; there are y"),
    ],
)
def test_outputs_that_do_not_fit_are_refused(tmp_path: Path, outputs: dict[str, Any], words: str) -> None:
    file = echo(tmp_path / "n.onnx", 1, 3, 6, 8)
    with pytest.raises(StageError, match=words):
        network(file, {}, outputs).process(GREY)


def test_what_is_no_network_is_refused_with_what_to_do(tmp_path: Path) -> None:
    file = tmp_path / "n.onnx"
    with pytest.raises(StageError, match=r"cannot read the network .*: No such file"):
        network(file, {})
    file.write_bytes(b"\x08\x01no network")
    with pytest.raises(StageError, match="cannot be used as an ONNX file"):
        network(file, {})
    foreign = helper.make_node("Run", ["x"], ["y"], domain="com.example")
    save(file, [foreign], {"x": [1, 3, 6, 8]}, {"y": [1, 3, 6, 8]})
    with pytest.raises(StageError, match="cannot be used"):
        network(file, {})
    echo(file, 1, 3, 6, 8)
    with pytest.raises(StageError, match="its inputs are x, but inputs: has picture"):
        tactflow.stage("network", file=str(file), inputs={"picture": {}}, outputs={"y": {}})
    with pytest.raises(StageError, match=r"there is no provider TPU here; there are .*CPUExecutionProvider"):
        tactflow.stage("network", file=str(file), inputs={"x": {}}, outputs={"y": {}}, provider="TPU")


def test_a_provider_without_its_driver_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # onnxruntime goes on with the CPU, with a warning.
    cuda = "CUDAExecutionProvider"
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: [cuda])
    file = echo(tmp_path / "n.onnx", 1, 3, 6, 8)
    with (
        pytest.warns(UserWarning, match=cuda),
        pytest.raises(StageError, match=f"{cuda} cannot be used here"),
    ):
        tactflow.stage("network", file=str(file), inputs={"x": {}}, outputs={"y": {}}, provider=cuda)


@pytest.mark.parametrize("rest", [None, np.zeros((3, 4, 3), np.uint8)])
def test_an_untouched_gel_that_is_missing_or_of_another_size_is_refused(tmp_path: Path, rest: Any) -> None:
    stage = network(echo(tmp_path / "n.onnx", 1, 3, 6, 8), {"background": "subtract"})
    with pytest.raises(StageError, match=r"required an untouched gel of \(6, 8, 3\), got"):
        stage.process(GREY, rest)


def test_bytes_are_not_scaled_to_zero_and_one(tmp_path: Path) -> None:
    file = save(
        tmp_path / "n.onnx",
        [helper.make_node("Cast", ["x"], ["y"], to=TensorProto.FLOAT)],
        {"x": [1, 3, 6, 8]},
        {"y": [1, 3, 6, 8]},
        dtype=TensorProto.UINT8,
    )
    with pytest.raises(StageError, match=r"takes bytes, but scale brings them to 0\.\.1: give scale: 1"):
        network(file, {})
    assert (seen(file, {"scale": 1.0}, GREY) == 100).all()


def test_weights_in_another_file_are_not_read(tmp_path: Path) -> None:
    file = save(
        tmp_path / "n.onnx",
        [helper.make_node("Add", ["x", "w"], ["y"])],
        {"x": [1, 3, 6, 8]},
        {"y": [1, 3, 6, 8]},
        w=np.ones((1, 3, 6, 8), np.float32),
    )
    onnx.save(onnx.load(file), file, save_as_external_data=True, location="weights", size_threshold=0)
    with pytest.raises(StageError, match="cannot be used"):
        network(file, {})


def test_settings_that_contradict_each_other_are_mistakes(tmp_path: Path) -> None:
    file = echo(tmp_path / "n.onnx", 1, 3, 6, 8)
    for settings, words in (
        ({"frames": 2, "layout": "pixels"}, "several frames need"),
        ({"port": "depth", "background": "subtract"}, "not a picture"),
    ):
        with pytest.raises(ConfigError, match=words):
            network(file, settings)
    with pytest.raises(StageError, match="mean has 2 numbers for 3 channels"):
        network(file, {"mean": (0.1, 0.2)}).process(GREY)


def pooled(path: Path, channels: int, count: int, shape: tuple[Any, ...] = (224, 224)) -> Path:
    """An encoder with random weights: the mean of each channel, times a matrix."""
    nodes = [
        helper.make_node("ReduceMean", ["frames"], ["mean"], axes=[2, 3], keepdims=0),
        helper.make_node("MatMul", ["mean", "w"], ["embedding"]),
    ]
    weights = np.random.default_rng(0).random((channels, count), np.float32)
    return save(path, nodes, {"frames": [1, channels, *shape]}, {"embedding": [1, count]}, w=weights)


def copied(tmp_path: Path, name: str) -> Path:
    """An example in a folder of its own, where a network can be put beside it."""
    return Path(shutil.copy(EXAMPLES / name, tmp_path / name))


def test_the_encoder_of_the_examples_gives_features_to_messages_and_tables(tmp_path: Path) -> None:
    pooled(tmp_path / "encoder.onnx", 6, 4)
    settings = {"sinks": {}, "stages.network.queue.when_full": "block"}
    results = list(
        tactflow.stream(
            copied(tmp_path, "encoder.yaml"), source="sim:press", settings=settings, images=True, max_frames=9
        )
    )
    weights = np.random.default_rng(0).random((6, 4), np.float32)
    rest = results[0].image
    assert rest is not None
    for number in (0, 3, 8):
        means = []
        for back in (5, 0):
            image = results[max(0, number - back)].image
            assert image is not None
            resized = [cv2.resize(part, (224, 224))[..., ::-1].astype(float) for part in (image, rest)]
            means += list(np.clip((resized[0] - resized[1]) / 255 + 0.5, 0, 1).mean(axis=(0, 1)))
        features = results[number].features
        assert features is not None
        np.testing.assert_allclose(features.values, np.array(means) @ weights, rtol=1e-4)
        message = results[number].to_dict()
        assert message["features"] == {"values": pytest.approx(features.values.tolist()), "unit": "1"}
        assert np.array_equal(Result.from_message(message)["features"].values, features.values)


@pytest.mark.parametrize("name", ["encoder.yaml", "gradients.yaml"])
def test_the_examples_are_right_before_their_files_are_there(name: str) -> None:
    assert tactflow.check(EXAMPLES / name) == []
    with pytest.raises(StageError, match="cannot read the network"):
        tactflow.run(
            EXAMPLES / name,
            source="sim:press",
            settings={"sinks": {"jsonl": {"path": os.devnull}}},
            max_frames=1,
        )


def test_a_force_and_a_contact_mask_reach_the_message(tmp_path: Path) -> None:
    image = np.zeros((6, 8, 3), np.uint8)
    image[2:4, 3:6] = 200
    mean = [helper.make_node("ReduceMean", ["x"], ["y"], axes=[2, 3], keepdims=0)]
    save(tmp_path / "f.onnx", mean, {"x": [1, 3, 6, 8]}, {"y": [1, 3]})
    (force,) = network(tmp_path / "f.onnx", {}, {"force": {"scale": 2.0}}).process(image)
    assert force.value == pytest.approx((200 / 255 / 4,) * 3)
    assert not force.in_range
    message = Result(tactflow.Frame("main", 0, 0.0, image), {"force": force}).to_dict()
    assert message["force"]["stderr"] == [None, None, None]
    stage = network(echo(tmp_path / "m.onnx", 1, 1, 6, 8), {"colour": "grey"}, {"contact_mask": {}})
    mask, touching = stage.process(image)
    assert touching
    assert np.array_equal(mask > 0, image[..., 0] > 0)
    assert stage.process(GREY * 0)[1] is False


def test_gradients_at_another_size_come_back_at_that_of_the_port(tmp_path: Path) -> None:
    keep = helper.make_node("Slice", ["x", "start", "end", "axis"], ["y"])
    ends = {"start": np.array([0]), "end": np.array([2]), "axis": np.array([1])}
    save(tmp_path / "g.onnx", [keep], {"x": [1, 3, 16, 16]}, {"y": [1, 2, 16, 16]}, **ends)
    stage = network(tmp_path / "g.onnx", {"scale": 1.0}, {"gradients": {"scale": -0.01}})
    (gradients,) = stage.process(GREY)
    assert gradients.shape == (6, 8, 2)
    np.testing.assert_allclose(gradients, -1.0)


def test_depth_integrates_gradients_without_colours() -> None:
    rows, columns = np.mgrid[:96, :128]
    heights = 0.8 * np.exp(-((columns - 64.0) ** 2 + (rows - 48.0) ** 2) / (2 * 10.0**2))
    down, across = np.gradient(heights, 0.1)
    gradients = np.dstack([across, down]).astype(np.float32)
    mask = np.where(heights > 0.1, 255, 0).astype(np.uint8)
    gel = np.full((96, 128, 3), 100, np.uint8)
    surface = Surface(None, Scale(0.1, 0.1, (0.0, 0.0), (47.5, 31.5)))
    depth = surface.depth(gel, Rest(gel), mask, gradients)
    assert np.abs(depth.heights - heights)[mask > 0].max() < 0.03
    assert depth.greatest_stderr is None
