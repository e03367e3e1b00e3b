"""Which cameras share a USB root hub, and so its bandwidth. From Linux's sysfs.

Files: Linux, Documentation/ABI/stable/sysfs-bus-usb.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple


class UsbCamera(NamedTuple):
    """A camera on USB.

    device : `/dev/videoN`. name : for people. port : where it is plugged in, `1-3.2`. speed : Mbit/s.
    """

    device: str
    name: str
    port: str
    speed: str


class UsbHub(NamedTuple):
    """A root hub and its cameras. root : `usb1`. speed : Mbit/s."""

    root: str
    speed: str
    cameras: list[UsbCamera]


def usb_hubs(devices: Sequence[str], sys: Path = Path("/sys")) -> list[UsbHub]:
    """The root hubs of some cameras, by name; cameras that are not on USB are left out.

    devices : `/dev/videoN` or links to such. sys : the folder where sysfs is mounted.
    """
    hubs: dict[str, UsbHub] = {}
    for device in devices:
        real = os.path.realpath(device)
        node = sys / "class/video4linux" / Path(real).name
        # The device file belongs to an interface of the camera; above are the camera, hubs and the root hub.
        folder = (node / "device").resolve().parent
        root = next((part for part in folder.parents if (part / "speed").exists()), None)
        while root is not None and (root.parent / "speed").exists():
            root = root.parent
        if root is None:
            continue
        hub = hubs.setdefault(root.name, UsbHub(root.name, _text(root / "speed"), []))
        # A second device of the same camera carries metadata.
        if folder.name not in [camera.port for camera in hub.cameras]:
            name = _text(folder / "product") or _text(node / "name") or node.name
            hub.cameras.append(UsbCamera(real, name, folder.name, _text(folder / "speed")))
    return [hubs[root] for root in sorted(hubs)]


def _text(path: Path) -> str:
    try:
        return path.read_text(errors="replace").strip()
    except OSError:
        return ""
