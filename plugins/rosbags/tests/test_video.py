"""Topics with a video: their pictures and times, from any key frame on."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.engine.errors import SourceError
from tests.terminal import Terminal

pytest.importorskip("av", reason="the extra video is not installed")
pytest.importorskip("rosbags", reason="the extra bags is not installed")

import av
from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from plugins.rosbags.tests.bags import BEGIN, PERIOD, TOPIC, write_foxglove
from plugins.rosbags.tests.test_bags import played
from tactflow.plugins.rosbags.video import DEFINITION

GROUP = 5
"""Pictures from one key frame to the next."""
ENCODERS = {"h264": "libx264", "h265": "libx265", "vp9": "libvpx-vp9", "av1": "libsvtav1"}
TYPE = "foxglove_msgs/msg/CompressedVideo"


def pictures(count: int) -> list[NDArray[np.uint8]]:
    """A bright square that moves."""
    images = [np.full((96, 128, 3), (40, 90, 60), np.uint8) for _ in range(count)]
    for index, image in enumerate(images):
        image[30:60, 8 * index : 8 * index + 24] = (200, 120, 180)
    return images


def encoded(images: list[NDArray[np.uint8]], kind: str = "h264") -> list[bytes]:
    """One packet for each picture."""
    options = {
        "h264": {"preset": "ultrafast", "tune": "zerolatency", "crf": "8"},
        "h265": {"preset": "ultrafast", "tune": "zerolatency", "crf": "8", "x265-params": "log-level=none"},
        "vp9": {"deadline": "realtime", "crf": "8", "lag-in-frames": "0"},
        "av1": {"preset": "12", "crf": "8", "svtav1-params": "pred-struct=1:lookahead=0:scm=0"},
    }[kind]
    try:
        encoder = av.CodecContext.create(ENCODERS[kind], "w")
    except Exception:
        pytest.skip(f"PyAV has no encoder {ENCODERS[kind]} here")
    height, width = images[0].shape[:2]
    encoder.width, encoder.height, encoder.pix_fmt = width, height, "yuv420p"
    encoder.framerate, encoder.gop_size, encoder.options = 25, GROUP, options
    frames = [av.VideoFrame.from_ndarray(image, format="bgr24") for image in images]
    packets = [bytes(packet) for frame in [*frames, None] for packet in encoder.encode(frame)]
    assert len(packets) == len(images)
    return packets


def foxglove(path: Path, packets: list[bytes], kind: str = "h264") -> str:
    messages = [CompressedVideo(data=packet, format=kind, frame_id="gel") for packet in packets]
    for index, one in enumerate(messages):
        one.timestamp.FromNanoseconds(BEGIN + index * PERIOD)
    return str(write_foxglove(path, messages))


def errors(found: list[tuple[NDArray[np.uint8], float]], images: list[NDArray[np.uint8]]) -> list[float]:
    return [np.abs(image - 1.0 * one).mean() for (image, _), one in zip(found, images, strict=True)]


@pytest.mark.parametrize("kind", ENCODERS)
def test_each_message_becomes_its_picture_with_its_time(kind: str, tmp_path: Path) -> None:
    images = pictures(12)
    found = played(foxglove(tmp_path / "press.mcap", encoded(images, kind), kind))
    assert [t for _, t in found] == [index / 25 for index in range(12)]
    assert max(errors(found, images)) < 4


@pytest.mark.parametrize("kind", ["sqlite3", "mcap"])
@pytest.mark.parametrize("version", [8, 9])
def test_bags_of_ros_are_read_also_those_without_the_type(kind: str, version: int, tmp_path: Path) -> None:
    images = pictures(4)
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(DEFINITION, TYPE))
    plugin = {"sqlite3": StoragePlugin.SQLITE3, "mcap": StoragePlugin.MCAP}[kind]
    with Writer2(tmp_path / "press", version=version, storage_plugin=plugin) as writer:
        camera = writer.add_connection(TOPIC, TYPE, typestore=store)
        for index, packet in enumerate(encoded(images)):
            taken = BEGIN + index * PERIOD
            stamp = store.types["builtin_interfaces/msg/Time"](sec=taken // 10**9, nanosec=taken % 10**9)
            data = np.frombuffer(packet, np.uint8)
            one = store.types[TYPE](timestamp=stamp, frame_id="gel", data=data, format="h264")
            writer.write(camera, taken + 5000, store.serialize_cdr(one, TYPE))
    found = played(str(tmp_path / "press"))
    assert [t for _, t in found] == [index / 25 for index in range(4)]
    assert max(errors(found, images)) < 4


def test_a_recording_that_begins_between_key_frames_begins_with_the_next(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    images = pictures(12)
    packets = encoded(images)
    with caplog.at_level(logging.WARNING, logger="tactflow"):
        found = played(foxglove(tmp_path / "press.mcap", packets[2:]))
    assert [t for _, t in found] == [index / 25 for index in range(12 - GROUP)]
    assert max(errors(found, images[GROUP:])) < 4
    assert "3 pictures before the first key frame are left out" in caplog.text


@pytest.mark.parametrize(
    ("packets", "kind", "words"),
    [
        (lambda: encoded(pictures(5))[1:], "h264", "no picture of its video can be decoded: there is no key"),
        (lambda: [b"nonsense"] * 3, "h264", "no picture of its video can be decoded"),
        (lambda: [b"x"], "draco", "its video is 'draco'; required one of: h264, h265, vp9, av1"),
    ],
)
def test_what_cannot_be_decoded_is_an_error(packets: Any, kind: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=words):
        played(foxglove(tmp_path / "press.mcap", packets(), kind))


def test_a_run_plays_it(tmp_path: Path, terminal: Terminal) -> None:
    bag = foxglove(tmp_path / "press.mcap", encoded(pictures(12)))
    assert (
        terminal("run", "markerless", "--source", f"{bag}?topic={TOPIC}", "--set", "sinks={}", "--check") == 0
    )
    assert "12 frames" in terminal.err
