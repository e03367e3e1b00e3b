"""The course of a recording: what each frame tells about how it was recorded, and their sum, in one pass."""

from __future__ import annotations

from array import array
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

MIN_SAMPLED_SHAPE: Final = (48, 64)
"""Rows and columns of a picture that are sampled, at least, if it has as many."""
BLACK_GREY: Final = 4
"""Highest grey level of the black surround of the gel."""
CLIPPED_GREY: Final = 254
"""Lowest grey level that counts as clipped: compression takes one from 255."""
LARGEST_DOT_SAMPLES: Final = 20
"""Area of the largest clipped spot that is not counted, samples: of a disc a 13th of the picture's width
across. White dots and pins are clipped without harm, as only their positions are used."""
LOCAL_INTERVALS: Final = 31
"""Intervals around each one whose median is the local interval, so that a camera that changes its rate in the
dark loses no frames by that."""
IRREGULAR_DEVIATION_INTERVALS: Final = 0.5
"""Deviation from which an interval is irregular, local intervals: a frame that is further off belongs to
another one of evenly spaced moments."""
NEIGHBOUR_FRAMES: Final = 4
"""Frames on each side of a wide interval that tell whether one is missing in it, or was only late."""
CONTACT_SECONDS: Final = 0.2
"""Duration of a short tap, s: a pause of this length may hide a contact."""
CODEC_REPEAT_SHARE: Final = 0.1
"""Share of identical successive frames in a good recording: compression produces them in still scenes
(measured)."""
FALSE_FREEZE_PROBABILITY: Final = 1e-3
"""Probability that a run of identical frames which counts as frozen occurs by chance in a recording."""


class Glance(NamedTuple):
    """What a frame tells about the recording.

    Attributes
    ----------
    t : s.
    seq : its number at the source.
    change : mean absolute difference to the frame before, grey levels.
    repeated : whether it is bit-identical to that.
    clipped : share of the gel that is clipped, 0 to 1.
    reference : whether it is a reference.
    empty : whether it shows no gel.
    damaged : whether it is no longer as the camera took it.
    """

    t: float
    seq: int
    change: float
    repeated: bool
    clipped: float
    reference: bool = False
    empty: bool = False
    damaged: bool = False


