"""Cameras, which a stand-in for OpenCV plays."""

from __future__ import annotations

import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from tactflow.engine.errors import SourceError
from tactflow.sources import CameraRequest, devices, open_source


@pytest.mark.parametrize(
    ("present", "device", "expected"),
    [
        ([], "0", "no camera is plugged in .*; to try it without one: --source sim:press"),
        ([], "99999999999999999999", "no camera is plugged in"),
        (
            ["/dev/video2", "/dev/video10"],
            "63",
            "/dev/video63 does not exist; this machine has /dev/video2, ",
        ),
        (["/dev/video2"], "/dev/video63", "/dev/video63 does not exist"),
        (["/dev/video2"], "/dev/v4l/by-id/gel", "/dev/v4l/by-id/gel does not exist"),
    ],
)
def test_a_camera_that_is_not_there_is_an_error_that_lists_those_that_are(
    present: list[str],
    device: str,
    expected: str,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(devices.glob, "glob", lambda _pattern: present)
    with pytest.raises(SourceError, match=expected):
        open_source(device, camera=CameraRequest(640, 480, 30.0, "MJPG"))
    assert capfd.readouterr().err == ""


def test_a_camera_without_permission_says_which_group_to_join(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    device = tmp_path / "video0"
    device.touch()
    monkeypatch.setattr(devices.glob, "glob", lambda _pattern: [str(device)])
    monkeypatch.setattr(devices.os, "access", lambda _path, _mode: False)
    with pytest.raises(SourceError, match=r"no permission .* usermod -aG video"):
        devices.Camera(str(device))


class _FakeCapture:
    """Stands in for OpenCV's capture: a driver that rounds what it is asked for."""

    def __init__(self, frames: int = 2) -> None:
        self.asked: list[int] = []
        self._frames = frames

    def isOpened(self) -> bool:  # noqa: N802
        return True

    def set(self, prop: int, _value: float) -> bool:
        self.asked.append(prop)
        return True

    def get(self, prop: int) -> float:
        return {
            cv2.CAP_PROP_FRAME_WIDTH: 640.0,
            cv2.CAP_PROP_FRAME_HEIGHT: 480.0,
            cv2.CAP_PROP_FPS: 30.0,
            cv2.CAP_PROP_FOURCC: float(cv2.VideoWriter.fourcc(*"YUYV")),
        }[prop]

    def read(self) -> tuple[bool, np.ndarray | None]:
        self._frames -= 1
        return (True, np.zeros((480, 640, 3), np.uint8)) if self._frames >= 0 else (False, None)

    def release(self) -> None:
        pass


def test_a_camera_reports_what_it_got_instead_of_what_was_asked_for(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    fake = _FakeCapture()
    monkeypatch.setattr(devices.cv2, "VideoCapture", lambda *_: fake)
    camera = devices.Camera("0", CameraRequest(1920, 480, 60.0, "MJPG"))
    assert camera.live
    assert camera.size == (640, 480)
    assert camera.description == "camera 0, 640 x 480 at 30 fps, YUYV"
    for difference in ("width 1920 -> 640", "fps 60 -> 30", "format MJPG -> YUYV"):
        assert difference in caplog.text
    assert "height" not in caplog.text
    assert fake.asked[0] == cv2.CAP_PROP_FOURCC, "the format decides which sizes there are"
    caplog.clear()
    devices.Camera("0", CameraRequest(640, 480, 30.0, "yuyv"))
    assert caplog.text == ""


def test_frames_of_a_camera_carry_unix_time_and_its_end_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(devices.cv2, "VideoCapture", lambda *_: _FakeCapture(frames=2))
    camera = devices.Camera("0")
    now = time.time()
    # Somebody sets the system's clock: it changes neither order nor differences.
    monkeypatch.setattr(time, "time", lambda: 0.0)
    first, second = camera.read(), camera.read()
    assert first is not None
    assert second is not None
    # 60 s: only to tell Unix time from another clock.
    assert abs(first[1] - now) < 60
    assert second[1] > first[1]
    with pytest.raises(SourceError, match="no more frames"):
        camera.read()
    camera.close()
    assert camera.read() is None
