"""The checks of `tactflow doctor`, one function each.

To add a check, write a function below `@check(name, unit, warning=..., fault=...)`. It takes an `Observation`
and returns a `Measured`: a number to compare with the limits, what it does to the errors, and what to change;
or in words why this source does not show it. Limits without a comment are measured: there, an error of the
default pipeline is twice and five times what it is without the fault, on the simulated scene `press`
(docs/doctor.md).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tactflow.doctor import measures
from tactflow.doctor.observation import Observation

Verdict = Literal["good", "warning", "fault", "unknown"]


class Measured(NamedTuple):
    """number : in the unit of the check. says : the same in words. effect : what a fault does to the errors.
    advice : what to change. limits : warning and fault, where they depend on the source."""

    number: float
    says: str
    effect: str
    advice: str
    limits: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True)
class Finding:
    """What a check found.

    verdict : `unknown` where the source does not show it. number : None where nothing was measured. says :
    the value in words, or why it is unknown. effect : what it does to the errors; advice : what to change;
    both empty where all is good.
    """

    name: str
    verdict: Verdict
    says: str
    number: float | None = None
    unit: str = ""
    effect: str = ""
    advice: str = ""


Measure = Callable[[Observation], Measured | str]
CHECKS: list[Callable[[Observation], Finding]] = []
"""All checks, in the order of the table."""


def check(name: str, unit: str, *, warning: float, fault: float) -> Callable[[Measure], Measure]:
    """Make a function a check. warning, fault : limits; where `fault` is smaller, low values are bad."""

    def register(measure: Measure) -> Measure:
        def run(seen: Observation) -> Finding:
            measured = measure(seen)
            if isinstance(measured, str):
                return Finding(name, "unknown", measured)
            number, says, effect, advice, limits = measured
            low, high = limits or (warning, fault)
            sign = -1.0 if high < low else 1.0
            if sign * number < sign * low:
                return Finding(name, "good", says, number, unit)
            verdict: Verdict = "fault" if sign * number >= sign * high else "warning"
            return Finding(name, verdict, says, number, unit, effect, advice)

        CHECKS.append(run)
        return measure

    return register


def examine(seen: Observation) -> list[Finding]:
    """Run all checks.

    >>> from tactflow.doctor import observe
    >>> sorted({finding.verdict for finding in examine(observe("sim:idle?frames=8", 1.0))})
    ['good', 'unknown']
    """
    return [run(seen) for run in CHECKS]


def worst(findings: list[Finding]) -> Verdict:
    """The worst verdict of all: fault, warning, or good."""
    verdicts = {finding.verdict for finding in findings}
    return "fault" if "fault" in verdicts else "warning" if "warning" in verdicts else "good"


Curve = tuple[tuple[float, float], ...]
"""(value, factor by which an error grows), measured."""

BLUR: Final[Curve] = ((0.09, 1), (0.13, 1.1), (0.2, 1.6), (0.28, 2.1), (0.35, 2.7), (0.41, 4.6), (0.47, 8.8))
"""Blur, in sizes of a dot, and the error of a dot's displacement."""
NOISE: Final[Curve] = ((2, 1), (4, 1.3), (8, 2.3), (12, 3.5), (16, 4.9))
"""Noise, grey levels, and the error of a dot's displacement."""
JPEG: Final[Curve] = ((2, 1.05), (10, 1.5), (20, 2.2), (37, 3.4), (69, 6.3))
"""Step of JPEG, grey levels, and the error of a dot's displacement."""
BANDS: Final[Curve] = ((0.5, 1), (1.0, 1.05), (1.9, 1.3), (2.8, 8.5), (3.7, 21), (4.7, 86))
"""Amplitude of bands, %, and the error of the contact's centre."""
CLIPPED: Final[Curve] = ((0, 1), (1.2, 1.7), (13, 5.4), (90, 4.1), (95, 32))
"""Clipped part of the gel, %, and the error of the contact's centre."""
DOT_PITCHES: Final = 0.15
"""Radius of a dot over the pitch, at most: a blurred dot looks larger. 0.11 to 0.15 in simulated scenes."""
CODEC_REPEATS: Final = 10.0
"""Frames of a good recording that repeat the one before, %: codecs do so where nothing changes (measured)."""
STEADY: Final = 0.35
"""95th percentile of the dots' displacement, px, up to which nothing touches the gel: the bound by which the
recordings of franka_mini were labelled."""
LEAST: Final = 3
"""Frames from which bands, and untouched frames from which a drift can be measured."""


def _growth(curve: Curve, value: float, error: str) -> str:
    factor = float(np.interp(value, *np.array(curve).T))
    least = "at least " if value > curve[-1][0] else ""
    return f"{error} off {least}{factor:.2g} times as much (simulated sensor)"