class Watcher:
    """Takes a glance at each frame; it keeps the frame before, and some 60 x 50 samples of it.

    >>> watcher = Watcher()
    >>> image = np.full((48, 64, 3), 100, np.uint8)
    >>> watcher.look(image, 0.0, 0).repeated, watcher.look(image.copy(), 0.1, 1).repeated
    (False, True)
    """

    def __init__(self) -> None:
        self._last: NDArray[np.uint8] | None = None
        self._last_samples: NDArray[np.int16] | None = None

    def look(
        self,
        image: NDArray[np.uint8],
        t: float,
        seq: int,
        *,
        reference: bool = False,
        empty: bool = False,
        damaged: bool = False,
    ) -> Glance:
        """The next frame. image : (H, W, 3) uint8, not modified later. The others are as in `Glance`."""
        down, across = (
            max(1, side // most) for side, most in zip(image.shape, MIN_SAMPLED_SHAPE, strict=False)
        )
        picture = image[::down, ::across]
        samples = picture.astype(np.int16)
        change, repeated = 0.0, False
        if self._last_samples is not None and self._last is not None:
            difference = np.subtract(samples, self._last_samples)
            change = float(np.abs(difference, out=difference).mean())
            repeated = change == 0 and np.array_equal(image, self._last)
        self._last, self._last_samples = image, samples
        return Glance(t, seq, change, repeated, clipped_share(picture), reference, empty, damaged)


def clipped_share(picture: NDArray[np.uint8]) -> float:
    """Share of the gel with a saturated channel, 0 to 1, without spots of the size of dots.

    picture : (H, W, 3) uint8, about `MIN_SAMPLED_SHAPE`.

    >>> white_pin = np.full((48, 64, 3), 20, np.uint8)
    >>> white_pin[20:24, 30:34] = 255
    >>> clipped_share(white_pin), clipped_share(np.full((48, 64, 3), 255, np.uint8))
    (0.0, 1.0)
    """
    brightest = np.maximum(np.maximum(picture[..., 0], picture[..., 1]), picture[..., 2])
    clipped = (brightest >= CLIPPED_GREY).astype(np.uint8)
    if not clipped.any():
        return 0.0
    areas = cv2.connectedComponentsWithStats(clipped, connectivity=4)[2][1:, cv2.CC_STAT_AREA]
    large = areas[areas > LARGEST_DOT_SAMPLES]
    return float(large.sum() / np.count_nonzero(brightest > BLACK_GREY))


class Pause(NamedTuple):
    """A time without a new frame.

    Attributes
    ----------
    start : from the first frame, s.
    seconds : its length.
    """

    start: float
    seconds: float


class Timing(NamedTuple):
    """How evenly the frames come.

    Attributes
    ----------
    interval : median time between two frames, s.
    lost : frames that are missing by the times.
    pauses : of `CONTACT_SECONDS` and more.
    irregular : share of the frames that are late or early, though none is missing before them.
    slowest, fastest : local intervals, s.
    backwards : number of times that the clock went back.
    """

    interval: float
    lost: int
    pauses: list[Pause]
    irregular: float
    slowest: float
    fastest: float
    backwards: int


class Run(NamedTuple):
    """Successive identical frames.

    Attributes
    ----------
    first : index of the one that they repeat.
    repeats : their number.
    """

    first: int
    repeats: int


class Course:
    """The course of a recording, with 12 bytes of memory for each frame.

    Attributes
    ----------
    frames : their number.
    missing : frames that are missing by their numbers.
    repeated : frames that are identical to the one before.
    empty, damaged : indices of the first frames without a gel or damaged, and their numbers.
    clipped : mean share of the gel that is clipped, 0 to 1.

    Examples
    --------
    >>> course = Course()
    >>> for seq in (0, 1, 2, 5, 6):
    ...     course.add(Glance(seq / 10, seq, 1.0, False, 0.0))
    >>> course.frames, course.missing, course.timing().lost
    (5, 2, 2)
    """

    def __init__(self) -> None:
        self._reset()

    def _reset(self) -> None:
        self.frames = self.missing = self.repeated = 0
        self.empty = Tally()
        self.damaged = Tally()
        self._times = array("d")
        self._changes = array("f")
        self._clipped = 0.0
        self._only_references = True
        self._last_seq: int | None = None
        self._run = self._longest = Run(0, 0)

    def add(self, glance: Glance) -> None:
        """The next frame."""
        # The frames between a camera's first references and its next frame were only examined.
        if self._only_references and self._last_seq is not None and glance.seq > self._last_seq + 1:
            self._reset()
        self._only_references = self._only_references and glance.reference
        if self._last_seq is not None:
            self.missing += max(glance.seq - self._last_seq - 1, 0)
        self._last_seq = glance.seq
        self._run = Run(self._run.first, self._run.repeats + 1) if glance.repeated else Run(self.frames, 0)
        self._longest = max(self._longest, self._run, key=lambda run: run.repeats)
        self.repeated += glance.repeated
        self.empty.add(self.frames, glance.empty)
        self.damaged.add(self.frames, glance.damaged)
        self._clipped += glance.clipped
        self._times.append(glance.t)
        self._changes.append(glance.change)
        self.frames += 1

    @property
    def clipped(self) -> float:
        """Mean share of the gel that is clipped, 0 to 1."""
        return self._clipped / max(self.frames, 1)

    @property
    def times(self) -> NDArray[np.float64]:
        """(N,) s."""
        return np.array(self._times)

    @property
    def changes(self) -> NDArray[np.float64]:
        """(N,) mean absolute difference of each frame to the one before, grey levels."""
        return np.array(self._changes, np.float64)

    @property
    def seconds(self) -> float:
        """Time from the first frame to the last, s."""
        return self._times[-1] - self._times[0] if self.frames else 0.0

    def timing(self) -> Timing | None:
        """How evenly the frames come; None if there are too few, or all have the same time."""
        return timing_of(self.times)

    @property
    def frozen(self) -> Run | None:
        """The longest run of identical frames, if it is not by chance or by compression.

        If a frame repeats the one before by chance with probability p, which the other frames tell, n frames
        contain a run of k repeats with a probability of n p^k at most. If frames repeat often, compression
        removes what differs between frames of a still scene, and a run tells nothing unless it is half of the
        recording.
        """
        longest, others = self._longest, self.frames - self._longest.repeats
        chance = (self.repeated - longest.repeats + 1) / (others + 1)
        if longest.repeats < 2:
            return None
        if longest.repeats > self.frames / 2:
            return longest
        if chance > CODEC_REPEAT_SHARE or self.frames * chance**longest.repeats > FALSE_FREEZE_PROBABILITY:
            return None
        return longest


class Tally:
    """Counts frames.

    Attributes
    ----------
    count : their number.
    first : index of the first one.
    """

    def __init__(self) -> None:
        self.count = 0
        self.first = -1

    def add(self, index: int, counts: bool) -> None:
        """The next frame."""
        if counts:
            self.first = index if self.count == 0 else self.first
            self.count += 1


def timing_of(times: NDArray[np.float64]) -> Timing | None:
    """How evenly frames come. times : (N,) s. None if there are too few, or all have the same time.

    >>> times = np.delete(np.arange(100) / 25, [40, 41, 42, 43, 44])
    >>> timing = timing_of(times)
    >>> timing.lost, round(timing.pauses[0].start, 2), round(timing.pauses[0].seconds, 2)
    (5, 1.56, 0.24)
    """
    gaps = np.diff(times)
    if len(gaps) < 2 or not (forwards := gaps[gaps > 0]).size:
        return None
    local = _local_intervals(np.where(gaps > 0, gaps, np.median(forwards)))
    ratio = gaps / local
    wide = np.flatnonzero(ratio - 1 > IRREGULAR_DEVIATION_INTERVALS)
    missing = _missing(times, local, wide)
    lost = int(missing.sum())
    # A late frame has a wide interval before it and a narrow one behind it.
    narrow = np.count_nonzero(1 - ratio > IRREGULAR_DEVIATION_INTERVALS)
    irregular = max(np.count_nonzero(missing == 0), narrow) / len(gaps)
    long = np.flatnonzero((gaps >= CONTACT_SECONDS) & (np.rint(ratio) > 1))
    return Timing(
        float(np.median(forwards)),
        lost,
        [Pause(float(times[index] - times[0]), float(gaps[index])) for index in long],
        irregular,
        float(local.max()),
        float(local.min()),
        int((gaps < 0).sum()),
    )


def _missing(
    times: NDArray[np.float64], local: NDArray[np.float64], wide: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Number of frames that are missing in each wide interval.

    A frame may also be late, and those behind it are not. Because a frame is never early, the earliest of the
    frames beside the interval, less their intervals, tells when its ends were due.
    """
    missing = np.zeros(len(wide), np.int64)
    borders = np.concatenate([[-1], wide, [len(times) - 1]])
    for index, gap in enumerate(wide):
        interval = float(local[gap])
        before = times[max(borders[index] + 1, gap + 1 - NEIGHBOUR_FRAMES) : gap + 1][::-1]
        after = times[gap + 1 : min(borders[index + 2], gap + NEIGHBOUR_FRAMES) + 1]
        start = (before + interval * np.arange(len(before))).min()
        end = (after - interval * np.arange(len(after))).min()
        missing[index] = max(round((end - start) / interval) - 1, 0)
    return missing


def _local_intervals(gaps: NDArray[np.float64]) -> NDArray[np.float64]:
    """The median of the intervals around each one, (N,) s."""
    if len(gaps) <= LOCAL_INTERVALS:
        return np.full(len(gaps), np.median(gaps))
    from scipy.ndimage import median_filter

    return np.asarray(median_filter(gaps, LOCAL_INTERVALS, mode="reflect"), np.float64)


def seconds_text(seconds: float) -> str:
    """A duration for messages: "120 ms", "3.2 s".

    >>> seconds_text(0.12), seconds_text(3.21), seconds_text(0.0)
    ('120 ms', '3.2 s', '0 ms')
    """
    return f"{1000 * seconds:.0f} ms" if abs(seconds) < 1 else f"{seconds:.1f} s"
