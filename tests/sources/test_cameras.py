"""The list of cameras, in a made-up folder of devices."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import pytest

from tactflow.cli import cameras as command
from tactflow.sources.cameras import list_cameras


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path]:
    """Two devices of one camera, links to the first as udev makes them, and a third without a description."""
    dev, sysfs = tmp_path / "dev", tmp_path / "sys"
    dev.mkdir()
    for name in ("video10", "video0", "video1", "videotape", "null"):
        (dev / name).touch()
    for kind, name in (("by-id", "usb-GelSight_R0B1-video-index0"), ("by-path", "pci-0000:00:14.0-usb-0:3")):
        folder = dev / "v4l" / kind
        folder.mkdir(parents=True)
        (folder / name).symlink_to("../../video0")
    for index in range(2):
        folder = sysfs / f"video{index}"
        folder.mkdir(parents=True)
        (folder / "name").write_text("GelSight Mini\n")
        (folder / "index").write_text(f"{index}\n")
    return dev, sysfs


def test_cameras_are_listed_by_index_under_their_steadiest_names(folders: tuple[Path, Path]) -> None:
    dev, _ = folders
    (dev / "v4l" / "by-id" / "usb-Unplugged-video-index0").symlink_to("../../video7")
    cameras = list_cameras(*folders)
    assert [camera.index for camera in cameras] == [0, 1, 10]
    by_id = f"{dev}/v4l/by-id/usb-GelSight_R0B1-video-index0"
    assert cameras[0].source == by_id
    assert cameras[0].names == (by_id, f"{dev}/v4l/by-path/pci-0000:00:14.0-usb-0:3")
    assert cameras[1].source == f"{dev}/video1"
    assert [(camera.model, camera.part) for camera in cameras] == [
        *(("GelSight Mini", 0), ("GelSight Mini", 1), ("", 0)),
    ]


def test_a_camera_is_described_with_all_its_names(
    folders: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    # Root may open everything.
    monkeypatch.setattr("os.access", lambda path, _: path.name != "video10")
    first, second, third = ("\n".join(command.describe(camera)) for camera in list_cameras(*folders))
    assert first.startswith(f"{folders[0]}/v4l/by-id/usb-GelSight_R0B1-video-index0\n    GelSight Mini: ")
    assert "(--source 0)" in first
    assert "also " in first
    assert "metadata" not in first
    assert "may carry only metadata" in second
    assert "no permission" in third


def test_the_command_lists_cameras_as_json(
    folders: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    assert command.run(argparse.Namespace(dev=folders[0], sysfs=folders[1], json=True)) == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [line["index"] for line in lines] == [0, 1, 10]


@pytest.mark.parametrize(
    ("system", "words"),
    [
        ("linux", ["no camera is plugged in", "dmesg"]),
        ("darwin", ["--source 0"]),
        ("win32", ["--source 0"]),
    ],
)
def test_without_a_camera_the_command_says_what_to_try(
    system: str,
    words: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(command.sys, "platform", system)
    assert command.run(argparse.Namespace(dev=tmp_path, sysfs=tmp_path, json=False)) == 0
    out, err = capsys.readouterr()
    assert out == ""
    assert all(word in err for word in words)