# The slowest cameras of such sensors are sold with 25 frames/s. One that lengthens its exposure in the dark
# falls to half of what it promises.
@check("rate", "1/s", warning=20.0, fault=12.0)
def _rate(seen: Observation) -> Measured | str:
    if isinstance(gaps := seen.gaps, str):
        return gaps
    rate = 1.0 / float(gaps.mean())
    jitter = 100.0 * measures.spread(gaps - np.median(gaps)) * rate
    promised, limits = "", None
    if seen.live and seen.promised:
        promised = f" of {seen.promised:.3g} promised"
        limits = max(20.0, 0.9 * seen.promised), max(12.0, 0.7 * seen.promised)
    # Dots that move by a whole pitch between two frames are mistaken for others (scene `jumps`).
    reach = f"; dots may move by {0.9 * seen.dots.pitch * rate:.0f} px/s" if seen.dots else ""
    return Measured(
        rate,
        f"{rate:.3g} frames/s{promised}, jitter {jitter:.0f} %",
        f"a contact shorter than {1000 / rate:.0f} ms may pass unseen{reach} before they are mistaken",
        "a fixed short exposure with more light (automatic exposure halves the rate in the dark); format "
        "MJPG or fewer pixels; a USB port of its own",
        limits,
    )


# Chosen by hand.
@check("drop-outs", "%", warning=1.0, fault=10.0)
def _drop_outs(seen: Observation) -> Measured:
    late = 0
    if not isinstance(gaps := seen.gaps, str):
        usual = max(float(np.median(gaps)), 1e-9)
        late = int(np.maximum(np.rint(gaps / usual) - 1, 0).sum())
    missing = max(late, seen.missing)
    total = seen.frames + missing
    repeated = 100.0 * seen.repeated / total - (0.0 if seen.live else CODEC_REPEATS)
    stopped = f"; then: {seen.stopped}" if seen.stopped else ""
    return Measured(
        100.0 if stopped else 100.0 * missing / total + max(0.0, repeated),
        f"{missing} of {total} frames missing, {seen.repeated} repeated{stopped}",
        "contacts begin late, and dots move further between two frames",
        "another cable and port (no hub), fewer pixels or MJPG, nothing else that needs the processor",
    )


# Three and nine frames at 30 a second; chosen by hand.
@check("latency", "ms", warning=100.0, fault=300.0)
def _latency(seen: Observation) -> Measured | str:
    if not seen.delays:
        return "frames come without the time they were taken" if seen.live else "a recording has none"
    delay = 1000.0 * float(np.median(seen.delays))
    return Measured(
        delay,
        f"frames are {delay:.0f} ms old when they are read",
        "whatever acts on the results acts that much later",
        "fewer pixels or an uncompressed format; a driver that keeps fewer frames",
    )


# At 46 grey levels dots are off by 1.3 times as much, at 23 they are not found.
@check("exposure", "grey levels", warning=50.0, fault=30.0)
def _exposure(seen: Observation) -> Measured:
    level = float(np.median([exposure.level for exposure in seen.exposures]))
    return Measured(
        level,
        f"the brighter gel has {level:.0f} of 255 grey levels",
        "dots and shades sink into the noise; below 24 grey levels the gel is taken for surroundings",
        "more light, or a longer exposure as far as the rate allows it",
    )


@check("clipping", "%", warning=1.5, fault=10.0)
def _clipping(seen: Observation) -> Measured:
    share = 100.0 * float(np.mean([exposure.clipped for exposure in seen.exposures]))
    return Measured(
        share,
        f"{round(share, 2):.2g} % of the gel is clipped",
        "a contact there shows no shades: " + _growth(CLIPPED, share, "its centre is"),
        "less exposure or gain, fixed and not automatic; lamps that do not shine into the camera",
    )


# Without dots: 0.5 % of the picture's width, where the contact's centre is off by twice as much, and 1 %.
@check("focus", "px", warning=math.nan, fault=math.nan)
def _focus(seen: Observation) -> Measured | str:
    blur, dots, width = measures.blur(seen.typical), seen.dots, seen.typical.shape[1]
    if blur is None:
        return "there is no sharp edge in the picture to measure it by"
    says, effect, limits = f"blur of {blur:.1f} px", "outlines of contacts are blurred", (0.005, 0.01)
    if dots is not None:
        width = min(dots.dot_radius, DOT_PITCHES * dots.pitch)
        says += f", dots of radius {dots.dot_radius:.1f} px"
        effect, limits = _growth(BLUR, blur / width, "displacements of dots are"), (0.28, 0.42)
    advice = "focus the lens on the gel's surface, clean it; a shorter exposure if the gel moves fast"
    return Measured(blur, says, effect, advice, (limits[0] * width, limits[1] * width))


