"""Read a source, keeping what the checks need: the course of all frames, and some pairs of them."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import closing, suppress
from dataclasses import dataclass, field
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from tactflow.engine.errors import SourceError
from tactflow.recording.course import Watcher
from tactflow.recording.verdict import Recorded
from tactflow.sources import Arrival, FrameReader, open_source
from tactflow.sources.files import ArrayFile, ImageFiles
from tactflow.tools.doctor.measures import MIN_CLOSED_SHARE, Gray, Pair, exposure, grey
from tactflow.vision.arrays import ColorImage
from tactflow.vision.change import DamageTest, shows_gel
from tactflow.vision.geometry.valid_area import valid_area
from tactflow.vision.markers import Detection, NoMarkersError, detect_markers

LIVE_SECONDS: Final = 10.0
"""How long a live source is observed by default, s: time for some presses."""
MIDDLE_GREY_MARGIN: Final = 30
"""Distance of a level from black and from white, grey levels; compression alone does not reach it."""
MIN_MIDDLE_GREY_SHARE: Final = 0.01
"""Minimum share of such levels in a picture that has not been thresholded: the shade of a single press."""
KEPT_PAIRS: Final = 24
"""Pairs of frames to keep, up to twice as many while reading: 70 MB at 800 x 600."""
MIN_DOTS: Final = 20
"""Minimum number of dots of an irregular grid: compression produces 6 and 16 spots on wedge_grasp, a gel
without dots."""


@dataclass
class Observation:
    """Observation of a source over some seconds, or of a whole recording.

    Attributes
    ----------
    source : as given by the user.
    description : of its kind.
    live : a camera or stream.
    nominal : frame rate that it reports, 1/s, or None.
    begins : Unix time of t = 0, s, or None.
    recorded : how its frames came.
    pairs : kept frames.
    """

    source: str
    description: str
    live: bool
    nominal: float | None = None
    begins: float | None = None
    recorded: Recorded = field(init=False)
    pairs: list[Pair] = field(default_factory=list[Pair])

    def __post_init__(self) -> None:
        self.recorded = Recorded(live=self.live)

    def check(self) -> None:
        """Raise SourceError if there are no frames."""
        if not self.frames:
            raise SourceError(f"{self.source}: {self.stopped or 'it contains no frames'}")

    @property
    def frames(self) -> int:
        """Number of frames."""
        return self.recorded.course.frames

    @property
    def stopped(self) -> str:
        """Why it ended early, or ""."""
        return self.recorded.stopped

    @property
    def gaps(self) -> NDArray[np.float64] | str:
        """Intervals between frames, s, or why they are unknown."""
        if not self.recorded.timed:
            return "single pictures have no times"
        gaps = np.diff(self.recorded.course.times)
        return gaps if len(gaps) > 1 and gaps.sum() > 0 else f"{self.frames} frames are too few"

    @cached_property
    def grays(self) -> list[Gray]:
        """The kept frames in grey, (H, W) float32 of whole levels."""
        return [grey(pair.image) for pair in self.pairs]

    @cached_property
    def levels(self) -> list[float]:
        """Brightness of the kept frames, grey levels (`measures.exposure`)."""
        return [exposure(pair.image) for pair in self.pairs]

    @cached_property
    def black_and_white(self) -> bool:
        """Whether the pictures have been thresholded: they have no levels between."""
        between = [
            np.mean((gray > MIDDLE_GREY_MARGIN) & (gray < 255 - MIDDLE_GREY_MARGIN)) for gray in self.grays
        ]
        return bool(np.mean(between) < MIN_MIDDLE_GREY_SHARE)

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
            if found.chosen is not None and found.chosen.lattice.closed_share >= MIN_CLOSED_SHARE:
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


def observe(
    source: str, seconds: float | None = None, report: Callable[[int], None] = lambda _: None
) -> Observation:
    """Observe a source. Ctrl-C ends the observation.

    source : as `open_source` takes it. seconds : of its own time; None: `LIVE_SECONDS` of a live source, the
    whole of a recording. report : called with the number of frames so far.

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
        usual = LIVE_SECONDS if reader.live else math.inf
        with suppress(KeyboardInterrupt):
            watch(
                reader,
                usual if seconds is None else seconds,
                observation,
                lambda _: report(observation.frames),
            )
    observation.check()
    return observation


def watch(
    reader: FrameReader, seconds: float, observation: Observation, show: Callable[[Arrival], object]
) -> None:
    """Add the frames of an open source to an observation, for some seconds of its own time, or to its end.

    show : called with each frame; the observation ends when it returns False.
    """
    recorded = observation.recorded
    observation.nominal, observation.begins = reader.fps, reader.begins
    # The reader invents the rate of separate pictures.
    if isinstance(reader, ImageFiles | ArrayFile):
        observation.nominal, recorded.timed = None, False
    try:
        _read(reader, seconds, observation, show)
    except SourceError as error:
        recorded.stopped = str(error)
    recorded.remark, recorded.lacking = reader.remark, reader.lacking


def _read(
    reader: FrameReader, seconds: float, observation: Observation, show: Callable[[Arrival], object]
) -> None:
    course, glances = observation.recorded.course, Watcher()
    begin: float | None = None
    test: DamageTest | None = None
    stride = 1
    while (frame := _next(reader)) is not None:
        begin = frame.t if begin is None else begin
        if frame.t - begin > seconds:
            return
        pairs = observation.pairs
        if pairs and pairs[-1].number == course.frames - 1:
            pairs[-1] = pairs[-1]._replace(after=frame.image)
        if course.frames % stride == 0:
            pairs.append(Pair(course.frames, frame.image, None))
            if len(pairs) > 2 * KEPT_PAIRS:
                stride *= 2
                pairs[:] = [pair for pair in pairs if pair.number % stride == 0]
        suspect = test is None or test.is_damaged(frame.image)
        empty = suspect and not shows_gel(frame.image)
        damaged = suspect and not empty and test is not None
        if test is None and not empty:
            test = DamageTest(frame.image)
        of_frame = {"reference": frame.reference, "empty": empty, "damaged": damaged}
        course.add(glances.look(frame.image, frame.t, frame.seq, **of_frame))
        if show(frame) is False:
            return
    if reader.live and begin is not None:
        observation.recorded.stopped = f"it ended after {course.seconds:.1f} s"


def _next(reader: FrameReader) -> Arrival | None:
    """The next frame, without those that are shown ahead of their time."""
    while (arrival := reader.read_arrival()) is not None:
        if arrival.paced:
            return arrival
    return None
