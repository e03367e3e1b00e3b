"""The list of cameras, in a made-up folder of devices."""

from __future__ import annotations

import argparse
import re
from pathlib import Path

import pytest

from tactflow.cli import cameras as command
from tactflow.sources.cameras import list_cameras


@pytest.fixture
def dev(tmp_path: Path) -> Path:
    """Two devices of one camera, links to the first as udev makes them, and a third without links."""
    for name in ("video10", "video0", "video1", "videotape", "null"):
        (tmp_path / name).touch()
    for kind, name in (("by-id", "usb-GelSight_R0B1-video-index0"), ("by-path", "pci-0000:00:14.0-usb-0:3")):
        folder = tmp_path / "v4l" / kind
        folder.mkdir(parents=True)
        (folder / name).symlink_to("../../video0")
    return tmp_path


def ask(device: Path) -> tuple[str, bool]:
    if device.name == "video10":
        raise PermissionError(13, "Permission denied")
    return "GelSight Mini", device.name == "video0"


def test_cameras_are_listed_by_index_under_their_steadiest_names(dev: Path) -> None:
    (dev / "v4l" / "by-id" / "usb-Unplugged-video-index0").symlink_to("../../video7")
    cameras = list_cameras(dev, ask)
    assert [camera.index for camera in cameras] == [0, 1, 10]
    by_id = f"{dev}/v4l/by-id/usb-GelSight_R0B1-video-index0"
    assert cameras[0].source == by_id
    assert cameras[0].names == (by_id, f"{dev}/v4l/by-path/pci-0000:00:14.0-usb-0:3")
    assert cameras[1].source == f"{dev}/video1"
    assert [(camera.name, camera.pictures) for camera in cameras] == [
        ("GelSight Mini", True),
        ("GelSight Mini", False),
        ("", True),
    ]
    assert "usermod -aG video" in cameras[2].problem


def test_a_device_that_is_no_camera_is_listed_with_the_drivers_refusal(dev: Path) -> None:
    camera = list_cameras(dev)[0]
    assert camera.name == ""
    assert camera.problem


def test_a_camera_is_described_with_all_its_names(dev: Path) -> None:
    first, second, third = ("\n".join(command.describe(camera)) for camera in list_cameras(dev, ask))
    assert first.startswith(f"{dev}/v4l/by-id/usb-GelSight_R0B1-video-index0\n    GelSight Mini: ")
    assert "(--source 0)" in first
    assert "also " in first
    assert "only metadata" in second
    assert "no permission" in third


def test_the_command_lists_cameras(dev: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert command.run(argparse.Namespace(dev=dev)) == 0
    assert re.findall(r"--source (\d+)", capsys.readouterr().out) == ["0", "1", "10"]


def test_without_a_camera_the_command_says_what_to_try(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for system, hint in (("linux", "no camera is plugged in"), ("darwin", "--source 0")):
        monkeypatch.setattr(command.sys, "platform", system)
        assert command.run(argparse.Namespace(dev=tmp_path)) == 0
        out, err = capsys.readouterr()
        assert out == ""
        assert hint in err
