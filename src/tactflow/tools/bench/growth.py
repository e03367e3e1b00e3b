"""How the cost of a frame grows with the picture, dots, contacts, sensors and the length of a run."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.engine.errors import TactflowError
from tactflow.engine.graph import Pipeline
from tactflow.sim import open_scene
from tactflow.tools.bench.lockstep import LockstepPipeline, TimedResult, on_recording
from tactflow.tools.bench.timing import quiet

PICTURE_SIZES_PX: Final = ((160, 120), (320, 240), (640, 480), (800, 600), (1280, 960), (1600, 1200))
"""Width and height of raw pictures, px."""
DOT_GRIDS: Final = ("3x3", "6x5", "10x8", "20x15", "40x30", "52x39")
"""Columns and rows of dots."""
CONTACT_COUNTS: Final = (0, 1, 2, 4, 6, 8)
SENSOR_COUNTS: Final = (1, 2, 4, 8, 16, 32)
RUN_LENGTHS_FRAMES: Final = (100, 300, 1000, 3000)
"""Frames of a run."""
RUN_FRAMES: Final = 24
"""Frames of each run but the last: a reference, a few at rest, and a contact that lasts."""
IMPRINT_SIDE_PX: Final = 150
"""Side of the imprint that is copied to make several contacts, raw px."""

Pictures = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Growth:
    """The cost of a frame against one size.

    Attributes
    ----------
    x : its values.
    ms : median CPU time of each, ms, and the quartiles around it.
    left_out : x -> why there is no time.
    """

    title: str
    unit: str
    x: Sequence[float]
    ms: Sequence[float]
    low: Sequence[float]
    high: Sequence[float]
    left_out: Mapping[str, str]

    @property
    def exponent(self) -> float | None:
        """Slope of the time against the size, both in logarithms, by least squares; None for fewer than three
        points. Small sizes cost little but what every frame costs, so the slope is that of the upper half."""
        known = [(x, ms) for x, ms in zip(self.x, self.ms, strict=True) if x > 0 and ms > 0]
        half = known[len(known) // 2 - 1 :] if len(known) >= 4 else known
        if len(half) < 3:
            return None
        x, ms = np.log(np.array(half)).T
        return float(np.polyfit(x, ms, 1)[0])


def measure_growth(default: Pipeline, markerless: Pipeline, *, quick: bool = False) -> Iterator[Growth]:
    """Measure all of them, one after the other. quick : three of the smaller sizes, of the first
    two."""

    def some(values: Sequence[object]) -> Sequence[object]:
        return values[1:4] if quick else values

    make: list[tuple[str, str, Sequence[object], Callable[..., list[float]], Callable[..., float]]] = [
        (
            "Picture",
            "raw px",
            some(PICTURE_SIZES_PX),
            partial(_of_size, default),
            lambda size: size[0] * size[1],
        ),
        ("Dots", "", some(DOT_GRIDS), partial(_of_dots, default), _count),
        ("Contacts at once", "", some(CONTACT_COUNTS), partial(_of_contacts, markerless), float),
        ("Sensors in one process", "", some(SENSOR_COUNTS), partial(_of_sensors, default), float),
        ("Length of the run", "frames", some(RUN_LENGTHS_FRAMES), partial(_of_length, default), float),
    ]
    for title, unit, sizes, measure, number in make[:2] if quick else make:
        x, times, left_out = [], [], {}
        for size in sizes:
            try:
                samples = measure(size)
            except TactflowError as error:
                left_out[str(size)] = str(error).splitlines()[0]
                continue
            x.append(float(number(size)))
            times.append(np.quantile(samples, [0.25, 0.5, 0.75]).tolist())
        low, middle, high = zip(*times, strict=True) if times else ((), (), ())
        yield Growth(title, unit, x, middle, low, high, left_out)


def _count(grid: str) -> float:
    columns, rows = grid.split("x")
    return float(columns) * float(rows)


def _times(pipelines: Sequence[Pipeline], pictures: Pictures, frames: int | None = None) -> list[float]:
    """CPU time, ms, of every frame of pipelines that take turns, from the middle of the recording on."""
    kept: list[float] = []
    with tempfile.TemporaryDirectory(prefix="tactflow-bench-") as folder, ExitStack() as stack:
        path = Path(folder) / "frames.npy"
        np.save(path, pictures)
        stack.enter_context(quiet())
        running = [stack.enter_context(closing(LockstepPipeline(on_recording(p, path)))) for p in pipelines]
        seen = 0
        while results := [result for pipeline in running for result in pipeline.block()]:
            kept += [1e3 * result.cpu_s for result in results if _counts(result, len(pictures))]
            seen += len(results)
            if frames is not None and seen >= frames:
                break
    return kept


def _counts(result: TimedResult, frames: int) -> bool:
    return result.seq >= frames // 2


def _press(query: str = "", frames: int = RUN_FRAMES) -> Pictures:
    """A press that begins and stays: half of the frames show its deepest moment, with new noise each."""
    scene = open_scene(f"press?frames=120{query and '&' + query}")
    indices = [*range(6), *np.linspace(27, 44, frames - 6).round().astype(int)]
    return np.stack([scene.frame(int(index)) for index in indices])


def _of_size(pipeline: Pipeline, size: tuple[int, int]) -> list[float]:
    resized = [cv2.resize(picture, size, interpolation=cv2.INTER_AREA) for picture in _press()]
    return _times([pipeline], np.stack(resized).astype(np.uint8))


def _of_dots(pipeline: Pipeline, grid: str) -> list[float]:
    return _times([pipeline], _press(f"markers={grid}"))


def _of_contacts(pipeline: Pipeline, count: int) -> list[float]:
    """Imprints of one ball, copied to places of a gel without dots; each with its own noise."""
    scene = open_scene("press?markers=none&noise=0&frames=120")
    rest, pressed = scene.frame(0).astype(np.int16), scene.frame(35).astype(np.int16)
    change = pressed - rest
    y, x = np.unravel_index(np.abs(change).sum(axis=2).argmax(), change.shape[:2])
    half = IMPRINT_SIDE_PX // 2
    y, x = (int(np.clip(at, half, side - half)) for at, side in ((y, rest.shape[0]), (x, rest.shape[1])))
    imprint = change[y - half : y + half, x - half : x + half]
    shown = rest.copy()
    places = [(row, column) for row in (100, 300, 500) for column in (130, 400, 670)]
    for row, column in places[:count]:
        shown[row - half : row + half, column - half : column + half] += imprint
    rng = np.random.default_rng(0)
    levels = [rest] * 6 + [shown] * (RUN_FRAMES - 6)
    noisy = [level + rng.normal(0, 2, level.shape) for level in levels]
    return _times([pipeline], np.clip(np.rint(noisy), 0, 255).astype(np.uint8))


def _of_sensors(pipeline: Pipeline, count: int) -> list[float]:
    return _times([pipeline] * count, _press())


def _of_length(pipeline: Pipeline, count: int) -> list[float]:
    """A cycle of presses, played again and again; the last quarter counts."""
    cycle = _press(frames=40)
    order = np.resize(np.r_[np.arange(40), np.arange(39, -1, -1)], count)
    return _times([pipeline], cycle[order])
