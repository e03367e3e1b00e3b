"""Recordings of ROS and Foxglove: their pictures and times as they were recorded, and clear errors."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.engine.errors import SourceError
from tactflow.sources import open_source
from tests.terminal import Terminal

pytest.importorskip("rosbags", reason="the extra bags is not installed")

from plugins.rosbags.tests.bags import BEGIN, PERIOD, TOPIC, write_bag, write_foxglove
from tactflow.plugins.rosbags.bags import compressed_image, raw_image

KINDS = {"ros1": "press.bag", "sqlite3": "press", "mcap": "press_mcap"}
"""Kind of bag -> what it is called."""


def pictures(count: int) -> list[NDArray[np.uint8]]:
    return [np.random.default_rng(seed).integers(0, 256, (12, 16, 3), np.uint8) for seed in range(count)]


def played(spec: str) -> list[tuple[NDArray[np.uint8], float]]:
    reader = open_source(spec)
    try:
        return list(iter(reader.read, None))
    finally:
        reader.close()


def test_every_kind_of_bag_gives_the_pictures_and_the_stamps_in_the_messages(tmp_path: Path) -> None:
    images = pictures(4)
    bags = [write_bag(tmp_path / name, images, kind) for kind, name in KINDS.items()]
    alone = next((tmp_path / "press_mcap").glob("*.mcap"))
    for bag in [*bags, alone, next((tmp_path / "press").glob("*.db3"))]:
        reader = open_source(f"{bag}?topic={TOPIC}")
        assert (reader.total, reader.size, reader.live) == (4, (16, 12), False)
        found = list(iter(reader.read, None))
        reader.close()
        reader.close()
        assert [t for _, t in found] == [index / 25 for index in range(4)]
        assert all(np.array_equal(image, one) for (image, _), one in zip(found, images, strict=True))


def test_a_folder_of_pictures_may_have_a_metadata_file_too(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "0.png"), pictures(1)[0])
    (tmp_path / "metadata.yaml").write_text("sensor: left\n")
    assert len(played(str(tmp_path))) == 1


def in_encoding(image: NDArray[np.uint8], encoding: str) -> tuple[NDArray[Any], NDArray[np.uint8]]:
    """An image as a camera with this encoding gives it, and what it must become: (H, W, 3) BGR."""
    gray = image[:, :, 0]
    if encoding in ("bgr8", "png"):
        return image, image
    if encoding == "jpeg":
        return image, cv2.imdecode(cv2.imencode(".jpeg", image)[1], cv2.IMREAD_COLOR)
    if encoding == "rgb8":
        return image[:, :, ::-1], image
    if encoding == "mono8":
        return gray, cv2.cvtColor(gray, cv2.COLOR_GRAY2BGR)
    if encoding == "mono16":
        return gray.astype(np.uint16) * 257, cv2.cvtColor(gray, cv2.COLOR_GRAY2BGR)
    # One colour: what lies between the pixels then does not matter. 16 is black to YUV, 128 has no colour.
    if encoding == "yuv422":
        return np.full((12, 16, 2), (128, 16), np.uint8), np.zeros((12, 16, 3), np.uint8)
    if encoding in YUV_420:
        return YUV_420[encoding], ORANGE
    mosaic = np.zeros((12, 16), np.uint8)
    letters = encoding.removeprefix("bayer_").removesuffix("8")
    for index, letter in enumerate(letters):
        mosaic[index // 2 :: 2, index % 2 :: 2] = {"r": 30, "g": 20, "b": 10}[letter]
    return mosaic, np.full((12, 16, 3), (10, 20, 30), np.uint8)


ORANGE = np.full((12, 16, 3), (0, 123, 255), np.uint8)
BRIGHTNESS, BLUE, RED = (
    np.full(shape, value, np.uint8) for shape, value in (((12, 16), 144), ((6, 8), 53), ((6, 8), 196))
)
YUV_420 = {
    "nv12": np.concatenate([BRIGHTNESS, np.dstack([BLUE, RED]).reshape(6, 16)]),
    "nv21": np.concatenate([BRIGHTNESS, np.dstack([RED, BLUE]).reshape(6, 16)]),
    "i420": np.concatenate([BRIGHTNESS, BLUE.reshape(3, 16), RED.reshape(3, 16)]),
    "yv12": np.concatenate([BRIGHTNESS, RED.reshape(3, 16), BLUE.reshape(3, 16)]),
}
"""Encoding -> an orange picture of 16 x 12 pixels in it."""


@pytest.mark.parametrize(
    "encoding",
    [
        *("bgr8", "rgb8", "mono8", "mono16", "yuv422", "jpeg", "png"),
        *("bayer_rggb8", "bayer_bggr8", "bayer_gbrg8", "bayer_grbg8"),
        *YUV_420,
    ],
)
def test_every_encoding_becomes_bgr(encoding: str, tmp_path: Path) -> None:
    sent, expected = in_encoding(pictures(1)[0], encoding)
    bag = write_bag(tmp_path / "press", [np.ascontiguousarray(sent)], "mcap", encoding)
    ((image, _),) = played(f"{bag}?topic={TOPIC}")
    assert np.array_equal(image, expected)


@pytest.mark.parametrize("encoding", YUV_420)
def test_planes_may_have_longer_rows_or_an_unusual_step(encoding: str) -> None:
    planes = YUV_420[encoding]
    # The planes of colour of i420 and yv12 have rows of half the length.
    parts = [planes[:12], planes[12:].reshape(-1, 16 if encoding.startswith("nv") else 8)]
    padded = [np.pad(part, ((0, 0), (0, part.shape[1] // 2)), constant_values=7) for part in parts]
    for data, step in ((np.concatenate([part.ravel() for part in padded]), 24), (planes.ravel(), 48)):
        message = SimpleNamespace(width=16, height=12, step=step, encoding=encoding, data=data.tobytes())
        assert np.array_equal(raw_image(message, "press"), ORANGE)


@pytest.mark.parametrize(
    ("width", "height", "step", "size"),
    [(15, 12, 16, 288), (16, 11, 16, 288), (16, 12, 16, 287), (16, 12, 8, 144)],
)
def test_planes_of_another_size_are_refused(width: int, height: int, step: int, size: int) -> None:
    message = SimpleNamespace(width=width, height=height, step=step, encoding="nv12", data=bytes(size))
    with pytest.raises(SourceError, match=f"{width} x {height} pixels as nv12 need an even size"):
        raw_image(message, "press")


@pytest.mark.parametrize("stated", ["h264", "hevc; 8-bit", "draco"])
def test_the_format_of_compressed_pictures_that_cannot_be_read_is_named(stated: str) -> None:
    message = SimpleNamespace(format=stated, data=b"\0\0\0\1\x67\x42\0\x1f" + bytes(50))
    with pytest.raises(SourceError, match=f"^press: the format of its pictures is '{stated}'; required JPEG"):
        compressed_image(message, "press")
    for image_file in ("jpeg", "bgr8; jpeg compressed bgr8", ""):
        message.format = image_file
        with pytest.raises(SourceError, match=r"^press: (not an image|the image)"):
            compressed_image(message, "press")


def test_pictures_of_foxglove_are_read(tmp_path: Path) -> None:
    schemas = pytest.importorskip("foxglove_schemas_protobuf.CompressedImage_pb2")
    images = pictures(3)
    messages = [
        schemas.CompressedImage(format="png", data=cv2.imencode(".png", image)[1].tobytes())
        for image in images
    ]
    for index, one in enumerate(messages):
        one.timestamp.FromNanoseconds(BEGIN + index * PERIOD)
    # The only topic with pictures need not be named.
    found = played(str(write_foxglove(tmp_path / "press.mcap", messages)))
    assert [t for _, t in found] == [0.0, 0.04, 0.08]
    assert all(np.array_equal(image, one) for (image, _), one in zip(found, images, strict=True))


def test_doctor_finds_that_the_topics_of_a_bag_are_out_of_step(tmp_path: Path, terminal: Terminal) -> None:
    rng = np.random.default_rng(5)
    steps = np.stack([rng.normal(0, strength / 3, (24, 32, 3)) for strength in rng.exponential(1.0, 160)])
    light = np.linspace(60, 180, 32)[:, None]
    images = list(np.clip(light + np.cumsum(steps, axis=0), 0, 255).astype(np.uint8))
    bag = write_bag(tmp_path / "session", images, "mcap", others=["/right"], late=3)
    assert terminal("doctor", str(bag)) == 0
    assert re.fullmatch(r"usable: /right is 1[12]. ms behind /gel/image", terminal.out.splitlines()[-1])
    assert terminal("doctor", f"{bag}?topic=/right") == 0
    assert terminal.out.splitlines()[-1] == "good: 160 frames in 6.4 s"
