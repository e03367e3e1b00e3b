"""Pictures in the messages of ROS and Foxglove, whatever they are packed as."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.engine.errors import SourceError
from tactflow.sources.base import refuse_too_large
from tactflow.sources.files import decode_image
from tactflow.system.extras import missing

if TYPE_CHECKING:
    import av

RAW, COMPRESSED, VIDEO = ("Image", "RawImage"), ("CompressedImage",), ("CompressedVideo",)
"""What message types are called that hold pixels, a picture file, a piece of a video."""
PACKAGES = ("sensor_msgs/msg", "sensor_msgs", "foxglove", "foxglove_msgs/msg", "foxglove_msgs")
"""Where those types are defined."""
ENCODINGS: dict[str, tuple[str, int, int | None]] = {
    "bgr8": ("u1", 3, None),
    "8UC3": ("u1", 3, None),
    "rgb8": ("u1", 3, cv2.COLOR_RGB2BGR),
    "bgra8": ("u1", 4, cv2.COLOR_BGRA2BGR),
    "8UC4": ("u1", 4, cv2.COLOR_BGRA2BGR),
    "rgba8": ("u1", 4, cv2.COLOR_RGBA2BGR),
    "mono8": ("u1", 1, None),
    "8UC1": ("u1", 1, None),
    "mono16": ("u2", 1, None),
    "16UC1": ("u2", 1, None),
    "bgr16": ("u2", 3, None),
    "16UC3": ("u2", 3, None),
    "rgb16": ("u2", 3, cv2.COLOR_RGB2BGR),
    "yuv422": ("u1", 2, cv2.COLOR_YUV2BGR_UYVY),
    "uyvy": ("u1", 2, cv2.COLOR_YUV2BGR_UYVY),
    "yuv422_yuy2": ("u1", 2, cv2.COLOR_YUV2BGR_YUY2),
    "yuyv": ("u1", 2, cv2.COLOR_YUV2BGR_YUY2),
    "bayer_rggb8": ("u1", 1, cv2.COLOR_BayerRGGB2BGR),
    "bayer_bggr8": ("u1", 1, cv2.COLOR_BayerBGGR2BGR),
    "bayer_gbrg8": ("u1", 1, cv2.COLOR_BayerGBRG2BGR),
    "bayer_grbg8": ("u1", 1, cv2.COLOR_BayerGRBG2BGR),
    "bayer_rggb16": ("u2", 1, cv2.COLOR_BayerRGGB2BGR),
    "bayer_bggr16": ("u2", 1, cv2.COLOR_BayerBGGR2BGR),
    "bayer_gbrg16": ("u2", 1, cv2.COLOR_BayerGBRG2BGR),
    "bayer_grbg16": ("u2", 1, cv2.COLOR_BayerGRBG2BGR),
}
"""Encoding -> type of a number, numbers per pixel, and what makes it BGR; named as in
`sensor_msgs/image_encodings.hpp` and by Foxglove."""
CODECS = {"h264": "h264", "h265": "hevc", "vp9": "vp9", "av1": "av1"}
"""Formats of a `CompressedVideo` -> names of FFmpeg's decoders."""


def kind_of(type_name: str) -> str | None:
    """What a message of a type holds: "Image", "CompressedImage", "CompressedVideo"; None: no picture.

    >>> kind_of("sensor_msgs/msg/Image"), kind_of("foxglove.RawImage"), kind_of("std_msgs/msg/String")
    ('Image', 'Image', None)
    """
    package, _, name = type_name.replace(".", "/").rpartition("/")
    if package not in PACKAGES:
        return None
    return next((kind[0] for kind in (RAW, COMPRESSED, VIDEO) if name in kind), None)


def stamp_of(message: Any) -> int:
    """When the picture of a message was taken, ns; 0 where it does not say."""
    time = message.header.stamp if hasattr(message, "header") else message.timestamp
    names = (("sec", "nanosec"), ("sec", "nsec"), ("seconds", "nanos"))
    seconds, rest = next(pair for pair in names if all(hasattr(time, name) for name in pair))
    return int(getattr(time, seconds)) * 1_000_000_000 + int(getattr(time, rest))


def raw_picture(message: Any, name: str) -> NDArray[Any]:
    """The pixels of an `Image` or `RawImage`.

    Returns
    -------
    image : (H, W) or (H, W, 3) uint8 or uint16, colours in the order BGR.

    Raises
    ------
    SourceError
        If the encoding is not known, or there are fewer bytes than the message says.
    """
    width, height, step = int(message.width), int(message.height), int(message.step)
    refuse_too_large(name, width, height)
    known = ENCODINGS.get(message.encoding) or ENCODINGS.get(message.encoding.lower())
    if known is None:
        raise SourceError(
            f"{name}: pictures are encoded as {message.encoding!r}; required one of: {', '.join(ENCODINGS)}"
        )
    dtype, channels, conversion = known
    numbers = np.dtype((">" if getattr(message, "is_bigendian", 0) else "<") + dtype)
    row = width * channels * numbers.itemsize
    data = np.frombuffer(message.data, np.uint8)
    if not (width and height and step >= row and data.size >= step * (height - 1) + row):
        raise SourceError(
            f"{name}: {width} x {height} pixels as {message.encoding} need rows of {row} bytes; got "
            f"{data.size} bytes in rows of {step}"
        )
    rows = np.lib.stride_tricks.as_strided(data, (height, row), (step, 1), writeable=False)
    shape = (height, width) if channels == 1 else (height, width, channels)
    image = (
        np.ascontiguousarray(rows).view(numbers).reshape(shape).astype(numbers.newbyteorder("="), copy=False)
    )
    return image if conversion is None else cv2.cvtColor(image, conversion)


def compressed_picture(message: Any, name: str) -> NDArray[Any]:
    """The pixels of a `CompressedImage`, as `read_image` gives them. Raises SourceError."""
    if "compressedDepth" in getattr(message, "format", ""):
        raise SourceError(f"{name}: compressed depth, not a picture")
    return decode_image(bytes(message.data), name)


class VideoDecoder:
    """Decodes a video that comes in pieces, one picture each.

    name : of the topic, for messages. Raises SourceError if PyAV is not installed.
    """

    def __init__(self, name: str) -> None:
        problem = missing("videos in messages", "av", ["av"])
        if problem is not None:
            raise SourceError(f"{name}: {problem}")
        self._name = name
        self._codec: av.VideoCodecContext | None = None
        self._begun = False

    def __call__(self, message: Any) -> NDArray[np.uint8] | None:
        """The picture of one piece, (H, W, 3) uint8 BGR; None as long as the video has not begun."""
        import av

        if self._codec is None:
            codec = CODECS.get(message.format)
            if codec is None:
                known = ", ".join(CODECS)
                raise SourceError(f"{self._name}: a video as {message.format!r}; required one of: {known}")
            self._codec = cast("av.VideoCodecContext", av.CodecContext.create(codec, "r"))
            # With threads of its own, FFmpeg gives a picture only when it has several more.
            self._codec.thread_type = "NONE"
        try:
            frames = self._codec.decode(av.Packet(bytes(message.data)))
        except av.error.InvalidDataError:
            # A recording may begin between two pictures that stand alone.
            if self._begun:
                raise
            return None
        for frame in frames:
            self._begun = True
            refuse_too_large(self._name, frame.width, frame.height)
            return np.asarray(frame.to_ndarray(format="bgr24"), np.uint8)
        return None
