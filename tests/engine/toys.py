"""A small graph of counting stages for the engine's tests. Copied beside each test's pipeline file."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tactflow.engine import contract
from tactflow.engine.contract import Sink, Stage, StageParams
from tactflow.engine.frame import Absent, Frame, Tick
from tactflow.engine.ports import ArrayPort, SignalPort
from tactflow.stages.hold import Hold as Hold

Grid = Annotated[NDArray[np.uint8], ArrayPort("grid", ("H", "W"), "uint8", "1")]
Active = Annotated[bool, SignalPort("active", closed="idle")]
Repeating = Annotated[bool, SignalPort("repeating", closed="idle", otherwise="repeat")]


@dataclass(frozen=True)
class Number:
    value: float


class Ramp(contract.Source):
    """A source whose frame i shows the number i everywhere."""

    class Params(StageParams):
        source: str = "ramp"
        realtime: bool = False
        frames: int = 20
        refuse: bool = False
        pause: float = 0.0
        retake_at: int = -1
        preroll: bool = False
        overtaken: int = 0
        says_when: bool = True

    def __init__(self, params: Params, sensor: str) -> None:
        self.params, self.sensor = params, sensor
        self.live = params.realtime
        self.stopped = threading.Event()
        self.closed = self.retakes = 0

    @property
    def missed(self) -> int:
        return self.params.overtaken

    def open(self) -> None:
        if self.params.refuse:
            raise OSError("no such device")

    def frames(self) -> Iterator[Frame]:
        epoch = 0
        if self.params.preroll:
            yield self.frame(-1, 0)
        for seq in range(self.params.frames):
            if self.stopped.wait(self.params.pause):
                return
            epoch += seq == self.params.retake_at
            yield self.frame(seq, epoch)

    def frame(self, seq: int, epoch: int) -> Frame:
        image = np.full((4, 6, 3), max(seq, 0) % 256, np.uint8)
        image.flags.writeable = False
        captured = time.perf_counter() if self.params.says_when else 0.0
        return Frame(self.sensor, seq, seq / 50, image, captured, seq <= 0, epoch)

    def stop(self) -> None:
        self.stopped.set()

    def retake(self) -> None:
        self.retakes += 1

    def close(self) -> None:
        self.closed += 1


class Counted:
    """Counts calls and life-cycle events."""

    memory = "pure"

    class Params(StageParams):
        fail_at: int = -99
        fail_from: int = 10**9
        seconds: float = 0.0

    def __init__(self, params: Params) -> None:
        self.params = params
        self.seen: list[int] = []
        self.rows: list[Any] = []
        self.captured: list[float] = []
        self.opened = self.closed = self.resets = 0
        self.called, self.release = threading.Event(), threading.Event()

    def open(self) -> None:
        self.opened += 1

    def close(self) -> None:
        self.closed += 1

    def saw(self, seq: int) -> None:
        self.called.set()
        if self.params.seconds:
            self.release.wait(self.params.seconds)
        if seq == self.params.fail_at or seq >= self.params.fail_from:
            raise ArithmeticError(f"cannot count {seq}")
        self.seen.append(seq)


class LevelPorts(NamedTuple):
    level: Number
    grid: Grid


class HeavyPorts(NamedTuple):
    heavy: Number


class GatedPorts(NamedTuple):
    gated: Number


class TotalPorts(NamedTuple):
    total: Number


class DoubtfulPorts(NamedTuple):
    doubtful: Number


class JoinPorts(NamedTuple):
    joined: Number


class Level(Counted, Stage):
    def process(self, frame: Frame) -> LevelPorts:
        self.saw(frame.seq)
        return LevelPorts(Number(float(frame.seq)), frame.image[:, :, 0].copy())


class ActivePorts(NamedTuple):
    """The same signal for gates of both kinds."""

    active: Active
    repeating: Repeating


def both(signal: bool) -> ActivePorts:
    return ActivePorts(signal, signal)


class Pulse(Counted, Stage):
    """True in frames 3 to 6 of every ten."""

    def process(self, frame: Frame) -> ActivePorts:
        self.saw(frame.seq)
        return both(3 <= frame.seq % 10 <= 6)


class Even(Counted, Stage):
    """True in every second frame."""

    def process(self, frame: Frame) -> ActivePorts:
        self.saw(frame.seq)
        return both(frame.seq % 2 == 0)


class Heavy(Counted, Stage):
    def process(self, level: Number) -> HeavyPorts:
        self.saw(int(level.value))
        return HeavyPorts(Number(level.value**2))


class Gated(Counted, Stage):
    def process(self, heavy: Number) -> GatedPorts:
        self.saw(int(heavy.value**0.5))
        return GatedPorts(Number(heavy.value + 0.5))


class Watcher(Counted, Stage):
    """Notes what the signal of the stages below was in the frame before."""

    memory = "stateful"
    watches = "active"

    def process(self, frame: Frame) -> LevelPorts:
        self.saw(frame.seq)
        self.rows.append(self.watched)
        return LevelPorts(Number(float(frame.seq)), frame.image[:, :, 0].copy())


class Total(Counted, Stage):
    memory = "stateful"
    value = 0.0

    def process(self, level: Number) -> TotalPorts:
        self.saw(int(level.value))
        self.value += level.value
        return TotalPorts(Number(self.value))

    def reset(self) -> None:
        self.value = 0.0
        self.resets += 1


class Doubtful(Counted, Stage):
    """Asks for a new reference in frame 7."""

    def process(self, level: Number) -> DoubtfulPorts:
        self.saw(int(level.value))
        if level.value == 7:
            self.wants_reference = "light_changed"
        return DoubtfulPorts(level)


class Join(Counted, Stage):
    def process(self, level: Number, total: Number, gated: Number | None) -> JoinPorts:
        self.saw(int(level.value))
        return JoinPorts(Number(level.value + 1000 * total.value + (gated.value if gated else -7.0)))


class Rare(Counted, Stage):
    """Gives nothing in every third frame."""

    def process(self, level: Number) -> Number | Absent:
        self.saw(int(level.value))
        return Absent("third") if level.value % 3 == 0 else level


class Vandal(Counted, Stage):
    """Writes into its input, which a stage must not do."""

    def process(self, grid: Grid) -> Number:
        grid[0, 0] = 99
        return Number(0.0)


class BadShape(Counted, Stage):
    def process(
        self, grid: Grid
    ) -> Annotated[NDArray[np.uint8], ArrayPort("half", ("H", "W"), "uint8", "1")]:
        return grid[:2].copy()


class Collect(Counted, Sink):
    """A sink that keeps what it gets."""

    wanted = True

    def write(self, tick: Tick, joined: Number | None, total: Number | None, gated: Number | None) -> None:
        self.saw(tick.frame.seq)
        values = (None if n is None else n.value for n in (joined, total, gated))
        self.rows.append((tick.frame.seq, *values, dict(tick.skipped)))
        self.captured.append(tick.frame.captured)

    def wants(self) -> bool:
        return self.wanted


class Frames(Counted, Sink):
    """Keeps number, reference and epoch of each frame, and what was skipped."""

    def write(self, tick: Tick, doubtful: Number) -> None:  # noqa: ARG002 (the port must be asked for)
        frame = tick.frame
        self.rows.append((frame.seq, frame.reference, frame.epoch, dict(tick.skipped)))


class References(Counted, Sink):
    """Wants nothing but references."""

    takes_references = True

    def wants(self) -> bool:
        return False

    def write(self, tick: Tick, level: Number) -> None:  # noqa: ARG002 (the port must be asked for)
        self.rows.append(tick.frame.seq)


class ThreadedCollect(Collect):
    threaded = True
    when_live = "latest"


class OnlyLevel(Counted, Sink):
    """A sink that asks for little."""

    def write(self, tick: Tick, level: Number) -> None:  # noqa: ARG002 (the port must be asked for)
        self.saw(tick.frame.seq)
