"""Which cameras share a USB root hub, what each can reserve of it, and whether that fits. From Linux's sysfs.

A video camera reserves bandwidth by choosing an alternate setting of its streaming interface: each names the
bytes that the camera may send in a microframe of 125 us (in one of 1 ms at 12 Mbit/s). The host refuses a
camera for which too little is left ("No space left on device").

References
----------
Universal Serial Bus Specification 2.0, sections 5.6.3 and 5.6.4 (isochronous transfers), 9.6 (descriptors);
Universal Serial Bus 3.2 Specification, section 9.6.7 (endpoint companions). Files: Linux,
Documentation/ABI/stable/sysfs-bus-usb and drivers/usb/core/sysfs.c. Limits: `*_BW_LIMIT` and `*_BW_RESERVED`
in its drivers/usb/host/xhci.h.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Final, NamedTuple

from tactflow.system.spelling import joined

INTERFACE, ENDPOINT, COMPANION = 4, 5, 0x30
"""Types of descriptors."""
VIDEO, STREAMING = 14, 2
"""Class of interfaces, and the subclass that carries pictures."""
ISOCHRONOUS, BULK = 1, 2
"""Types of endpoints: with a reservation, and with what is left."""
HIGH_SPEED: Final = 480.0
"""Speed of USB 2, Mbit/s."""
CODING: Final = {12.0: 6 / 7, HIGH_SPEED: 6 / 7, 5000.0: 8 / 10}
"""Speed, Mbit/s -> the part of its bits that is data: one is stuffed after six, or eight become ten."""
FASTER: Final = 128 / 132
"""The same of faster buses."""
RAW_BYTES: Final = 2
"""Bytes of a pixel in the raw format of USB cameras, YUYV."""


def reservable(speed: float) -> float:
    """What all reservations of a bus may take of its speed, both in Mbit/s: 80 % of USB 2, 90 % of others."""
    return speed * CODING.get(speed, FASTER) * (0.8 if speed == HIGH_SPEED else 0.9)


class Alternate(NamedTuple):
    """A setting of a streaming interface: its number, what it reserves, Mbit/s, and whether it is of bulk
    transfers, which reserve nothing."""

    number: int
    reserves: float
    bulk: bool


class Mode(NamedTuple):
    """What a camera is asked for: px, frames per second, and a format such as YUYV or MJPG."""

    width: int
    height: int
    fps: float
    format: str

    @property
    def raw(self) -> bool:
        """Whether pictures travel uncompressed."""
        return self.format.upper() not in ("MJPG", "JPEG", "H264", "HEVC")

    @property
    def mbit(self) -> float:
        """What the pictures take uncompressed, Mbit/s."""
        return self.width * self.height * RAW_BYTES * 8 * self.fps / 1e6


@dataclass(frozen=True, slots=True)
class UsbCamera:
    """A camera on USB.

    device : `/dev/videoN`. name : for people. root : of its root hub, `usb1`. port : where it is plugged in,
    `1-3.2`. speed : Mbit/s. alternates : of its streaming interface. current : number of the one that is in
    use; 0 while it does not stream.
    """

    device: str
    name: str
    root: str
    port: str
    speed: float
    alternates: tuple[Alternate, ...] = ()
    current: int = 0

    @property
    def bulk(self) -> bool:
        """Whether it reserves nothing, and gets what is left."""
        return bool(self.alternates) and all(alternate.bulk for alternate in self.alternates)

    @property
    def reserved(self) -> float | None:
        """What it reserves now, Mbit/s; None while it does not stream."""
        found = [a.reserves for a in self.alternates if a.number == self.current and self.current]
        return found[0] if found else None

    def reserves(self, mode: Mode | None = None) -> float | None:
        """What it reserves, or may reserve, Mbit/s; None where that is not known.

        While it streams, what it reserves. Before, of raw pictures the least setting that carries them; of
        others the largest: a camera does not say what its compressed pictures need.
        """
        if self.reserved is not None:
            return self.reserved
        settings = sorted(alternate.reserves for alternate in self.alternates if not alternate.bulk)
        if not settings:
            return 0.0 if self.bulk else None
        enough = [setting for setting in settings if mode and mode.raw and setting >= mode.mbit]
        return enough[0] if enough else settings[-1]


@dataclass(frozen=True, slots=True)
class UsbBus:
    """A root hub and its cameras.

    root : `usb1`. speed : Mbit/s; None where not known. cameras : on it.
    """

    root: str
    speed: float | None
    cameras: tuple[UsbCamera, ...] = ()

    @property
    def budget(self) -> float | None:
        """What all reservations together may take, Mbit/s."""
        return None if self.speed is None else reservable(self.speed)

    def advice(
        self, modes: Mapping[str, Mode] | None = None, names: Mapping[str, str] | None = None
    ) -> Iterator[str]:
        """What to do, one sentence each; nothing where all fits.

        modes : device -> what it is asked for. names : device -> what messages call it.
        """
        called = [(names or {}).get(camera.device, camera.device) for camera in self.cameras]
        wanted = [camera.reserves((modes or {}).get(camera.device)) for camera in self.cameras]
        unknown = [name for name, mbit in zip(called, wanted, strict=True) if mbit is None]
        if self.budget is None or unknown:
            yield f"{joined(unknown or called)}: what the USB reserves is not known; compare the frame rates"
            return
        total = sum(mbit or 0.0 for mbit in wanted)
        for camera, name in zip(self.cameras, called, strict=True):
            mode = (modes or {}).get(camera.device)
            if mode and mode.raw and mode.mbit > reservable(camera.speed):
                yield (
                    f"{name} asks for {mode.mbit:.0f} Mbit/s of raw pictures on a port of "
                    f"{camera.speed:.0f}: ask for MJPG, fewer pixels or fewer frames"
                )
        if total > self.budget and len(called) > 1:
            most = "" if all(camera.reserved for camera in self.cameras) else " at most"
            yield (
                f"{joined(called)} share a {self.speed:.0f} Mbit/s hub ({self.root}) and reserve "
                f"{total:.0f} Mbit/s{most}, of {self.budget:.0f}: move one to another root hub, or ask for "
                f"{self._smaller(modes)}"
            )

    def _smaller(self, modes: Mapping[str, Mode] | None) -> str:
        if modes and all(not mode.raw for mode in modes.values()):
            return "fewer pixels"
        return "MJPG or fewer pixels"


def usb_buses(devices: Sequence[str], sys: Path = Path("/sys")) -> list[UsbBus]:
    """The root hubs that some cameras hang on, by name; cameras that are not on USB are left out.

    devices : `/dev/videoN` or links to such. sys : the folder where sysfs is mounted.
    """
    cameras: dict[str, UsbCamera] = {}
    for device in devices:
        camera = _camera(device, sys)
        # A second device of the same camera carries metadata.
        if camera is not None and camera.port not in [c.port for c in cameras.values()]:
            cameras[camera.device] = camera
    buses = []
    for root in sorted({camera.root for camera in cameras.values()}):
        here = tuple(camera for camera in cameras.values() if camera.root == root)
        folder = next(iter(sys.glob(f"bus/usb/devices/{root}")), None)
        speed = None if folder is None else _number(folder / "speed")
        buses.append(UsbBus(root, speed, here))
    return buses


def _camera(device: str, sys: Path) -> UsbCamera | None:
    real = os.path.realpath(device)
    node = sys / "class/video4linux" / Path(real).name
    interface = (node / "device").resolve()
    folder = interface.parent
    root = next((part for part in folder.parts if part.startswith("usb") and part[3:].isdecimal()), None)
    if root is None or not (folder / "speed").exists():
        return None
    name = _text(folder / "product") or _text(node / "name") or node.name
    current = 0
    for streaming_interface in folder.glob(f"{folder.name}:*"):
        kind = (
            _text(streaming_interface / "bInterfaceClass"),
            _text(streaming_interface / "bInterfaceSubClass"),
        )
        if kind == (f"{VIDEO:02x}", f"{STREAMING:02x}"):
            current = max(current, int(_number(streaming_interface / "bAlternateSetting") or 0))
    speed = _number(folder / "speed") or 0.0
    try:
        alternates = tuple(read_alternates((folder / "descriptors").read_bytes(), speed))
    except OSError:
        alternates = ()
    return UsbCamera(real, name, root, folder.name, speed, alternates, current)


def read_alternates(descriptors: bytes, speed: float) -> Iterator[Alternate]:
    """The settings of the video streaming interface, from a device's descriptors as sysfs gives them.

    speed : of the device, Mbit/s: it says how many intervals a second has. Damaged descriptors end the list.

    >>> interface = bytes([9, 4, 1, 2, 1, 14, 2, 0, 0])
    >>> endpoint = bytes([7, 5, 0x81, 5, 0x00, 0x14, 1])
    >>> list(read_alternates(interface + endpoint, 480.0))
    [Alternate(number=2, reserves=196.608, bulk=False)]
    """
    number: int | None = None
    blocks = [*_descriptors(descriptors), bytes(2)]
    for block, next_block in pairwise(blocks):
        if block[1] == INTERFACE and len(block) >= 9:
            number = block[3] if (block[5], block[6]) == (VIDEO, STREAMING) else None
        elif block[1] == ENDPOINT and len(block) >= 7 and number is not None:
            kind, size = block[3] & 3, int.from_bytes(block[4:6], "little")
            fast = speed >= HIGH_SPEED
            count = (size & 0x7FF) * (1 + (size >> 11 & 3) if fast else 1)
            if next_block[1] == COMPANION and len(next_block) >= 6:
                # At USB 3 the companion says how many bytes an interval has.
                count = int.from_bytes(next_block[4:6], "little")
            intervals = (8000 if fast else 1000) / 2 ** (max(block[6], 1) - 1)
            if kind in (ISOCHRONOUS, BULK):
                mbit = 8e-6 * count * intervals
                yield Alternate(number, 0.0 if kind == BULK else mbit, kind == BULK)


def _descriptors(data: bytes) -> Iterator[bytes]:
    """The whole descriptors, each of which begins with its length."""
    while len(data) >= 2 and 2 <= data[0] <= len(data):
        yield data[: data[0]]
        data = data[data[0] :]


def _text(path: Path) -> str:
    try:
        return path.read_text(errors="replace").strip()
    except OSError:
        return ""


def _number(path: Path) -> float | None:
    try:
        return float(_text(path))
    except ValueError:
        return None
