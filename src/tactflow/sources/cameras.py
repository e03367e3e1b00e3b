"""The cameras of this machine, under names that stay the same.

`/dev/videoN` is numbered in the order of plugging in. udev's links `/dev/v4l/by-id/...` name the device (two
of the same model without serial numbers share one), `/dev/v4l/by-path/...` the socket it is plugged into.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

SYSFS = Path("/sys/class/video4linux")
"""Where Linux describes its video devices: a folder for each, with the files `name` and `index`."""


@dataclass(frozen=True, slots=True)
class CameraInfo:
    """A camera of this machine.

    source : its most stable name, to be used as a source. device : `/dev/videoN`. index : N.
    names : all links to it. model : what it calls itself, "" if unknown. part : number of this device among
    those of the same camera, of which those after 0 often only carry metadata. permitted : whether this user
    may open it.
    """

    source: str
    device: str
    index: int
    names: tuple[str, ...]
    model: str
    part: int
    permitted: bool


def list_cameras(dev: Path = Path("/dev"), sysfs: Path = SYSFS) -> list[CameraInfo]:
    """The cameras that are plugged in, by index; none of them is opened.

    dev, sysfs : the folders of devices, and of what Linux knows of them.
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
        camera = CameraInfo(
            source=names[0] if names else str(device),
            device=str(device),
            index=int(number),
            names=names,
            model=_read(sysfs / device.name / "name"),
            part=int(_read(sysfs / device.name / "index") or 0),
            permitted=os.access(device, os.R_OK | os.W_OK),
        )
        cameras.append(camera)
    return sorted(cameras, key=lambda camera: camera.index)


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""
