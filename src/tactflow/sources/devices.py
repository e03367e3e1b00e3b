"""Live sources: cameras and network streams."""

from __future__ import annotations

import glob
import os
import sys
import time
from dataclasses import dataclass
from urllib.parse import urlsplit

import cv2

from tactflow.engine.errors import SourceError
from tactflow.sources.base import BgrImage, Normaliser, frame_size, log, quiet_opencv
from tactflow.system.clock import SYSTEM, Clock
from tactflow.system.redaction import public_address

LARGEST_INDEX = 2**31 - 1
"""OpenCV takes the index of a camera as an `int` of C."""


@dataclass(frozen=True, slots=True)
class CameraRequest:
    """What a camera is asked for; None leaves the camera's own choice.

    width, height : px. fps : frames per second. format : four characters, such as MJPG or YUYV.
    """

    width: int | None = None
    height: int | None = None
    fps: float | None = None
    format: str | None = None


class ArrivalClock:
    """Unix time that never steps back: the system's clock at the start plus a monotonic clock."""

    def __init__(self, clock: Clock = SYSTEM) -> None:
        self._clock = clock
        self._offset = clock.unix() - clock.now()

    def now(self) -> float:
        """Unix time, s."""
        return self._offset + self._clock.now()


class Camera:
    """A camera of this machine. Frames are stamped on arrival.

    Parameters
    ----------
    device : an index ("0") or a path ("/dev/video0", "/dev/v4l/by-id/...").
    request : size, rate and format to ask for. A camera may answer with something else; that is reported.
    clock : stamps the frames; its own if not given.

    Raises
    ------
    SourceError
        If the camera cannot be opened; says what to try.
    """

    live = True
    total: int | None = None

    READ_TIMEOUT = 2
    """Seconds after which Linux's video driver gives up on a frame; OpenCV's own choice is 10."""

    def __init__(
        self, device: str, request: CameraRequest | None = None, clock: ArrivalClock | None = None
    ) -> None:
        request = request or CameraRequest()
        self._name = f"camera {device}"
        # OpenCV reads this once, at its first camera.
        os.environ.setdefault("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", str(self.READ_TIMEOUT))
        backend = cv2.CAP_V4L2 if sys.platform == "linux" else cv2.CAP_ANY
        if device.isdecimal() and int(device) > LARGEST_INDEX:
            raise SourceError(f"{self._name}: cannot be opened; {_camera_hint(device)}")
        with quiet_opencv():
            if device.isdecimal():
                self._capture: cv2.VideoCapture | None = cv2.VideoCapture(int(device), backend)
            else:
                self._capture = cv2.VideoCapture(os.path.realpath(device), backend)
        if not self._capture.isOpened():
            raise SourceError(f"{self._name}: cannot be opened; {_camera_hint(device)}")
        self._ask(self._capture, request)
        self._normalise = Normaliser(self._name)
        self._clock = clock or ArrivalClock()

    def _ask(self, capture: cv2.VideoCapture, request: CameraRequest) -> None:
        # The format comes first: it decides which sizes and rates the driver offers.
        if request.format is not None:
            capture.set(cv2.CAP_PROP_FOURCC, fourcc(request.format))
        for prop, value in (
            (cv2.CAP_PROP_FRAME_WIDTH, request.width),
            (cv2.CAP_PROP_FRAME_HEIGHT, request.height),
            (cv2.CAP_PROP_FPS, request.fps),
        ):
            if value is not None:
                capture.set(prop, float(value))
        width = int(capture.get(cv2.CAP_PROP_FRAME_WIDTH))
        height = int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
        rate = capture.get(cv2.CAP_PROP_FPS)
        code = int(capture.get(cv2.CAP_PROP_FOURCC))
        form = "".join(chr(code >> shift & 0xFF) for shift in (0, 8, 16, 24)) if code > 0 else ""
        self.size: tuple[int, int] | None = (width, height)
        self.fps: float | None = rate if rate > 0 else None
        self.description = f"{self._name}, {width} x {height}"
        self.description += f" at {rate:g} fps" if rate > 0 else ""
        self.description += f", {form}" if form.isprintable() and form else ""
        differs = [
            f"{what} {asked:g} -> {got:g}"
            for what, asked, got in (
                ("width", request.width, width),
                ("height", request.height, height),
                ("fps", request.fps, rate),
            )
            if asked is not None and abs(asked - got) > 0.01 * asked
        ]
        if request.format is not None and form and form.upper() != request.format.upper():
            differs.append(f"format {request.format} -> {form}")
        if differs:
            log.warning("%s gives something else than it was asked for: %s", self._name, ", ".join(differs))

    def read(self) -> tuple[BgrImage, float] | None:
        """Wait for the next frame; see `FrameReader.read`. A camera that stops delivering is an error."""
        if self._capture is None:
            return None
        there, image = self._capture.read()
        t = self._clock.now()
        if not there:
            raise SourceError(
                f"{self._name}: delivers no more frames; unplugged, or in use by another program?"
            )
        return self._normalise(image), t

    def delay(self) -> float | None:
        """Time since the driver stamped the frame that was read last, s; None where it does not say.

        Linux's driver for USB cameras stamps a frame when its first bytes come, by the monotonic clock.
        """
        if self._capture is None or sys.platform != "linux":
            return None
        stamped = self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1e3
        delay = time.monotonic() - stamped
        return delay if stamped > 0 and 0 <= delay < self.READ_TIMEOUT else None

    def close(self) -> None:
        """Give the camera back."""
        if self._capture is not None:
            self._capture.release()
            self._capture = None