@check("noise", "grey levels", warning=7.0, fault=16.0)
def _noise(seen: Observation) -> Measured:
    noise = measures.noise_of(seen.pairs)
    return Measured(
        noise,
        f"{noise:.1f} grey levels",
        _growth(NOISE, noise, "displacements of dots are"),
        "more light and less gain; a longer exposure as far as the rate allows it",
    )


# From 2 to 3 % the error grows from 1.3 to 8.5 times. Large contacts make up to 0.9 % on real gels (sts_640).
@check("banding", "%", warning=1.5, fault=2.5)
def _banding(seen: Observation) -> Measured | str:
    if len(seen.pairs) < LEAST:
        return f"{len(seen.pairs)} frames are too few"
    amplitude, axis = measures.bands(seen.grays)
    return Measured(
        100.0 * amplitude,
        f"bands of {100 * amplitude:.1f} % of the light across the {axis}",
        "bands are taken for contacts: " + _growth(BANDS, 100.0 * amplitude, "centres are"),
        "lamps on direct current; else exposures of whole periods of the mains (10 or 8.33 ms), and no "
        "daylight tubes that shine through the gel",
    )


@check("light", "%", warning=50.0, fault=math.inf)
def _light(seen: Observation) -> Measured:
    typical = np.maximum(seen.typical, measures.DIM)
    levels = np.array([float(np.median(gray / typical)) for gray in seen.grays])
    change = 100.0 * float(levels.max() / max(levels.min(), 1e-9) - 1.0)
    return Measured(
        change,
        f"changes by {change:.1f} %",
        "up to 50 % nothing suffers; more was not measured",
        "exposure and white balance fixed, and not automatic; let lamps warm up",
    )


# JPEG qualities of about 30 and 10.
@check("compression", "grey levels", warning=18.0, fault=55.0)
def _compression(seen: Observation) -> Measured:
    step, says = seen.jpeg_step or 0.0, "no trace of JPEG"
    if step:
        says = f"JPEG of quality {measures.jpeg_quality(step):.0f} or so, steps of {step:.0f} grey levels"
    return Measured(
        step,
        says,
        _growth(JPEG, step, "displacements of dots are") + "; outlines are cut to blocks of 8 px",
        "a higher quality, or an uncompressed format (YUYV); record with tactflow record, without loss",
    )


# Real grids have up to 13 % empty places, also in perspective; chosen by hand.
@check("dots", "% missing", warning=15.0, fault=40.0)
def _dots(seen: Observation) -> Measured | str:
    dots = seen.dots
    if dots is None:
        return "none found; fine for a gel without: pipelines/markerless.yaml"
    found = measures.lattice(dots, seen.typical)
    return Measured(
        100.0 * found.missing,
        f"{found.found} {dots.polarity} dots {dots.pitch:.0f} px apart, {100 * found.closed:.0f} % regular, "
        f"{100 * found.missing:.0f} % missing, contrast {found.contrast:.0f} grey levels",
        "where a dot is missing, motion is guessed from its neighbours",
        "look at tactflow detect SRC --picture FILE; give polarity and dot, print worn dots anew",
    )


# All of it is error of the dots' displacement, which is 0.01 px on a resting simulated gel; this check itself
# may be off by 0.05 px. Chosen by hand.
@check("drift", "px", warning=0.15, fault=1.0)
def _drift(seen: Observation) -> Measured | str:
    late = [shift for number, shift in _at_rest(seen) if 2 * number >= seen.frames]
    if len(late) < LEAST:
        return "too few untouched frames in the second half"
    x, y = np.median(late[-max(LEAST, len(late) // 3) :], axis=0)
    drift = math.hypot(x, y)
    return Measured(
        drift,
        f"the resting gel has moved by {drift:.2f} px ({x:+.2f}, {y:+.2f})",
        f"every displacement is off by {drift:.2f} px, and flow with it",
        "fix gel and camera; let the gel settle; take a new reference while nothing touches",
    )


def _at_rest(seen: Observation) -> Iterator[tuple[int, NDArray[np.float64]]]:
    """Frames in which the gel rests: number, and (x, y) px by which it has moved as a whole."""
    first = seen.pairs[0].image
    points = measures.points(first) if seen.dots is None else seen.dots.centers.astype(np.float32)
    reference = measures.smooth(first)
    for pair in seen.pairs[1:]:
        moved = measures.motion(reference, measures.smooth(pair.image), points)
        found = moved[np.isfinite(moved[:, 0])]
        # Ten points, and half of them, make a sound median.
        if len(found) < max(10, len(points) / 2):
            continue
        middle = np.median(found, axis=0)
        if np.percentile(np.hypot(*(found - middle).T), 95) < STEADY:
            yield pair.number, middle.astype(np.float64)
