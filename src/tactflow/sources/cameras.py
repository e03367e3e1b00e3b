"""The cameras of this machine, under names that stay the same.

`/dev/videoN` is given out in the order of plugging in. udev's links `/dev/v4l/by-id/...` name the device (two
of the same model without serial numbers share one), `/dev/v4l/by-path/...` the socket it is plugged into.
"""

from __future__ import annotations

import os
import struct
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

if sys.platform == "linux":
    from fcntl import ioctl
else:

    def ioctl(*_: object) -> int:
        """Stands in for Linux's call."""
        raise OSError(LINUX_ONLY)


LINUX_ONLY = "its driver can only be asked on Linux"
VIDIOC_QUERYCAP = 0x80685600
VIDIOC_ENUM_FMT = 0xC0405602
VIDIOC_ENUM_FRAMESIZES = 0xC02C564A
"""Requests to a driver, as `linux/videodev2.h` defines them."""
CAN_CAPTURE = 0x1
CAN_CAPTURE_MANY_PLANES = 0x1000
HAS_DEVICE_CAPS = 0x80000000
"""Bits of its answer, from the same file."""
BUFFER_CAPTURE = 1
BUFFER_CAPTURE_MANY_PLANES = 9
"""Kinds of buffers that pictures come in, from the same file."""
DISCRETE_SIZES = 1
"""A driver that lists sizes one by one, not as a range."""
CAPABILITY_BYTES = 104
FORMAT_BYTES = 64
FRAME_SIZE_BYTES = 44
"""Lengths of the structures `v4l2_capability`, `v4l2_fmtdesc` and `v4l2_frmsizeenum`."""
MAX_ENTRIES = 64
"""Entries of a list after which a driver is not listened to any more. Chosen by hand."""


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

    source : the steadiest name it has, to be used as a source. device : `/dev/videoN`. index : N.
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
    """The cameras that are plugged in, in the order of their indices; nothing is opened for reading pictures.

    Parameters
    ----------
    dev : the folder of devices.
    ask : asks a driver; Linux's V4L2 if not given.
    """
    ask = ask or ask_driver
    links: dict[str, list[str]] = {}
    for kind in ("by-id", "by-path"):
        folder = dev / "v4l" / kind
        for link in sorted(folder.iterdir()) if folder.is_dir() else []:
            links.setdefault(os.path.realpath(link), []).append(str(link))
    found = []
    for device in dev.glob("video*"):
        number = device.name.removeprefix("video")
        if not number.isdecimal():
            continue
        names = tuple(links.get(os.path.realpath(device), ()))
        abilities, problem = None, ""
        try:
            abilities = ask(device)
        except PermissionError:
            problem = "no permission: sudo usermod -aG video $USER, then log in again"
        except OSError as error:
            problem = error.strerror or str(error)
        source = names[0] if names else str(device)
        found.append(CameraInfo(source, str(device), int(number), names, abilities, problem))
    return sorted(found, key=lambda camera: camera.index)


def ask_driver(device: Path) -> Abilities:
    """Ask a V4L2 driver what it can do. Does not start the camera, and works while another program uses it.

    Raises
    ------
    OSError
        If the device cannot be opened, or is none of V4L2.
    """
    if sys.platform != "linux":
        raise OSError(LINUX_ONLY)
    handle = os.open(device, os.O_RDWR | os.O_NONBLOCK)
    try:
        reply = bytearray(CAPABILITY_BYTES)
        ioctl(handle, VIDIOC_QUERYCAP, reply)
        name = _text(reply[16:48])
        whole, own = struct.unpack_from("=II", reply, 84)
        can = own if whole & HAS_DEVICE_CAPS else whole
        pictures = bool(can & (CAN_CAPTURE | CAN_CAPTURE_MANY_PLANES))
        kind = BUFFER_CAPTURE if can & CAN_CAPTURE else BUFFER_CAPTURE_MANY_PLANES
        formats: dict[str, list[tuple[int, int]]] = {}
        for index in range(MAX_ENTRIES if pictures else 0):
            entry = bytearray(struct.pack("=II", index, kind).ljust(FORMAT_BYTES, b"\0"))
            try:
                ioctl(handle, VIDIOC_ENUM_FMT, entry)
            except OSError:
                break
            code = bytes(entry[44:48])
            formats[_text(code)] = _sizes(handle, code)
        return Abilities(name, pictures, formats)
    finally:
        os.close(handle)


def _sizes(handle: int, code: bytes) -> list[tuple[int, int]]:
    sizes: list[tuple[int, int]] = []
    for index in range(MAX_ENTRIES):
        entry = bytearray((struct.pack("=I", index) + code).ljust(FRAME_SIZE_BYTES, b"\0"))
        try:
            ioctl(handle, VIDIOC_ENUM_FRAMESIZES, entry)
        except OSError:
            break
        kind, width, height = struct.unpack_from("=III", entry, 8)
        if kind != DISCRETE_SIZES:
            break
        if (width, height) not in sizes:
            sizes.append((width, height))
    return sizes


def _text(raw: bytes | bytearray) -> str:
    return bytes(raw).partition(b"\0")[0].decode("utf-8", "replace").strip()