def fourcc(code: str) -> int:
    """The number for a four-character code such as MJPG."""
    return cv2.VideoWriter.fourcc(*code)


def _camera_hint(device: str) -> str:
    present = sorted(glob.glob("/dev/video*"), key=lambda name: (len(name), name))
    wanted = f"/dev/video{device}" if device.isdecimal() else device
    if not present:
        return "no camera is plugged in (there is no /dev/video*)"
    others = "this machine has " + ", ".join(present)
    if not os.path.exists(wanted):
        return f"{wanted} does not exist; {others}"
    if not os.access(wanted, os.R_OK | os.W_OK):
        return (
            f"no permission for {wanted}; add yourself to its group (sudo usermod -aG video $USER) "
            "and log in again"
        )
    return (
        "another program may be using it, or it only carries metadata "
        f"(many cameras show two devices, of which one has pictures); {others}"
    )


class Stream:
    """A network stream: http, https, rtsp or udp. Frames are stamped on arrival.

    The stream's own times and rate are not used: for HTTP they are invented.

    Parameters
    ----------
    url : what OpenCV's FFmpeg is to open.
    clock : stamps the frames; its own if not given.

    Raises
    ------
    SourceError
        If nothing can be opened there.
    """

    live = True
    fps: float | None = None
    total: int | None = None
    OPEN_TIMEOUT = 10.0
    """Seconds to wait for the first answer."""
    READ_TIMEOUT = 2.0
    """Seconds without a frame after which a stream counts as ended."""

    def __init__(self, url: str, clock: ArrivalClock | None = None) -> None:
        self._name = public_address(url)
        with quiet_opencv():
            self._capture: cv2.VideoCapture | None = cv2.VideoCapture(
                url,
                cv2.CAP_FFMPEG,
                [
                    cv2.CAP_PROP_OPEN_TIMEOUT_MSEC,
                    int(self.OPEN_TIMEOUT * 1000),
                    cv2.CAP_PROP_READ_TIMEOUT_MSEC,
                    int(self.READ_TIMEOUT * 1000),
                ],
            )
        if not self._capture.isOpened():
            raise SourceError(f"{self._name}: no stream can be opened there; {_stream_hint(url)}")
        self._normalise = Normaliser(self._name)
        self._clock = clock or ArrivalClock()
        self._count = 0
        self.size: tuple[int, int] | None = frame_size(self._capture, self._name)
        self.description = f"{self._name}, {self.size[0]} x {self.size[1]}"

    def read(self) -> tuple[BgrImage, float] | None:
        """Wait for the next frame; see `FrameReader.read`. A stream that falls silent has ended."""
        if self._capture is None:
            return None
        with quiet_opencv():
            there, image = self._capture.read()
        t = self._clock.now()
        if not there:
            if self._count == 0:
                raise SourceError(f"{self._name}: the stream was opened but delivers no frames")
            return None
        self._count += 1
        return self._normalise(image), t

    def close(self) -> None:
        """Hang up."""
        if self._capture is not None:
            self._capture.release()
            self._capture = None


def _stream_hint(url: str) -> str:
    parts = urlsplit(url)
    if parts.scheme == "udp":
        return f"does anything send MPEG-TS to port {parts.port or '(no port given)'} of this machine?"
    host = f"{parts.hostname or '(no host given)'}{f':{parts.port}' if parts.port else ''}"
    return f"is {host} switched on and reachable, and is this the address of a video (try it in a player)?"
