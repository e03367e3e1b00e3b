"""The cameras of this machine, with persistent names.

`/dev/videoN` is numbered in the order of connection. udev's links `/dev/v4l/by-id/...` name the device
(cameras of one model without serial numbers share a link), `/dev/v4l/by-path/...` the port.
"""

from __future__ import annotations

import os
import struct
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

if sys.platform == "linux":
    from fcntl import ioctl
else:

    def ioctl(*_: object) -> int:
        """Stands in for Linux's call."""
        raise OSError("the driver can only be asked on Linux")


VIDIOC_QUERYCAP = 0x80685600
VIDIOC_ENUM_FMT = 0xC0405602
VIDIOC_ENUM_FRAMESIZES = 0xC02C564A
"""Requests to a driver (`linux/videodev2.h`); bits 16 to 29 are the length of the reply."""
CAN_CAPTURE = 0x1
CAN_CAPTURE_PLANES = 0x1000
HAS_DEVICE_CAPS = 0x80000000
"""Bits of the reply to the first one, from the same file."""
BUFFER_CAPTURE = 1
BUFFER_CAPTURE_PLANES = 9
"""Types of buffers for pictures, from the same file."""
DISCRETE_SIZES = 1
"""The driver lists single sizes, not a range."""
MAX_ENTRIES = 64
"""Maximum length of a list, in case a driver never ends it. Chosen by hand."""


class Abilities(NamedTuple):
    """Information of a driver.

    name : of the device. pictures : whether it delivers any (many cameras have a second device with metadata
    only). formats : pixel format -> sizes (width, height), px; empty if the driver states a range.
    """

    name: str
    pictures: bool
    formats: dict[str, list[tuple[int, int]]]


@dataclass(frozen=True, slots=True)
class CameraInfo:
    """A camera of this machine.

    source : its most persistent name, for use as a source. device : `/dev/videoN`. index : N.
    names : all links to it. abilities : from its driver, or None if it cannot be queried, because of
    `problem`.
    """

    source: str
    device: str
    index: int
    names: tuple[str, ...] = ()
    abilities: Abilities | None = None
    problem: str = ""


def list_cameras(
    dev: Path = Path("/dev"), ask: Callable[[Path], Abilities] | None = None
) -> list[CameraInfo]:
    """The connected cameras by index, without starting them.

    dev : folder of devices. ask : queries a driver; V4L2 by default.
    """
    links: dict[str, list[str]] = {}
    for link in sorted(dev.glob("v4l/by-*/*")):
        links.setdefault(os.path.realpath(link), []).append(str(link))
    cameras = []
    for device in dev.glob("video*"):
        number = device.name.removeprefix("video")
        if not number.isdecimal():
            continue
        names = tuple(links.get(os.path.realpath(device), ()))
        abilities, problem = None, ""
        try:
            abilities = (ask or ask_driver)(device)
        except PermissionError:
            problem = "no permission: sudo usermod -aG video $USER, then log in again"
        except OSError as error:
            problem = error.strerror or str(error)
        source = names[0] if names else str(device)
        cameras.append(CameraInfo(source, str(device), int(number), names, abilities, problem))
    return sorted(cameras, key=lambda camera: camera.index)


def ask_driver(device: Path) -> Abilities:
    """Query a V4L2 driver, without starting the camera; also works while another program uses it.

    Raises
    ------
    OSError
        If the device cannot be opened, or is not one of V4L2.
    """
    handle = os.open(device, os.O_RDWR | getattr(os, "O_NONBLOCK", 0))
    try:
        answer = _request(handle, VIDIOC_QUERYCAP)
        driver, own = struct.unpack_from("=II", answer, 84)
        capabilities = own if driver & HAS_DEVICE_CAPS else driver
        pictures = bool(capabilities & (CAN_CAPTURE | CAN_CAPTURE_PLANES))
        kind = BUFFER_CAPTURE if capabilities & CAN_CAPTURE else BUFFER_CAPTURE_PLANES
        codes = [entry[44:48] for entry in _list(handle, VIDIOC_ENUM_FMT, struct.pack("=I", kind))]
        formats = {_text(code): _sizes(handle, code) for code in codes if pictures}
        return Abilities(_text(answer[16:48]), pictures, formats)
    finally:
        os.close(handle)


def _sizes(handle: int, code: bytes) -> list[tuple[int, int]]:
    entries = (struct.unpack_from("=III", entry, 8) for entry in _list(handle, VIDIOC_ENUM_FRAMESIZES, code))
    return list(dict.fromkeys((width, height) for kind, width, height in entries if kind == DISCRETE_SIZES))


def _list(handle: int, request: int, argument: bytes) -> Iterator[bytes]:
    """The entries of a list. argument : of the request, after the index of the entry."""
    for index in range(MAX_ENTRIES):
        try:
            yield _request(handle, request, struct.pack("=I", index) + argument)
        except OSError:
            return


def _request(handle: int, request: int, question: bytes = b"") -> bytes:
    """The driver's reply. Raises OSError."""
    data = bytearray(question.ljust(request >> 16 & 0x3FFF, b"\0"))
    ioctl(handle, request, data)
    return bytes(data)


def _text(raw: bytes) -> str:
    return raw.partition(b"\0")[0].decode("utf-8", "replace").strip()
