"""Read a source for a while, and keep what the checks need: all times, and some pairs of frames."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tactflow.doctor.measures import REGULAR, Exposure, Gray, Image, Pair, exposure, grey, jpeg_step
from tactflow.engine.errors import SourceError
from tactflow.sources import StampedReader, open_source
from tactflow.sources.base import FrameReader
from tactflow.sources.devices import Camera
from tactflow.sources.files import ArrayFile, ImageFiles
from tactflow.vision.geometry.valid_area import valid_area
from tactflow.vision.markers import Detection, NoMarkersError, detect_markers

KEPT: Final = 24
"""Pairs of frames that are kept, up to twice as many while reading: 70 MB at 800 x 600."""
LEAST_DOTS: Final = 20
"""Spots below which an irregular grid is no grid: on wedge_grasp, a gel without dots, compression makes 6 and
16 of them."""


@dataclass
class Observation:
    """What was seen of a source.

    source, description : how it was named, and what it is. live : a camera or a stream. promised : frames per
    second that it says it has, or None. times : (N,) s, or None where a source of single pictures has none.
    frames : how many came. repeated : of these the same as the one before, bit for bit. missing : frames that
    a recording knows it has lost. stopped : why it ended too early, else "". delays : s, from the driver's
    stamp to here, for each frame with a stamp. pairs : kept frames.
    """

    source: str
    description: str
    live: bool
    promised: float | None = None
    times: NDArray[np.float64] | None = None
    frames: int = 0
    repeated: int = 0
    missing: int = 0
    stopped: str = ""
    delays: list[float] = field(default_factory=list[float])
    pairs: list[Pair] = field(default_factory=list[Pair])

    @property
    def gaps(self) -> NDArray[np.float64] | str:
        """Times between frames, s; or why they are unknown."""
        if self.times is None:
            return "single pictures have no times"
        gaps = np.diff(self.times)
        return gaps if len(gaps) > 1 and gaps.sum() > 0 else f"{len(self.times)} frames are too few"

    @cached_property
    def grays(self) -> list[Gray]:
        """The kept frames in grey, (H, W) float32 of whole levels."""
        return [grey(pair.image) for pair in self.pairs]

    @cached_property
    def exposures(self) -> list[Exposure]:
        """How the kept frames are exposed."""
        return [exposure(pair.image) for pair in self.pairs]

    @cached_property
    def jpeg_step(self) -> float | None:
        """Step of JPEG's coarsest quantisation, grey levels, where half of the frames or more show one."""
        frames = self.grays[::4]
        steps = [step for gray in frames if (step := jpeg_step(gray)) is not None]
        return float(np.median(steps)) if steps and 2 * len(steps) >= len(frames) else None

    @cached_property
    def typical(self) -> Gray:
        """The median of the kept frames, (H, W) float32: without noise, and without short contacts."""
        return np.asarray(np.median(np.stack(self.grays), axis=0), np.float32)

    @cached_property
    def dots(self) -> Detection | None:
        """The dots of the first frame, or of the second that is kept.

        An irregular grid must show again in the next frame: what compression makes differs in each.
        """
        for pair in self.pairs[:2]:
            found = _dots_of(pair.image)
            if found is None:
                continue
            if found.chosen is not None and found.chosen.lattice >= REGULAR:
                return found
            again = None if pair.after is None else _dots_of(pair.after)
            if len(found.centers) >= LEAST_DOTS and (pair.after is None or _show_again(found, again)):
                return found
        return None


def _dots_of(image: Image) -> Detection | None:
    try:
        return detect_markers(image, valid=valid_area(image))
    except NoMarkersError:
        return None


def _show_again(dots: Detection, again: Detection | None) -> bool:
    """Whether at least half of the dots are in the same places, to half a pitch."""
    if again is None:
        return False
    away = np.hypot(*(dots.centers[:, None] - again.centers).transpose(2, 0, 1)).min(axis=1)
    return bool(np.mean(away < dots.pitch / 2) >= 0.5)


def observe(source: str, seconds: float, report: Callable[[int], None] = lambda _: None) -> Observation:
    """Look at a source for so many seconds of its own time, or to its end. Ctrl-C ends the look early.

    source : as `open_source` takes it. report : called with the number of frames so far.

    Raises
    ------
    SourceError
        If it cannot be opened, or delivers no frame.

    >>> seen = observe("sim:idle?frames=5", 10.0)
    >>> seen.frames, seen.promised, len(seen.pairs)
    (5, 60.0, 5)
    """
    reader = open_source(source)
    seen = Observation(source, reader.description, reader.live, reader.fps)
    times: list[float] = []
    try:
        _read(reader, seconds, seen, times, report)
    except SourceError as error:
        seen.stopped = str(error)
    except KeyboardInterrupt:
        seen.stopped = ""
    finally:
        reader.close()
    if not seen.frames:
        raise SourceError(f"{source}: {seen.stopped or 'there is no frame in it'}")
    if isinstance(reader, ImageFiles | ArrayFile):
        # Its rate is made up.
        seen.promised = None
    else:
        seen.times = np.array(times)
    return seen


def _read(
    reader: FrameReader, seconds: float, seen: Observation, times: list[float], report: Callable[[int], None]
) -> None:
    last: Image | None = None
    last_seq: int | None = None
    stride = 1
    while (frame := _next(reader)) is not None:
        image, t, seq = frame
        if times and t - times[0] > seconds:
            return
        if seq is not None and last_seq is not None:
            seen.missing += max(seq - last_seq - 1, 0)
        if last is not None:
            seen.repeated += bool(np.array_equal(last, image))
            if seen.pairs and seen.pairs[-1].number == seen.frames - 1:
                seen.pairs[-1] = seen.pairs[-1]._replace(after=image)
        if seen.frames % stride == 0:
            seen.pairs.append(Pair(seen.frames, image, None))
            if len(seen.pairs) > 2 * KEPT:
                stride *= 2
                seen.pairs[:] = [pair for pair in seen.pairs if pair.number % stride == 0]
        if isinstance(reader, Camera) and (delay := reader.delay()) is not None:
            seen.delays.append(delay)
        times.append(t)
        last, last_seq = image, seq
        seen.frames += 1
        report(seen.frames)
    if reader.live and times:
        seen.stopped = f"it ended after {times[-1] - times[0]:.1f} s"


def _next(reader: FrameReader) -> tuple[Image, float, int | None] | None:
    """The next frame, its time, and its number where the recording remembers one."""
    if not isinstance(reader, StampedReader):
        frame = reader.read()
        return None if frame is None else (*frame, None)
    while (stamped := reader.read_stamped()) is not None:
        image, t, stamp = stamped
        if stamp.paced:
            return image, t, stamp.seq
    return None
