"""What shares a USB root hub, in trees as Linux's sysfs lays them out.

Files and their formats are those of drivers/usb/core/sysfs.c. The descriptors are those of a Logitech C270
(046d:0825, its units, formats and most of its microphone left out), as dumped in
https://github.com/espressif/esp-usb, host/class/uvc/usb_host_uvc/host_test/main/parsing/descriptors.
"""

from __future__ import annotations

import struct
from pathlib import Path

import pytest

from tactflow.sources.usb import Mode, UsbBus, read_alternates, reservable, usb_buses

YUYV = Mode(640, 480, 30, "YUYV")
SMALL = Mode(320, 240, 30, "YUYV")
MJPG = Mode(640, 480, 30, "MJPG")
DEVICE = bytes.fromhex("12010002ef020140 6d04250812000000 0201 0902a209040100 80fa 080b00020e030000")
CONTROL = bytes.fromhex("09040000010e010000 07058703100008 0525031000")
IDLE = bytes.fromhex("09040100000e020000 06240d010104")
PACKETS = (0x00C0, 0x0180, 0x0200, 0x0280, 0x0320, 0x03B0, 0x0A80, 0x0B20, 0x0BE0, 0x1380, 0x13FC)
"""wMaxPacketSize of the settings 1 to 11: up to three packets of 1020 bytes in a microframe."""
MICROPHONE = bytes.fromhex("090403000001020000 0904030101010200 00 0905860544000400 00")
BULK = bytes.fromhex("09040100010e020000 07058102000200")
"""Streaming interface of a camera that reserves nothing: it has this setting alone."""


def descriptors(*, bulk: bool = False, companion: bool = False) -> bytes:
    """Those of the camera; or, by the specifications, of one that uses bulk transfers, or USB 3."""
    if bulk:
        return DEVICE + CONTROL + BULK
    data = DEVICE + CONTROL + IDLE
    for number, size in enumerate(PACKETS, 1):
        data += bytes([9, 4, 1, number, 1, 14, 2, 0, 0])
        data += struct.pack("<BBBBHB", 7, 5, 0x81, 5, 1024 if companion else size, 1)
        data += struct.pack("<BBBBH", 6, 0x30, 15, 0, 16 * 1024) if companion else b""
    return data + MICROPHONE


def add_device(sys: Path, root: str, port: str, product: str, speed: str, interfaces: dict[str, str]) -> Path:
    """A device below a root hub. interfaces : number -> class and subclass."""
    hub = sys / "devices/pci0000:00/0000:00:14.0" / root
    folder = hub / port
    links = sys / "bus/usb/devices"
    links.mkdir(parents=True, exist_ok=True)
    for number, kind in interfaces.items():
        interface = folder / f"{port}:{number}"
        interface.mkdir(parents=True)
        (interface / "bInterfaceClass").write_text(f"{kind[:2]}\n")
        (interface / "bInterfaceSubClass").write_text(f"{kind[2:]}\n")
        (interface / "bAlternateSetting").write_text(" 0\n")
        (links / interface.name).symlink_to(interface)
    (folder / "speed").write_text(f"{speed}\n")
    if product:
        (folder / "product").write_text(f"{product}\n")
    if not (links / root).exists():
        (hub / "speed").write_text("5000\n" if speed == "5000" else "480\n")
        (links / root).symlink_to(hub)
    return folder


def add_camera(
    sys: Path, number: int, root: str, port: str, speed: str = "480", *, bulk: bool = False
) -> Path:
    folder = add_device(sys, root, port, "", speed, {"1.0": "0e01", "1.1": "0e02"})
    (folder / "descriptors").write_bytes(descriptors(bulk=bulk, companion=speed == "5000"))
    for device in (2 * number, 2 * number + 1):
        link = sys / f"class/video4linux/video{device}"
        link.mkdir(parents=True)
        (link / "device").symlink_to(folder / f"{port}:1.0")
        (link / "name").write_text(f"Gel {number}\n")
    return folder


def buses(sys: Path) -> list[UsbBus]:
    return usb_buses([f"/dev/video{number}" for number in range(8)], sys)


def advice(sys: Path, mode: Mode | None = None) -> list[str]:
    names = {"/dev/video0": "left", "/dev/video2": "right", "/dev/video4": "thumb"}
    modes = {} if mode is None else dict.fromkeys(names, mode)
    return [line for bus in buses(sys) for line in bus.advice(modes, names)]


