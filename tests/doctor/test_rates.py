"""The rates of several sensors at once, from cameras that are made up."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tactflow.cli.main import main
from tactflow.doctor import Sensor, measure_together, rates
from tactflow.engine.errors import SourceError
from tactflow.sources import CameraRequest, FrameReader
from tactflow.sources.usb import UsbCamera, UsbHub


class Clock:
    """Stands in for `time`: each frame of a slow camera takes twice as long as asked for."""

    def __init__(self, step: float) -> None:
        self.now, self.step = 0.0, step

    def monotonic(self) -> float:
        self.now += self.step
        return self.now


class Camera(FrameReader):
    """Ten frames, then it ends."""

    live = True

    def __init__(self, spec: str, request: CameraRequest) -> None:
        super().__init__(spec)
        self.fps, self.left, self.size = 30.0, 10, (640, 480)
        self.description = f"camera {spec}, 640 x 480 at 30 fps, {request.format or 'YUYV'}"

    def read(self) -> tuple[np.ndarray, float] | None:  # type: ignore[type-arg]
        self.left -= 1
        return (np.zeros((480, 640, 3), np.uint8), 0.0) if self.left >= 0 else None


@pytest.fixture(autouse=True)
def cameras(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cameras under any number; `gone` cannot be opened."""

    def opened(spec: str, *, camera: CameraRequest) -> FrameReader:
        if spec == "gone":
            raise SourceError("gone: cannot be opened; no such camera")
        return Camera(spec, camera)

    monkeypatch.setattr(rates, "open_source", opened)
    monkeypatch.setattr(rates, "usb_hubs", lambda _: [])


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        (60.0, "delivers 15.0 of 60 frames/s, because its driver promises 30"),
        (None, "delivers 15.0 of 30 frames/s, and"),
    ],
)
def test_a_slow_sensor_is_told_with_what_holds_it_down(
    monkeypatch: pytest.MonkeyPatch, asked: float | None, words: str
) -> None:
    monkeypatch.setattr(rates, "time", Clock(1 / 15))
    together = measure_together([Sensor("left", "0", CameraRequest(fps=asked))], 30.0)
    assert together.rates[0].got == pytest.approx(15.0)
    assert together.fault
    assert together.advice[0].startswith(f"left {words}")


def test_a_hub_that_slow_sensors_share_is_named_in_place_of_each(monkeypatch: pytest.MonkeyPatch) -> None:
    cameras = [UsbCamera(f"/dev/video{number}", "Gel", f"1-{number}", "480") for number in (0, 2)]
    monkeypatch.setattr(rates, "usb_hubs", lambda _: [UsbHub("usb1", "480", cameras)])
    sensors = [Sensor("left", "0", CameraRequest()), Sensor("right", "2", CameraRequest())]
    monkeypatch.setattr(rates, "time", Clock(1 / 120))
    assert not measure_together(sensors, 30.0).advice
    monkeypatch.setattr(rates, "time", Clock(1 / 15))
    (line,) = measure_together(sensors, 30.0).advice
    assert line.startswith(
        "left and right share the USB hub usb1 of 480 Mbit/s: move one to another root hub"
    )


def test_the_command_prints_every_sensor_of_a_file_and_fails_for_one_that_is_gone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "two.yaml"
    file.write_text(
        "stages: {capture: {fps: 30}, preprocess: {}}\nsinks: {}\n"
        "sensors:\n  left: {stages: {capture: {source: '0'}}}\n  right: {stages: {capture: {source: gone}}}\n"
    )
    assert main(["doctor", str(file), "--seconds", "30"]) == 3
    out = capsys.readouterr().out
    assert "SENSOR" in out
    assert "left" in out
    assert "right: gone: cannot be opened; no such camera" in out
    assert main(["doctor", str(file), "--seconds", "30", "--json"]) == 3
    found = json.loads(capsys.readouterr().out)
    assert [rate["sensor"] for rate in found["rates"]] == ["left", "right"]
    assert main(["doctor", str(file), "--report", str(tmp_path / "report.json")]) == 2
