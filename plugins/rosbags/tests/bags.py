"""Bags of ROS and files of Foxglove, as tests need them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from mcap_protobuf.writer import Writer
from numpy.typing import NDArray
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

TOPIC = "/gel/image"
PERIOD = 40_000_000
"""Time between frames, ns: 25 Hz, so that its seconds are the same numbers as those of a folder."""
BEGIN = 1_700_000_000_000_000_000
"""Unix time of the first frame, ns."""


def message(store: Any, image: NDArray[Any], taken: int, encoding: str, *, one: bool = False) -> Any:
    """A picture as `sensor_msgs/Image`, or, where the encoding is a kind of file, as `CompressedImage`."""
    types = store.types
    stamp = types["builtin_interfaces/msg/Time"](sec=taken // 10**9, nanosec=taken % 10**9)
    extra = {"seq": 0} if one else {}
    header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="gel", **extra)
    if encoding in ("jpeg", "png"):
        data = cv2.imencode(f".{encoding}", image)[1].ravel()
        return types["sensor_msgs/msg/CompressedImage"](header=header, format=encoding, data=data)
    height, width = image.shape[:2]
    if encoding in ("nv12", "nv21", "i420", "yv12"):
        height = height * 2 // 3
    return types["sensor_msgs/msg/Image"](
        header=header,
        height=height,
        width=width,
        encoding=encoding,
        is_bigendian=0,
        step=image.strides[0],
        data=np.frombuffer(image.tobytes(), np.uint8),
    )


def write_bag(
    path: Path,
    images: Sequence[NDArray[Any]],
    kind: str,
    encoding: str = "bgr8",
    others: Sequence[str] = (),
    late: int = 0,
) -> Path:
    """A recording of some pictures and one text. kind : "ros1", "sqlite3" or "mcap". others : more topics;
    with `late`, they have the same pictures, so many frames later."""
    one = kind == "ros1"
    store = get_typestore(Stores.ROS1_NOETIC if one else Stores.ROS2_HUMBLE)
    encode = store.serialize_ros1 if one else store.serialize_cdr
    text = store.types["std_msgs/msg/String"](data="hello")
    plugins = {"sqlite3": StoragePlugin.SQLITE3, "mcap": StoragePlugin.MCAP}
    with Writer1(path) if one else Writer2(path, version=9, storage_plugin=plugins[kind]) as writer:
        chatter = writer.add_connection("/chatter", "std_msgs/msg/String", typestore=store)
        type_name = "CompressedImage" if encoding in ("jpeg", "png") else "Image"
        camera = writer.add_connection(TOPIC, f"sensor_msgs/msg/{type_name}", typestore=store)
        more = [writer.add_connection(topic, camera.msgtype, typestore=store) for topic in others]
        writer.write(chatter, BEGIN - 1, encode(text, "std_msgs/msg/String"))
        for index, image in enumerate(images):
            taken = BEGIN + index * PERIOD
            one_message = message(store, image, taken, encoding, one=one)
            # Written later than taken, and not evenly.
            writer.write(camera, taken + 1000 * index**2, encode(one_message, camera.msgtype))
            for connection in more if late else []:
                shown = message(store, images[max(index - late, 0)], taken, encoding, one=one)
                writer.write(connection, taken + 1000 * index**2, encode(shown, camera.msgtype))
    return path


def write_foxglove(path: Path, messages: Sequence[Any]) -> Path:
    """A Foxglove file. messages : of `foxglove_schemas_protobuf`."""
    with path.open("wb") as file, Writer(file) as writer:
        for index, one in enumerate(messages):
            taken = BEGIN + index * PERIOD
            writer.write_message(TOPIC, one, log_time=taken, publish_time=taken)
    return path
