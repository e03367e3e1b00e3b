"""Read a source for a while, keeping what the checks need: all times, and some pairs of frames."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing, suppress
from dataclasses import dataclass, field
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from tactflow.engine.errors import SourceError
from tactflow.sources import Arrival, FrameReader, open_source
from tactflow.sources.files import ArrayFile, ImageFiles
from tactflow.tools.doctor.measures import REGULAR, Gray, Pair, exposure, grey
from tactflow.vision.arrays import ColorImage
from tactflow.vision.geometry.valid_area import valid_area
from tactflow.vision.markers import Detection, NoMarkersError, detect_markers

KEPT: Final = 24
"""Pairs of frames to keep, up to twice as many while reading: 70 MB at 800 x 600."""
MIN_DOTS: Final = 20
"""Minimum number of dots of an irregular grid: compression produces 6 and 16 spots on wedge_grasp, a gel
without dots."""


@dataclass
class Observation:
    """Observation of a source over some seconds.

    source : as given by the user. description : of its kind. live : a camera or stream. nominal : frame rate
    that it reports, 1/s, or None. times : s, or None for single pictures. frames : number of frames.
    repeated : frames bit-identical to their predecessor. missing : lost frames, by the numbers in a
    recording. stopped : why it ended early, or "". pairs : kept frames.
    """

    source: str
    description: str
    live: bool
    nominal: float | None = None
    times: list[float] | None = None
    frames: int = 0
    repeated: int = 0
    missing: int = 0
    stopped: str = ""
    pairs: list[Pair] = field(default_factory=list[Pair])

    def check(self) -> None:
        """Raise SourceError if there are no frames."""
        if not self.frames:
            raise SourceError(f"{self.source}: {self.stopped or 'it contains no frames'}")

    @property
    def gaps(self) -> NDArray[np.float64] | str:
        """Intervals between frames, s, or why they are unknown."""
        if self.times is None:
            return "single pictures have no times"
        gaps = np.diff(self.times)
        return gaps if len(gaps) > 1 and gaps.sum() > 0 else f"{len(self.times)} frames are too few"

    @cached_property
    def grays(self) -> list[Gray]:
        """The kept frames in grey, (H, W) float32 of whole levels."""
        return [grey(pair.image) for pair in self.pairs]

    @cached_property
    def exposures(self) -> list[tuple[float, float]]:
        """Level, grey levels, and clipped share of the kept frames (`measures.exposure`)."""
        return [exposure(pair.image) for pair in self.pairs]

    @cached_property
    def typical(self) -> Gray:
        """Median of the kept frames, (H, W) float32, without noise and short contacts."""
        return np.asarray(np.median(np.stack(self.grays), axis=0), np.float32)

    @cached_property
    def dots(self) -> Detection | None:
        """Dots of the first kept frame, or else of the second.

        An irregular grid must recur in the next frame, because compression artefacts do not.
        """
        for pair in self.pairs[:2]:
            found = _dots_of(pair.image)
            if found is None:
                continue
            if found.chosen is not None and found.chosen.lattice.closed_share >= REGULAR:
                return found
            again = None if pair.after is None else _dots_of(pair.after)
            if len(found.centers) >= MIN_DOTS and (pair.after is None or _recur(found, again)):
                return found
        return None


def _dots_of(image: ColorImage) -> Detection | None:
    try:
        return detect_markers(image, valid=valid_area(image))
    except NoMarkersError:
        return None


def _recur(dots: Detection, again: Detection | None) -> bool:
    """Whether at least half of the dots recur within half a pitch."""
    if again is None:
        return False
    distances = cdist(dots.centers, again.centers).min(axis=1)
    return bool(np.median(distances) < dots.pitch / 2)


def observe(source: str, seconds: float, report: Callable[[int], None] = lambda _: None) -> Observation:
    """Observe a source for some seconds of its own time, or to its end. Ctrl-C ends the observation.

    source : as `open_source` takes it. report : called with the number of frames so far.

    Raises
    ------
    SourceError
        The source cannot be opened or delivers no frames.

    >>> observation = observe("sim:idle?frames=5", 10.0)
    >>> observation.frames, observation.nominal, len(observation.pairs)
    (5, 60.0, 5)
    """
    with closing(open_source(source)) as reader:
        observation = Observation(source, reader.description, reader.live)
        with suppress(KeyboardInterrupt):
            watch(reader, seconds, observation, lambda _: report(observation.frames))
    observation.check()
    return observation


def watch(
    reader: FrameReader, seconds: float, observation: Observation, show: Callable[[Arrival], object]
) -> None:
    """Add the frames of an open source to an observation, for some seconds of its own time, or to its end.

    show : called with each frame; the observation ends when it returns False.
    """
    try:
        _read(reader, seconds, observation, show)
    except SourceError as error:
        observation.stopped = str(error)


def _read(
    reader: FrameReader, seconds: float, observation: Observation, show: Callable[[Arrival], object]
) -> None:
    times: list[float] = []
    # The reader invents the rate of separate pictures.
    if not isinstance(reader, ImageFiles | ArrayFile):
        observation.nominal, observation.times = reader.fps, times
    last: ColorImage | None = None
    last_seq: int | None = None
    stride = 1
    while (frame := _next(reader)) is not None:
        image, t, seq = frame.image, frame.t, frame.seq
        if times and t - times[0] > seconds:
            return
        if last_seq is not None:
            observation.missing += max(seq - last_seq - 1, 0)
        if last is not None:
            observation.repeated += bool(np.array_equal(last, image))
            if observation.pairs and observation.pairs[-1].number == observation.frames - 1:
                observation.pairs[-1] = observation.pairs[-1]._replace(after=image)
        if observation.frames % stride == 0:
            observation.pairs.append(Pair(observation.frames, image, None))
            if len(observation.pairs) > 2 * KEPT:
                stride *= 2
                observation.pairs[:] = [pair for pair in observation.pairs if pair.number % stride == 0]
        times.append(t)
        last, last_seq = image, seq
        observation.frames += 1
        if show(frame) is False:
            return
    if reader.live and times:
        observation.stopped = f"it ended after {times[-1] - times[0]:.1f} s"


def _next(reader: FrameReader) -> Arrival | None:
    """The next frame, without those that are shown ahead of their time."""
    while (arrival := reader.read_arrival()) is not None:
        if arrival.paced:
            return arrival
    return None
