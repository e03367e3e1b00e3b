"""Recordings of ROS and Foxglove: the pictures of one topic of an MCAP file, a rosbag2 or a ROS 1 bag."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.engine.errors import SourceError
from tactflow.sources.base import FrameReader, check_pixel_count, damaged, require
from tactflow.sources.files import decode_image
from tactflow.sources.paths import find_path, listed, split_query

from .video import DEFINITION, decode_video

if TYPE_CHECKING:
    from mcap.records import Channel, Schema

SETTINGS = {"topic": "name of a topic with pictures"}
DECODERS = {"cdr": "rosbags", "ros1": "rosbags", "protobuf": "mcap_protobuf"}
"""Encoding of the messages in an MCAP file -> package that decodes them."""
PACKAGES = ("sensor_msgs/msg", "sensor_msgs", "foxglove", "foxglove_msgs/msg", "foxglove_msgs")
"""Where the types of messages with pictures are defined."""
ENCODINGS: dict[str, tuple[int, int | None]] = {
    **dict.fromkeys(("bgr8", "8UC3", "bgr16", "16UC3"), (3, None)),
    **dict.fromkeys(("rgb8", "rgb16"), (3, cv2.COLOR_RGB2BGR)),
    **dict.fromkeys(("bgra8", "8UC4"), (4, cv2.COLOR_BGRA2BGR)),
    "rgba8": (4, cv2.COLOR_RGBA2BGR),
    **dict.fromkeys(("mono8", "8UC1", "mono16", "16UC1"), (1, None)),
    **dict.fromkeys(("yuv422", "uyvy"), (2, cv2.COLOR_YUV2BGR_UYVY)),
    **dict.fromkeys(("yuv422_yuy2", "yuyv"), (2, cv2.COLOR_YUV2BGR_YUY2)),
    **dict.fromkeys(("bayer_rggb8", "bayer_rggb16"), (1, cv2.COLOR_BayerRGGB2BGR)),
    **dict.fromkeys(("bayer_bggr8", "bayer_bggr16"), (1, cv2.COLOR_BayerBGGR2BGR)),
    **dict.fromkeys(("bayer_gbrg8", "bayer_gbrg16"), (1, cv2.COLOR_BayerGBRG2BGR)),
    **dict.fromkeys(("bayer_grbg8", "bayer_grbg16"), (1, cv2.COLOR_BayerGRBG2BGR)),
}
"""Encoding -> channels, and the conversion to BGR; named as in `sensor_msgs/image_encodings.hpp` and by
Foxglove. Those with 16 in their name have 16-bit pixels."""
PLANAR = {
    "nv12": cv2.COLOR_YUV2BGR_NV12,
    "nv21": cv2.COLOR_YUV2BGR_NV21,
    **dict.fromkeys(("i420", "yuv420", "yuv420p"), cv2.COLOR_YUV2BGR_I420),
    "yv12": cv2.COLOR_YUV2BGR_YV12,
}
"""Encoding with a plane of brightness, and then colour at half its resolution -> conversion to BGR."""
IMAGE_FILES = ("jpeg", "jpg", "png", "webp", "tif", "bmp", "jp2")
"""Parts of the `format` of a compressed picture that OpenCV can decode."""

Messages = Iterator[tuple[int, Any]]
"""Times, ns, and messages, or pictures."""
Decoder = Callable[[Messages, str], Messages]
"""From the messages of a topic to its pictures; the text names the source."""
Topics = Mapping[str, tuple[str, int | None]]
"""Topic -> type and number of its messages; None if that is unknown."""


class Bag(FrameReader):
    """The pictures of one topic.

    The time of a frame is the stamp in its message, or the time of its recording if that is 0; it counts from
    the first frame.

    Parameters
    ----------
    spec : `file.mcap?topic=/name`, and so for a `.bag` or `.db3` file or a rosbag2 folder.
    directory : as for `open_source`. Raises SourceError if there is no such file or topic (it lists the
        valid ones), or a package is missing.
    """

    parser_errors = (Exception,)

    def __init__(self, spec: str, directory: Path | None = None, _fps: float | None = None) -> None:
        name, settings = split_query(spec, directory, SETTINGS)
        path = find_path(name, directory)
        self._store = _store(path)
        super().__init__(str(path))
        try:
            self._topic = _choose(spec, settings.get("topic"), self._store.topics)
            self.name = f"{path}, {self._topic}"
            self._type, self.total = self._store.topics[self._topic]
            self._read_first()
        except SourceError:
            self.close()
            raise
        count = "an unknown number of" if self.total is None else self.total
        self.description = f"{spec}, {count} messages"

    @staticmethod
    def sensors(name: str) -> list[str]:
        """A source for each topic with pictures, if there are several."""
        store = _store(find_path(name, None))
        store.close()
        topics = _pictures(store.topics)
        return [f"{name}?topic={topic}" for topic in topics] if len(topics) > 1 else []

    def _frames(self) -> Iterator[tuple[NDArray[Any], float]]:
        written = self._store.messages(self._topic)
        messages = ((_stamp(message) or time, message) for time, message in written)
        decode = _decoder(self._type)
        assert decode is not None
        first: int | None = None
        for taken, image in decode(messages, self.name):
            first = taken if first is None else first
            self.begins = first / 1e9
            yield image, (taken - first) / 1e9

    def close(self) -> None:
        """Close the file."""
        super().close()
        self._store.close()


def _store(path: Path) -> McapFile | RosBag:
    return McapFile(path) if path.suffix.lower() == ".mcap" else RosBag(path)


def _pictures(topics: Topics) -> list[str]:
    """The topics with pictures."""
    return [name for name, (kind, _) in sorted(topics.items()) if _decoder(kind) is not None]


def _choose(spec: str, topic: str | None, topics: Topics) -> str:
    """The requested topic, if it has pictures; without a request, the only topic with pictures."""
    pictures = _pictures(topics)
    if topic in pictures:
        return topic
    if topic is None and len(pictures) == 1:
        return pictures[0]
    texts = {
        name: f"{name} ({kind}{'' if count is None else f', {count}'})"
        for name, (kind, count) in sorted(topics.items())
    }
    others = listed([text for name, text in texts.items() if name not in pictures])
    if topic is None and not pictures:
        raise SourceError(f"{spec}: no topic holds pictures; there are {others}")
    if topic is None:
        problem = "add ?topic="
    elif topic in topics:
        problem = f"{topic} has messages of type {topics[topic][0]}, which hold no picture; required"
    else:
        problem = f"there is no topic {topic}; required"
    found = listed([texts[name] for name in pictures])
    raise SourceError(f"{spec}: {problem} one of: {found}; topics without pictures: {others}")


# -- files with messages ------------------------------------------------------------------------------------


class RosBag:
    """A rosbag2 folder (sqlite3 or MCAP), a .db3 file, or a ROS 1 .bag, read by rosbags."""

    def __init__(self, path: Path) -> None:
        require(path, "ROS bags", "bags", "rosbags")
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        # Bags from before 2023 do not contain their types; those of pictures have never changed.
        types = get_typestore(Stores.LATEST)
        types.register(get_types_from_msg(DEFINITION, "foxglove_msgs/msg/CompressedVideo"))
        try:
            self._reader = AnyReader([path], default_typestore=types)
            self._reader.open()
        except Exception as error:
            raise damaged(str(path), error) from error
        self.topics: Topics = {
            name: (info.msgtype or "several types", info.msgcount)
            for name, info in self._reader.topics.items()
        }

    def messages(self, topic: str) -> Iterator[tuple[int, Any]]:
        """The messages of a topic: time of writing, ns, and the message, with its fields as attributes."""
        connections = [connection for connection in self._reader.connections if connection.topic == topic]
        for connection, written, data in self._reader.messages(connections):
            yield written, self._reader.deserialize(data, connection.msgtype)

    def close(self) -> None:
        """Close the files. Idempotent."""
        if self._reader.stack is not None:
            self._reader.close()


class McapFile:
    """An .mcap file of any program, also a truncated one."""

    def __init__(self, path: Path) -> None:
        require(path, "MCAP files", "bags", "mcap", "zstandard")
        from mcap.records import Channel, Schema
        from mcap.summary import Summary

        from tactflow.recording.records import NotARecordingError, intact_records, read_summary

        self._path = path
        try:
            with path.open("rb") as file:
                self._summary = read_summary(file) or Summary()
                if self._summary.statistics is None:
                    for record in intact_records(file):
                        if isinstance(record, Schema):
                            self._summary.schemas[record.id] = record
                        elif isinstance(record, Channel):
                            self._summary.channels[record.id] = record
        except NotARecordingError as error:
            raise SourceError(f"{path}: {error}") from None
        except Exception as error:
            raise damaged(str(path), error) from error
        statistics = self._summary.statistics
        self.topics: dict[str, tuple[str, int | None]] = {}
        # A topic may have several channels, one for each of its writers.
        for channel in self._summary.channels.values():
            schema = self._summary.schemas.get(channel.schema_id)
            count = None
            if statistics is not None:
                _, before = self.topics.get(channel.topic, ("", 0))
                count = (before or 0) + statistics.channel_message_counts.get(channel.id, 0)
            self.topics[channel.topic] = (schema.name if schema else "no type", count)

    def messages(self, topic: str) -> Iterator[tuple[int, Any]]:
        """As `RosBag.messages`."""
        from tactflow.recording.reader import messages

        channels = self._summary.channels.values()
        parsers = {channel.id: self._parser(channel) for channel in channels if channel.topic == topic}
        for message in messages(self._path, [topic]):
            yield message.log_time, parsers[message.channel_id](message.data)

    def _parser(self, channel: Channel) -> Callable[[bytes], Any]:
        """The decoder for the messages of a channel."""
        schema, encoding = self._summary.schemas[channel.schema_id], channel.message_encoding
        if encoding not in DECODERS:
            raise SourceError(
                f"{self._path}, {channel.topic}: messages are encoded as {encoding!r}; required one of: "
                + ", ".join(DECODERS)
            )
        require(self._path, f"messages encoded as {encoding}", "bags", DECODERS[encoding])
        if encoding == "protobuf":
            from mcap_protobuf.decoder import DecoderFactory

            decoder = DecoderFactory().decoder_for(encoding, schema)
            if decoder is None:
                raise ValueError(f"the schema of {channel.topic} is written as {schema.encoding!r}")
            return decoder
        return _from_ros(schema, encoding)

    def close(self) -> None:
        """Nothing to do: no file stays open."""


def _from_ros(schema: Schema, encoding: str) -> Callable[[bytes], Any]:
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

    store = get_typestore(Stores.EMPTY)
    text = schema.data.decode()
    name = schema.name if "/msg/" in schema.name else schema.name.replace("/", "/msg/")
    store.register(get_types_from_idl(text) if "idl" in schema.encoding else get_types_from_msg(text, name))
    if encoding == "ros1":
        return lambda data: store.deserialize_ros1(data, name)
    return lambda data: store.deserialize_cdr(data, name)


# -- pictures in messages -----------------------------------------------------------------------------------


def _stamp(message: Any) -> int:
    """Capture time of the picture in a message, ns; 0 if unknown."""
    time = message.header.stamp if hasattr(message, "header") else message.timestamp
    names = (("sec", "nanosec"), ("sec", "nsec"), ("seconds", "nanos"))
    seconds, rest = next(pair for pair in names if all(hasattr(time, name) for name in pair))
    return int(getattr(time, seconds)) * 1_000_000_000 + int(getattr(time, rest))


def _decoder(kind: str) -> Decoder | None:
    """The function that extracts the pictures from messages of this type; None for other types."""
    package, _, name = kind.replace(".", "/").rpartition("/")
    return DECODERS_OF_TYPES.get(name) if package in PACKAGES else None


def _each(to_image: Callable[[Any, str], NDArray[Any]]) -> Decoder:
    """The decoder for messages that each hold a whole picture."""

    def decode(messages: Messages, name: str) -> Messages:
        return ((taken, to_image(message, name)) for taken, message in messages)

    return decode


def raw_image(message: Any, name: str) -> NDArray[Any]:
    """The pixels of an `Image` or `RawImage`: (H, W) or (H, W, 3) uint8 or uint16, in the order BGR.

    Raises SourceError if the encoding is unknown, or there are fewer bytes than the message states.
    """
    width, height, step = int(message.width), int(message.height), int(message.step)
    check_pixel_count(name, width, height)
    encoding = message.encoding if message.encoding in ENCODINGS else message.encoding.lower()
    if encoding in PLANAR:
        return _planar_image(message, name)
    if encoding not in ENCODINGS:
        raise SourceError(
            f"{name}: pictures are encoded as {message.encoding!r}; required one of: "
            + ", ".join((*ENCODINGS, *PLANAR))
        )
    channels, conversion = ENCODINGS[encoding]
    order = ">" if getattr(message, "is_bigendian", 0) else "<"
    dtype = np.dtype(order + ("u2" if "16" in encoding else "u1"))
    row = width * channels * dtype.itemsize
    data = np.frombuffer(message.data, np.uint8)
    if not (width and height and step >= row and data.size >= step * (height - 1) + row):
        raise SourceError(
            f"{name}: {width} x {height} pixels as {message.encoding} need rows of {row} bytes; got "
            f"{data.size} bytes in rows of {step}"
        )
    rows = np.lib.stride_tricks.as_strided(data, (height, row), (step, 1), writeable=False)
    shape = (height, width) if channels == 1 else (height, width, channels)
    image = np.ascontiguousarray(rows).view(dtype).reshape(shape).astype(dtype.newbyteorder("="), copy=False)
    return image if conversion is None else cv2.cvtColor(image, conversion)


def _planar_image(message: Any, name: str) -> NDArray[Any]:
    """The pixels of a picture in an encoding of `PLANAR`: (H, W, 3) uint8 BGR. Raises SourceError."""
    width, height, step = int(message.width), int(message.height), int(message.step)
    data, rows = np.frombuffer(message.data, np.uint8), height * 3 // 2
    if data.size == width * rows:
        # Some drivers state another step, although the rows are not padded.
        step = width
    if width % 2 or height % 2 or not (rows and step >= width and step % 2 == 0 and data.size >= step * rows):
        raise SourceError(
            f"{name}: {width} x {height} pixels as {message.encoding} need an even size and {width * rows} "
            f"bytes in rows of {width}; got {data.size} bytes in rows of {step}"
        )
    planes = data[: step * rows].reshape(rows, step)
    encoding = message.encoding.lower()
    if encoding.startswith("nv"):
        planes = planes[:, :width]
    else:
        # The rows of both planes of colour are half as long.
        colour = planes[height:].reshape(height, step // 2)[:, : width // 2]
        planes = np.concatenate([planes[:height, :width], colour.reshape(height // 2, width)])
    return cv2.cvtColor(np.ascontiguousarray(planes), PLANAR[encoding])


def compressed_image(message: Any, name: str) -> NDArray[Any]:
    """The pixels of a `CompressedImage`, as `decode_image` gives them. Raises SourceError."""
    stated = getattr(message, "format", "")
    if "compressedDepth" in stated:
        raise SourceError(f"{name}: compressed depth, not a picture")
    try:
        return decode_image(bytes(message.data), name)
    except SourceError:
        if not stated or any(word in stated.lower() for word in IMAGE_FILES):
            raise
        raise SourceError(
            f"{name}: the format of its pictures is {stated!r}; required JPEG, PNG or another image file in "
            "each message: decode the topic to sensor_msgs/Image, and record that"
        ) from None


DECODERS_OF_TYPES: dict[str, Decoder] = {
    "Image": _each(raw_image),
    "RawImage": _each(raw_image),
    "CompressedImage": _each(compressed_image),
    "CompressedVideo": decode_video,
}
"""Type of messages, without its package -> how pictures are extracted."""
