"""Which cameras share a USB root hub, in trees as Linux's sysfs lays them out (drivers/usb/core/sysfs.c)."""

from __future__ import annotations

from pathlib import Path

from tactflow.sources.usb import UsbCamera, UsbHub, usb_hubs


def add_camera(sys: Path, number: int, root: str, *ports: str, product: str = "") -> None:
    """A camera behind a root hub and further hubs, with a device file for pictures and one for metadata."""
    speed = "5000\n" if root == "usb2" else "480\n"
    folder = sys / "devices/pci0000:00/0000:00:14.0"
    for part in (root, *ports):
        folder = folder / part
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "speed").write_text(speed)
    if product:
        (folder / "product").write_text(f"{product}\n")
    interface = folder / f"{ports[-1]}:1.0"
    interface.mkdir()
    for device in (2 * number, 2 * number + 1):
        link = sys / f"class/video4linux/video{device}"
        link.mkdir(parents=True)
        (link / "device").symlink_to(interface)
        (link / "name").write_text(f"Gel {number}\n")


def test_cameras_are_listed_once_by_the_root_hub_that_they_share(tmp_path: Path) -> None:
    add_camera(tmp_path, 0, "usb2", "2-1")
    add_camera(tmp_path, 1, "usb1", "1-1")
    add_camera(tmp_path, 2, "usb1", "1-2", "1-2.3", product="GelSight Mini")
    other = tmp_path / "class/video4linux/video8"
    other.mkdir()
    devices = [f"/dev/video{number}" for number in range(10)]
    assert usb_hubs(devices, tmp_path) == [
        UsbHub(
            "usb1",
            "480",
            [
                UsbCamera("/dev/video2", "Gel 1", "1-1", "480"),
                UsbCamera("/dev/video4", "GelSight Mini", "1-2.3", "480"),
            ],
        ),
        UsbHub("usb2", "5000", [UsbCamera("/dev/video0", "Gel 0", "2-1", "5000")]),
    ]
