"""Whether the sensors of a session are in step: each sees the gel move when the others do.

Two fingers that hold an object feel its motion at the same moment. The change from frame to frame is
therefore cross-correlated, as for any two time series (G. Box and G. Jenkins, Time Series Analysis, 1970,
chapter 11): what each frame's change owes to that of the frame before is subtracted first, so that the
correlations at other lags have a standard error of 1 / sqrt(N).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tactflow.recording.course import Course, seconds_text
from tactflow.recording.verdict import Finding

Series = NDArray[np.float64]

MAX_LAG_SECONDS: Final = 2.0
"""Largest lag that is searched, s; a network stream has 1 s and more."""
MIN_MOMENTS: Final = 40
"""Minimum number of moments of each half of a session: fewer have no significant correlation."""
MIN_CORRELATION_STDERRS: Final = 5.0
"""Minimum correlation of a lag, standard errors: one of 10,000 sessions has it by chance, at 200 lags."""
MIN_GAIN_STDERRS: Final = 3.0
"""Minimum distance of a correlation from those in step, and its minimum in each half, standard errors."""
MAX_CHANGE_STDDEVS: Final = 10.0
"""Limit of a change, in robust standard deviations, so that no single moment decides."""
MAX_IN_STEP_INTERVALS: Final = 1.5
"""Largest lag of sensors in step, intervals: unsynchronised cameras are up to one apart, and a change belongs
to two frames."""
MAX_IN_STEP_SECONDS: Final = 0.05
"""Largest lag of sensors in step, s: fingers that close at 50 mm/s on an object 2 mm off the middle touch it
40 ms apart."""
MENTIONED_START_SECONDS: Final = 1.0
"""Difference between the first frames, or between the last ones, that is mentioned, s: programs that start
sensors one after another need less."""
BAD_ABSENCE_PERCENT: Final = 50.0
"""Share of a session without one of its sensors from which it is bad, %."""


@dataclass(frozen=True)
class Track:
    """The course of one sensor of a session.

    Attributes
    ----------
    begins : Unix time of t = 0, s; None if unknown.
    """

    name: str
    course: Course
    begins: float | None = None


class Lag(NamedTuple):
    """How far a sensor is behind another.

    Attributes
    ----------
    seconds : negative if it is ahead.
    halves : in the first and the second half of the session, s.
    proven : in step or not, this is significant.
    """

    seconds: float
    halves: tuple[float, float]
    proven: bool


def examine_session(tracks: list[Track]) -> list[Finding]:
    """A finding for each sensor but the first, with which it is compared."""
    return [_compared(tracks[0], track) for track in tracks[1:]]


def _compared(left: Track, right: Track) -> Finding:
    clocks = left.begins is not None and right.begins is not None
    # Without a common clock, both are taken to begin at the same moment.
    times = [
        track.course.times + ((track.begins or 0.0) if clocks else -float(track.course.times[0]))
        for track in (left, right)
    ]
    interval = max(float(np.median(np.diff(t))) if len(t) > 1 else 0.0 for t in times)
    if interval <= 0:
        return Finding(None, f"{right.name}: too few frames", name="step", unit="ms")
    apart, share = _apart(left.name, right.name, *times)
    lag = lag_between(times[0], left.course.changes, times[1], right.course.changes)
    limit = max(MAX_IN_STEP_INTERVALS * interval, MAX_IN_STEP_SECONDS)
    texts = [*apart, *_lag_texts(left.name, right.name, lag, limit)]
    if not texts:
        if lag is None:
            needed = seconds_text(2 * MIN_MOMENTS * interval)
            return Finding(None, f"{right.name}: required {needed} in common", name="step", unit="ms")
        if not lag.proven:
            unknown = f"{right.name}: the sensors have no motion in common that tells; press both at once"
            return Finding(None, unknown, name="step", unit="ms")
        texts = [f"{right.name} and {left.name} are in step"]
        return Finding(1000 * abs(lag.seconds), texts[0]).graded("step", "ms", (1000 * limit, np.inf))
    return Finding(
        1000 * abs(lag.seconds) if lag and lag.proven else None,
        "; ".join(texts),
        "what one sensor shows is paired with another moment of the other",
        "take the times of the pictures where they arrive, shorten the camera's queue (one buffer), and "
        "start the sensors together; a constant lag can be subtracted",
        (1000 * limit, np.inf),
        "step",
        "ms",
        "fault" if share >= BAD_ABSENCE_PERCENT else "warning",
    )


def _apart(left: str, right: str, first: Series, second: Series) -> tuple[list[str], float]:
    """Which sensor begins or ends earlier, and the share of the session in which one is missing, %."""
    begin, end = second[0] - first[0], first[-1] - second[-1]
    texts = []
    for late, words in ((begin, "begins {} after"), (end, "ends {} before")):
        names = (right, left) if late > 0 else (left, right)
        if abs(late) >= MENTIONED_START_SECONDS:
            texts.append(f"{names[0]} {words.format(seconds_text(abs(late)))} {names[1]}")
    whole = max(first[-1], second[-1]) - min(first[0], second[0])
    return texts, 100.0 * (abs(begin) + abs(end)) / max(whole, 1e-9)


def _lag_texts(left: str, right: str, lag: Lag | None, limit: float) -> list[str]:
    if lag is None or not lag.proven:
        return []
    first, second = lag.halves
    if abs(first - second) > limit:
        return [
            f"{right} goes out of step with {left}: {seconds_text(first)} behind it in the first half, "
            f"{seconds_text(second)} in the second"
        ]
    if abs(lag.seconds) <= limit:
        return []
    names = (right, left) if lag.seconds > 0 else (left, right)
    return [f"{names[0]} is {seconds_text(abs(lag.seconds))} behind {names[1]}"]


def lag_between(first: Series, changes: Series, second: Series, others: Series) -> Lag | None:
    """How far the second sensor is behind the first; None if they overlap too little.

    first, second : times of the frames on one clock, (N,) and (M,) s. changes, others : change from frame to
    frame of each, any unit.

    >>> rng = np.random.default_rng(0)
    >>> t, moves = np.arange(400) / 30, np.exp(rng.normal(size=410))
    >>> lag = lag_between(t, moves[10:], t, moves[4:404])
    >>> round(lag.seconds, 1), lag.proven
    (0.2, True)
    """
    interval = max(float(np.median(np.diff(times))) for times in (first, second))
    grid = np.arange(max(first[0], second[0]), min(first[-1], second[-1]), interval)
    half = len(grid) // 2
    if half < MIN_MOMENTS:
        return None
    left, right = _activity(first, changes, grid), _activity(second, others, grid)
    span = min(round(MAX_LAG_SECONDS / interval), half // 2)
    near = int(max(MAX_IN_STEP_INTERVALS, MAX_IN_STEP_SECONDS / interval))
    whole, *halves = (
        _correlations(left[part], right[part], span) for part in (slice(None), slice(half), slice(half, None))
    )
    lags = [int(scores.argmax()) - span for scores in (whole, *halves)]

    def beaten(scores: Series, lag: int) -> float:
        """By how much the best lag exceeds those near another one, standard errors."""
        middle = lag + span
        return float(scores.max() - scores[max(middle - near, 0) : middle + near + 1].max())

    drifts = all(
        scores.max() > MIN_CORRELATION_STDERRS and beaten(scores, other) > MIN_GAIN_STDERRS
        for scores, other in zip(halves, reversed(lags[1:]), strict=True)
    )
    if abs(lags[0]) <= near:
        agrees = all(beaten(scores, 0) <= MIN_GAIN_STDERRS for scores in halves)
    else:
        agrees = beaten(whole, 0) > MIN_GAIN_STDERRS and all(
            scores.max() > MIN_GAIN_STDERRS and abs(lag - lags[0]) <= near
            for scores, lag in zip(halves, lags[1:], strict=True)
        )
    seconds = [
        (lag + _vertex(scores, lag + span)) * interval
        for lag, scores in zip(lags, (whole, *halves), strict=True)
    ]
    of_halves = (seconds[1], seconds[2]) if drifts else (seconds[0], seconds[0])
    return Lag(seconds[0], of_halves, drifts or bool(whole.max() > MIN_CORRELATION_STDERRS and agrees))


def _activity(times: Series, changes: Series, grid: Series) -> Series:
    """Logarithm of the change at each moment of a grid, without what the moment before tells of it."""
    positive = changes[1:][changes[1:] > 0]
    floor = np.quantile(positive, 0.01) if positive.size else 1.0
    level = np.interp(grid, times[1:], np.log(np.maximum(changes[1:], floor)))
    level -= level.mean()
    power = float(level @ level)
    news = level[1:] - (float(level[1:] @ level[:-1]) / power if power else 0.0) * level[:-1]
    news -= np.median(news)
    deviation = 1.4826 * float(np.median(np.abs(news)))
    news = np.clip(news, -MAX_CHANGE_STDDEVS * deviation, MAX_CHANGE_STDDEVS * deviation)
    # The same moment may belong to different frames of two sensors.
    return np.asarray(np.convolve(news, [0.25, 0.5, 0.25], "same"), np.float64)


def _correlations(left: Series, right: Series, span: int) -> Series:
    """Correlations at lags of -span to span moments, in standard errors."""
    left, right = left - left.mean(), right - right.mean()
    count = len(left)
    scale = float(np.sqrt((left @ left) * (right @ right)))
    if scale == 0:
        return np.zeros(2 * span + 1)
    products = [
        left[: count - lag] @ right[lag:] if lag >= 0 else left[-lag:] @ right[: count + lag]
        for lag in range(-span, span + 1)
    ]
    # M. Bartlett, 1946: what is left of correlations in time leaves fewer independent moments.
    own = sum(
        float((left[lag:] @ left[:-lag]) * (right[lag:] @ right[:-lag])) / scale**2 for lag in range(1, 4)
    )
    independent = count / max(1.0 + 2.0 * own, 1.0)
    return np.array(products, np.float64) * (float(np.sqrt(independent)) / scale)


def _vertex(scores: Series, index: int) -> float:
    """Offset of the maximum from its index, by a parabola, -0.5 to 0.5."""
    if not 0 < index < len(scores) - 1:
        return 0.0
    before, at, after = scores[index - 1 : index + 2]
    curvature = before - 2 * at + after
    return 0.0 if curvature >= 0 else float(np.clip(0.5 * (before - after) / curvature, -0.5, 0.5))
