"""The cameras of this machine, under names that stay the same.

`/dev/videoN` is numbered in the order of plugging in. udev's links `/dev/v4l/by-id/...` name the device (two
of the same model without serial numbers share one), `/dev/v4l/by-path/...` the socket it is plugged into.
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
"""Requests to a driver, as `linux/videodev2.h` defines them; bits 16 to 29 are the length of the answer."""
CAN_CAPTURE = 0x1
CAN_CAPTURE_PLANES = 0x1000
HAS_DEVICE_CAPS = 0x80000000
"""Bits of the answer to the first one, from the same file."""
BUFFER_CAPTURE = 1
BUFFER_CAPTURE_PLANES = 9
"""Kinds of buffers that pictures come in, from the same file."""
DISCRETE_SIZES = 1
"""The driver lists sizes one by one, not as a range."""
MAX_ENTRIES = 64
"""Entries of a list that are read at most, in case a driver never ends it. Chosen by hand."""


class Abilities(NamedTuple):
    """What a driver says.

    name : the device's own name. pictures : whether it delivers any (many cameras show a second device that
    only carries metadata). formats : pixel format -> sizes (width, height), px; no sizes where the driver
    names a range.
    """

    name: str
    pictures: bool
    formats: dict[str, list[tuple[int, int]]]


@dataclass(frozen=True, slots=True)
class CameraInfo:
    """A camera of this machine.

    source : its most stable name, to be used as a source. device : `/dev/videoN`. index : N.
    names : all links to it. abilities : what its driver says, or None where it cannot be asked; `problem`
    then says why.
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
    """The cameras that are plugged in, by index; none of them is started.

    Parameters
    ----------
    dev : the folder of devices.
    ask : asks a driver; Linux's V4L2 if not given.
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
    """Ask a V4L2 driver what it can do. Does not start the camera, and works while another program uses it.

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


def _list(handle: int, request: int, what: bytes) -> Iterator[bytes]:
    """The entries of a list. what : of what, behind the index of the entry."""
    for index in range(MAX_ENTRIES):
        try:
            yield _request(handle, request, struct.pack("=I", index) + what)
        except OSError:
            return


def _request(handle: int, request: int, question: bytes = b"") -> bytes:
    """The driver's answer. Raises OSError."""
    data = bytearray(question.ljust(request >> 16 & 0x3FFF, b"\0"))
    ioctl(handle, request, data)
    return bytes(data)


def _text(raw: bytes) -> str:
    return raw.partition(b"\0")[0].decode("utf-8", "replace").strip()
