"""Live sources: cameras and network streams."""

from __future__ import annotations

import glob
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

import cv2
from numpy.typing import NDArray

from tactflow.engine.errors import SourceError
from tactflow.sources.base import CaptureReader, log
from tactflow.system.clock import SYSTEM
from tactflow.system.redaction import public_address

MAX_CAMERA_INDEX = 2**31 - 1
"""OpenCV takes the index of a camera as an `int` of C."""
READ_TIMEOUT_S = 2.0
"""Timeout for a frame, s; OpenCV's defaults are 10 for Linux's video driver and 30 for FFmpeg."""
OPEN_TIMEOUT_S = 10.0
"""Timeout for opening a stream, s."""
MONOTONIC_EPOCH_S = SYSTEM.unix() - SYSTEM.now()
"""Unix time when the monotonic clock was 0, s; determined once, so that times of frames never decrease."""
SETTING_TOLERANCE = 0.01
"""Relative tolerance of a requested size or rate: 29.97 is 30."""


@dataclass(frozen=True, slots=True)
class CameraRequest:
    """Requested settings of a camera; None for its default.

    Attributes
    ----------
    width, height : px.
    fps : frames per second.
    format : four characters, such as MJPG or YUYV.
    """

    width: int | None = None
    height: int | None = None
    fps: float | None = None
    format: str | None = None


class Camera(CaptureReader):
    """A camera of this machine. Frames are stamped on arrival.

    Parameters
    ----------
    device : an index ("0") or a path ("/dev/video0", "/dev/v4l/by-id/...").
    request : settings, which a camera may ignore; this is reported. Raises SourceError if it cannot be
        opened, and from `read` if it stops delivering.
    """

    live = True

    def __init__(self, device: str, request: CameraRequest | None = None) -> None:
        name = f"camera {device}"
        # OpenCV reads this once, at its first camera.
        os.environ.setdefault("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", f"{READ_TIMEOUT_S:.0f}")
        failure = f"{name}: cannot be opened; {_camera_hint(device)}"
        if device.isdecimal() and int(device) > MAX_CAMERA_INDEX:
            raise SourceError(failure)
        backend = cv2.CAP_V4L2 if sys.platform == "linux" else cv2.CAP_ANY
        address = int(device) if device.isdecimal() else os.path.realpath(device)
        super().__init__(name, failure, address, backend)
        self._configure(request or CameraRequest())

    def _configure(self, request: CameraRequest) -> None:
        """Request size, rate and format, and report differing settings."""
        capture = self._capture
        assert capture is not None
        # The format first, because the available sizes and rates depend on it.
        if request.format is not None:
            capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*request.format))
        properties = {
            "width": (cv2.CAP_PROP_FRAME_WIDTH, request.width),
            "height": (cv2.CAP_PROP_FRAME_HEIGHT, request.height),
            "fps": (cv2.CAP_PROP_FPS, request.fps),
        }
        for number, value in properties.values():
            if value is not None:
                capture.set(number, float(value))
        self._update_size()
        rate = capture.get(cv2.CAP_PROP_FPS)
        self.fps = rate if rate > 0 else None
        code = int(capture.get(cv2.CAP_PROP_FOURCC))
        form = "".join(chr(code >> shift & 0xFF) for shift in (0, 8, 16, 24)) if code > 0 else ""
        self.description = f"{self.name}, {self._size_text}"
        self.description += f" at {rate:g} fps" if rate > 0 else ""
        self.description += f", {form}" if form.isprintable() and form else ""
        ignored = [
            f"{name} {value:g} -> {chosen:g}"
            for name, (number, value) in properties.items()
            if value is not None and abs(value - (chosen := capture.get(number))) > SETTING_TOLERANCE * value
        ]
        if request.format is not None and form and form.upper() != request.format.upper():
            ignored.append(f"format {request.format} -> {form}")
        if ignored:
            log.warning("%s ignored the requested settings: %s", self.name, ", ".join(ignored))

    def _frames(self) -> Iterator[tuple[NDArray[Any], float]]:
        while (image := self._grab()) is not None:
            yield image, MONOTONIC_EPOCH_S + SYSTEM.now()
        raise SourceError(f"{self.name}: delivers no more frames; unplugged, or in use by another program?")


def _camera_hint(device: str) -> str:
    present = sorted(glob.glob("/dev/video*"), key=lambda name: (len(name), name))
    wanted = f"/dev/video{device}" if device.isdecimal() else device
    if not present:
        return "no camera is plugged in (there is no /dev/video*); to try it without one: --source sim:press"
    cameras = "this machine has " + ", ".join(present)
    if not os.path.exists(wanted):
        return f"{wanted} does not exist; {cameras}"
    if not os.access(wanted, os.R_OK | os.W_OK):
        return (
            f"no permission for {wanted}; add yourself to its group (sudo usermod -aG video $USER) "
            "and log in again"
        )
    return (
        "another program may be using it, or it only carries metadata "
        f"(many cameras show two devices, of which one has pictures); {cameras}"
    )


class Stream(CaptureReader):
    """A network stream: http, https, rtsp or udp. Frames are stamped on arrival.

    The times and the rate of the stream are not used, because they are meaningless for HTTP. Raises
    SourceError if it cannot be opened.
    """

    live = True

    def __init__(self, url: str) -> None:
        name = public_address(url)
        options = [
            *(cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, int(OPEN_TIMEOUT_S * 1000)),
            *(cv2.CAP_PROP_READ_TIMEOUT_MSEC, int(READ_TIMEOUT_S * 1000)),
        ]
        failure = f"{name}: no stream can be opened there; {_stream_hint(url)}"
        super().__init__(name, failure, url, cv2.CAP_FFMPEG, options)
        self.description = f"{name}, {self._size_text}"

    def _frames(self) -> Iterator[tuple[NDArray[Any], float]]:
        if (image := self._grab()) is None:
            raise SourceError(f"{self.name}: the stream was opened but delivers no frames")
        while image is not None:
            yield image, MONOTONIC_EPOCH_S + SYSTEM.now()
            image = self._grab()


def _stream_hint(url: str) -> str:
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError:
        # Python's message may contain a part of a password.
        return "the address is not valid; in a password, write / as %2F and @ as %40"
    if parts.scheme == "udp":
        return f"does anything send MPEG-TS to port {port or '(no port given)'} of this machine?"
    host = f"{parts.hostname or '(no host given)'}{f':{port}' if port else ''}"
    return f"is {host} switched on and reachable, and is this the address of a video (try it in a player)?"