def test_two_small_cameras_fit(tmp_path: Path) -> None:
    add_camera(tmp_path, 0, "usb1", "1-1")
    add_camera(tmp_path, 1, "usb1", "1-2.3")
    (bus,) = buses(tmp_path)
    assert [camera.name for camera in bus.cameras] == ["Gel 0", "Gel 1"]
    assert bus.budget == pytest.approx(329, abs=0.5)
    # 320 x 240 x 2 bytes x 30 = 37 Mbit/s, which 640 bytes 8000 times a second carry.
    assert [camera.reserves(SMALL) for camera in bus.cameras] == [pytest.approx(40.96)] * 2
    assert advice(tmp_path, SMALL) == []


def test_two_cameras_that_may_reserve_all_do_not_fit_until_they_stream_with_less(tmp_path: Path) -> None:
    folders = [add_camera(tmp_path, number, "usb1", f"1-{number + 1}") for number in range(2)]
    (said,) = advice(tmp_path, MJPG)
    assert said == (
        "left and right share a 480 Mbit/s hub (usb1) and reserve 392 Mbit/s at most, of 329: move one to "
        "another root hub, or ask for fewer pixels"
    )
    assert "or ask for MJPG or fewer pixels" in advice(tmp_path, YUYV)[0]
    for folder in folders:
        (folder / f"{folder.name}:1.1" / "bAlternateSetting").write_text(" 9\n")
    (bus,) = buses(tmp_path)
    assert [camera.reserved for camera in bus.cameras] == [pytest.approx(126.976)] * 2
    assert advice(tmp_path, MJPG) == []


def test_what_the_kernel_refused_does_not_fit() -> None:
    # Two video grabbers with packets of 2688 and 2892 bytes: not within 80 % of the bus, but within 90 %.
    # Linux, commit cc62a7eb6396e8be95b9a30053ed09191818b99b.
    rates = [8e-6 * 8000 * size for size in (2688, 2892)]
    assert reservable(480.0) < sum(rates) < 9 / 8 * reservable(480.0)


def test_more_raw_pictures_than_a_port_carries_are_told(tmp_path: Path) -> None:
    add_camera(tmp_path, 0, "usb1", "1-1")
    (said,) = advice(tmp_path, Mode(1280, 960, 30, "YUYV"))
    assert said.startswith("left asks for 590 Mbit/s of raw pictures on a port of 480: ask for MJPG")


def test_cameras_of_usb_3_fit_on_a_hub_of_their_own(tmp_path: Path) -> None:
    for number in range(3):
        add_camera(tmp_path, number, "usb2", f"2-{number + 1}", "5000")
    (bus,) = buses(tmp_path)
    assert bus.budget == pytest.approx(3600)
    # The companion's 16 KiB, 8000 times a second.
    assert {round(camera.reserves() or 0) for camera in bus.cameras} == {1049}
    assert advice(tmp_path, Mode(1280, 960, 30, "YUYV")) == []


def test_where_sysfs_does_not_tell_it_is_said(tmp_path: Path) -> None:
    folder = add_camera(tmp_path, 0, "usb1", "1-1")
    (folder / "descriptors").write_bytes(descriptors()[:60])
    assert advice(tmp_path) == ["left: what the USB reserves is not known; compare the frame rates"]
    (folder / "descriptors").unlink()
    assert "not known" in advice(tmp_path)[0]
    (tmp_path / "class/video4linux/video6").mkdir()
    assert usb_buses(["/dev/video6", "/dev/video9"], tmp_path) == []


@pytest.mark.parametrize("cut", range(0, 250, 13))
def test_damaged_descriptors_end_the_list(cut: int) -> None:
    whole = list(read_alternates(descriptors(), 480.0))
    numbers = [round(alternate.reserves, 1) for alternate in whole]
    assert numbers == [12.3, 24.6, 32.8, 41.0, 51.2, 60.4, 81.9, 102.4, 127.0, 172.0, 195.8]
    assert list(read_alternates(descriptors()[:cut], 480.0)) in [whole[:count] for count in range(12)]
    assert list(read_alternates(b"\0" * cut, 480.0)) == []
