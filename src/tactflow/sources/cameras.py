"""The cameras of this machine, with persistent names.

`/dev/videoN` is numbered in the order of connection. udev's links `/dev/v4l/by-id/...` name the device
(cameras of one model without serial numbers share a link), `/dev/v4l/by-path/...` the port.
"""

from __future__ import annotations

import os
import struct
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

if sys.platform == "linux":
    from fcntl import ioctl
else:

    def ioctl(*_: object) -> int:
        """Stands in for Linux's call."""
        raise OSError("the driver can only be asked on Linux")


VIDIOC_QUERYCAP = 0x80685600
"""Request to a driver (`linux/videodev2.h`); bits 16 to 29 are the length of the reply."""
CAN_CAPTURE = 0x1 | 0x1000
HAS_DEVICE_CAPS = 0x80000000
"""Bits of the reply, from the same file: pictures in one plane or several; whether its last word is valid."""


@dataclass(frozen=True, slots=True)
class CameraInfo:
    """A camera of this machine.

    Attributes
    ----------
    source : its most persistent name, for use as a source.
    device : `/dev/videoN`.
    index : N.
    names : all links to it.
    name : by its driver; empty if that cannot be asked, because of `problem`.
    pictures : whether it delivers any; many cameras have a second device with metadata only. Assumed where
        the driver cannot be asked.
    """

    source: str
    device: str
    index: int
    names: tuple[str, ...] = ()
    name: str = ""
    pictures: bool = True
    problem: str = ""


def list_cameras(
    dev: Path = Path("/dev"), ask: Callable[[Path], tuple[str, bool]] | None = None
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
        name, pictures, problem = "", True, ""
        try:
            name, pictures = (ask or ask_driver)(device)
        except PermissionError:
            problem = "no permission: sudo usermod -aG video $USER, then log in again"
        except OSError as error:
            problem = error.strerror or str(error)
        source = names[0] if names else str(device)
        cameras.append(CameraInfo(source, str(device), int(number), names, name, pictures, problem))
    return sorted(cameras, key=lambda camera: camera.index)


def ask_driver(device: Path) -> tuple[str, bool]:
    """The name of a V4L2 device, and whether it delivers pictures; also while another program uses it.

    Raises
    ------
    OSError
        If the device cannot be opened, or is not one of V4L2.
    """
    handle = os.open(device, os.O_RDWR | getattr(os, "O_NONBLOCK", 0))
    try:
        answer = bytearray(VIDIOC_QUERYCAP >> 16 & 0x3FFF)
        ioctl(handle, VIDIOC_QUERYCAP, answer)
    finally:
        os.close(handle)
    driver, own = struct.unpack_from("=II", answer, 84)
    name = bytes(answer[16:48]).partition(b"\0")[0].decode("utf-8", "replace").strip()
    return name, bool((own if driver & HAS_DEVICE_CAPS else driver) & CAN_CAPTURE)
