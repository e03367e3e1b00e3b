"""The frame rates of all sensors of a pipeline while they run together, and what holds them down."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import ExitStack, closing
from dataclasses import dataclass
from typing import Any, Final

from tactflow.engine.errors import SourceError
from tactflow.sources import CameraRequest, open_source
from tactflow.sources.usb import UsbHub, usb_hubs
from tactflow.system.spelling import joined

LOW: Final = 0.9
"""Part of the rate asked for, or else promised, below which a sensor is too slow."""
VERY_LOW: Final = 0.7
"""The same below which results are missed: the limit of the check `rate`."""


@dataclass(frozen=True, slots=True)
class Sensor:
    """A sensor to try. source : as `open_source` takes it. request : what to ask a camera for."""

    name: str
    source: str
    request: CameraRequest

    @classmethod
    def of(cls, name: str, params: Any) -> Sensor:
        """The sensor of a pipeline. params : of its stage capture."""
        return cls(name, params.source, CameraRequest(params.width, params.height, params.fps, params.format))


@dataclass(slots=True)
class Rate:
    """How fast one sensor was beside the others.

    asked : by the pipeline; promised : by the driver; got : frames per second; None where there is none.
    description : what was opened. problem : why it could not be read, or "". size : (width, height), px.
    live : a camera or stream; a recording is read as fast as it can be.
    """

    sensor: str
    asked: float | None
    promised: float | None = None
    got: float | None = None
    description: str = ""
    problem: str = ""
    size: tuple[int, int] | None = None
    live: bool = False

    @property
    def share(self) -> float:
        """Got over asked, or else promised; 1 of a recording and where neither is known, 0 without frames."""
        if self.got is None:
            return 0.0
        wanted = self.asked or self.promised
        return self.got / wanted if self.live and wanted else 1.0


@dataclass(frozen=True, slots=True)
class Together:
    """All sensors at once. rates : of each. hubs : that their cameras hang on. advice : sentences."""

    rates: Sequence[Rate]
    hubs: Sequence[UsbHub]
    advice: Sequence[str]

    @property
    def fault(self) -> bool:
        """Whether a sensor is far too slow, or cannot be read."""
        return any(rate.share < VERY_LOW for rate in self.rates)


def measure_together(sensors: Sequence[Sensor], seconds: float) -> Together:
    """Read all sensors at the same time, each in a thread, and say what holds slow ones down.

    seconds : from when all are open, or until all have ended.
    """
    rates = [Rate(sensor.name, sensor.request.fps) for sensor in sensors]
    ready, go, stop = threading.Semaphore(0), threading.Event(), threading.Event()
    with ThreadPoolExecutor(len(sensors)) as pool:
        pairs = zip(sensors, rates, strict=True)
        readers = [pool.submit(_count, sensor, rate, ready, go, stop) for sensor, rate in pairs]
        try:
            for _ in sensors:
                ready.acquire()
            go.set()
            wait(readers, seconds)
        finally:
            stop.set()
            go.set()
    for reader in readers:
        reader.result()
    hubs = usb_hubs([_device(sensor.source) for sensor in sensors])
    return Together(rates, hubs, _advice(sensors, rates, hubs))


def _device(source: str) -> str:
    """The device file of a camera; the source itself for others."""
    return os.path.realpath(f"/dev/video{source}" if source.isdecimal() else source)


def _count(
    sensor: Sensor, rate: Rate, ready: threading.Semaphore, go: threading.Event, stop: threading.Event
) -> None:
    """Read frames until told to stop, and note how many came a second."""
    times: list[float] = []
    try:
        with ExitStack() as stack:
            try:
                reader = stack.enter_context(closing(open_source(sensor.source, camera=sensor.request)))
                rate.promised, rate.description, rate.live = reader.fps, reader.description, reader.live
                # The first frame takes as long as the camera needs to start; all wait for it.
                reader.read()
            finally:
                ready.release()
            go.wait()
            rate.size = reader.size
            while not stop.is_set() and reader.read() is not None:
                times.append(time.monotonic())
    except SourceError as error:
        rate.problem = str(error)
    rate.got = (len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 else None


def _advice(sensors: Sequence[Sensor], rates: Sequence[Rate], hubs: Sequence[UsbHub]) -> list[str]:
    """What to do about slow sensors: about the hub that they share with others, or about each."""
    names = {_device(sensor.source): sensor.name for sensor in sensors}
    slow = {rate.sensor for rate in rates if rate.share < LOW}
    lines, sharing = [], set[str]()
    for hub in hubs:
        here = [names[camera.device] for camera in hub.cameras]
        if len(here) > 1 and slow.intersection(here):
            sharing.update(here)
            lines.append(
                f"{joined(here)} share the USB hub {hub.root} of {hub.speed} Mbit/s: move one to another "
                "root hub, or request MJPG, fewer pixels or fewer frames"
            )
    for rate in rates:
        if rate.problem:
            lines.append(f"{rate.sensor}: {rate.problem}")
        elif rate.sensor in slow - sharing:
            lines.append(f"{rate.sensor} {_slow(rate)}")
    return lines


def _slow(rate: Rate) -> str:
    wanted = rate.asked or rate.promised
    text = f"delivers {rate.got or 0:.1f} of {wanted:g} frames/s"
    if rate.asked and rate.promised and rate.promised < LOW * rate.asked:
        return f"{text}, because its driver promises {rate.promised:g}: request fewer pixels or MJPG"
    return (
        f"{text}, and it shares no USB hub: use a fixed short exposure with more light, or reduce the load "
        "of the processor"
    )
