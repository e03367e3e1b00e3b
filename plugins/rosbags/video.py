"""Topics with a video, one picture in each message: `foxglove.CompressedVideo`, also of ROS."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactflow.engine.errors import SourceError
from tactflow.sources.base import check_pixel_count, require

log = logging.getLogger("tactflow")

CODECS = {"h264": "h264", "h265": "hevc", "vp9": "vp9", "av1": "libdav1d"}
"""`format` of a message -> decoder of PyAV."""
NANOSECOND = Fraction(1, 1_000_000_000)
"""Unit of the times, s."""
DEFINITION = """
builtin_interfaces/Time timestamp
string frame_id
uint8[] data
string format
"""
"""foxglove_msgs/CompressedVideo, for bags from before 2023, which do not contain their types.
https://docs.foxglove.dev/docs/sdk/schemas/compressed-video"""


def decode_video(messages: Iterator[tuple[int, Any]], name: str) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    """Decode a video that comes in messages.

    Messages before the first key frame cannot be decoded; they are left out, with a warning.

    Parameters
    ----------
    messages : the time of each, ns, and itself.
    name : of the source, for messages.

    Yields
    ------
    The time of each picture, ns, and the picture, (H, W, 3) uint8 BGR.

    Raises
    ------
    SourceError : PyAV is missing, the codec is unknown, there is no key frame, or a picture is too large.
    """
    require(name, "topics with a video", "video", "av")
    import av

    decoder: Any = None
    times: list[int] = []
    is_decoded = False
    for taken, message in messages:
        decoder = decoder or _decoder(message.format, name)
        packet = av.Packet(bytes(message.data))
        packet.pts, packet.time_base = taken, NANOSECOND
        try:
            frames = decoder.decode(packet)
        except av.error.InvalidDataError:
            if is_decoded:
                raise
            frames = []
        if not is_decoded:
            times.append(taken)
            if frames:
                is_decoded = True
                _warn(sum(time < frames[0].pts for time in times), name)
        for frame in frames:
            yield _picture(frame, name)
    if times and not is_decoded:
        raise SourceError(f"{name}: no picture of its video can be decoded: there is no key frame")
    for frame in decoder.decode(None) if is_decoded else []:
        yield _picture(frame, name)


def _warn(left_out: int, name: str) -> None:
    if left_out:
        log.warning("%s: %d pictures before the first key frame are left out", name, left_out)


def _decoder(stated: str, name: str) -> Any:
    """A decoder that returns each picture at once. Raises SourceError for an unknown format."""
    import av

    if stated not in CODECS:
        raise SourceError(f"{name}: its video is {stated!r}; required one of: {', '.join(CODECS)}")
    decoder = av.CodecContext.create(CODECS[stated], "r")
    decoder.thread_count = 1
    decoder.flags |= av.codec.context.Flags.low_delay
    return decoder


def _picture(frame: Any, name: str) -> tuple[int, NDArray[np.uint8]]:
    check_pixel_count(name, frame.width, frame.height)
    return frame.pts, np.asarray(frame.to_ndarray(format="bgr24"), np.uint8)
