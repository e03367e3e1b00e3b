"""The checks of `tactflow doctor`, one function each.

To add a check, write a function below `@check(name, unit, warning=..., fault=...)`. It takes an `Observation`
and returns a `Finding`, or the reason why this source cannot be checked. Limits without a comment are
measured: they double, or increase fivefold, an error of the default pipeline on the simulated scene `press`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np

from tactflow.recording.verdict import Finding, Grade, examine_recording
from tactflow.tools.doctor import measures
from tactflow.tools.doctor.observation import Observation

Measure = Callable[[Observation], Finding | str]
CHECKS: list[Callable[[Observation], Finding]] = []
"""All checks of the sensor, in the order of the table."""


def check(name: str, unit: str, *, warning: float, fault: float) -> Callable[[Measure], Measure]:
    """Register a check. warning, fault : limits; if `fault` is smaller, low values are bad."""

    def register(measure: Measure) -> Measure:
        def run(observed: Observation) -> Finding:
            found = measure(observed)
            if isinstance(found, str):
                found = Finding(None, found)
            return found.graded(name, unit, found.limits or (warning, fault))

        CHECKS.append(run)
        return measure

    return register


def examine(observed: Observation) -> list[Finding]:
    """Run all checks: of how the pictures were recorded, and of the sensor.

    >>> from tactflow.tools.doctor import observe
    >>> sorted({finding.verdict for finding in examine(observe("sim:idle?frames=8", 1.0))})
    ['good']
    """
    return [*examine_recording(observed.recorded), *(run(observed) for run in CHECKS)]


def worst(findings: Sequence[Finding]) -> Grade:
    """The worst verdict: fault, warning, or good."""
    verdicts = {finding.verdict for finding in findings}
    return "fault" if "fault" in verdicts else "warning" if "warning" in verdicts else "good"


MAX_DOT_RADIUS: Final = 0.15
"""Largest plausible dot radius in pitches: blur makes dots look larger. 0.11 to 0.15 in simulated scenes."""
MIN_FRAMES: Final = 3
"""Minimum number of frames for bands."""


# The slowest cameras of such sensors have 25 frames/s; automatic exposure in the dark halves the rate.
@check("rate", "1/s", warning=20.0, fault=12.0)
def _rate(observed: Observation) -> Finding | str:
    if isinstance(gaps := observed.gaps, str):
        return gaps
    rate = 1.0 / float(gaps.mean())
    # A recording with a low rate can be used for what moves slowly.
    nominal, limits = "", None if observed.live else (20.0, 0.0)
    if observed.live and observed.nominal:
        nominal = f" of nominally {observed.nominal:.3g}"
        limits = max(20.0, 0.9 * observed.nominal), max(12.0, 0.7 * observed.nominal)
    # Dots that move by a whole pitch between two frames are confused with their neighbours (scene `jumps`).
    reach = (
        f"; dots faster than {0.9 * observed.dots.pitch * rate:.0f} px/s are confused"
        if observed.dots
        else ""
    )
    return Finding(
        rate,
        f"{rate:.3g} frames/s{nominal}",
        f"contacts shorter than {1000 / rate:.0f} ms may be missed{reach}",
        "a fixed short exposure with more light (automatic exposure halves the rate in the dark); format "
        "MJPG or fewer pixels; a separate USB port",
        limits,
    )


# At 46 grey levels, dots have 1.3 times the error; at 23 they are not detected.
@check("exposure", "grey levels", warning=50.0, fault=30.0)
def _exposure(observed: Observation) -> Finding:
    level = float(np.median(observed.levels))
    return Finding(
        level,
        f"the brighter gel has {level:.0f} of 255 grey levels",
        "dots and shading disappear in the noise; below 24 grey levels the gel is classified as background",
        "more light, or a longer exposure as far as the rate allows it",
    )


# Without dots: 0.5 % of the width, which doubles the error of the contact's centre, and 1 %.
@check("focus", "px", warning=math.nan, fault=math.nan)
def _focus(observed: Observation) -> Finding | str:
    blur, dots, width = measures.blur(observed.typical), observed.dots, observed.typical.shape[1]
    if blur is None:
        return "the picture has no sharp edges"
    says, effect, limits = f"blur of {blur:.1f} px", "outlines of contacts are blurred", (0.005, 0.01)
    if dots is not None:
        width = min(dots.dot_radius, MAX_DOT_RADIUS * dots.pitch)
        says += f", dots of radius {dots.dot_radius:.1f} px"
        effect, limits = "displacements of dots are less exact", (0.28, 0.42)
    advice = "focus the lens on the gel's surface, clean it; a shorter exposure if the gel moves fast"
    return Finding(blur, says, effect, advice, (limits[0] * width, limits[1] * width))


@check("noise", "grey levels", warning=7.0, fault=16.0)
def _noise(observed: Observation) -> Finding | str:
    if observed.black_and_white:
        return "the pictures are black and white"
    noise = measures.noise_of(observed.pairs)
    return Finding(
        noise,
        f"{noise:.1f} grey levels",
        "displacements of dots are less exact, and faint contacts are missed",
        "more light and less gain; a longer exposure as far as the rate allows it",
    )


# From 2 to 3 %, the factor on the error grows from 1.3 to 8.5. Large contacts cause up to 0.9 % on real gels
# (sts_640).
@check("banding", "%", warning=1.5, fault=2.5)
def _banding(observed: Observation) -> Finding | str:
    if len(observed.pairs) < MIN_FRAMES:
        return f"{len(observed.pairs)} frames are too few"
    amplitude, axis = measures.bands(observed.grays)
    return Finding(
        100.0 * amplitude,
        f"bands of {100 * amplitude:.1f} % of the light across the {axis}",
        "bands are detected as contacts, and shift the centres of contacts",
        "lamps on direct current; otherwise exposure times of whole mains periods (10 or 8.33 ms), and no "
        "fluorescent light through the gel",
    )


# Real grids have up to 13 % empty positions, including perspective views; chosen by hand.
@check("dots", "% missing", warning=15.0, fault=40.0)
def _dots(observed: Observation) -> Finding | str:
    dots = observed.dots
    if dots is None:
        return "none detected; for a gel without dots use the pipeline markerless"
    grid = measures.lattice(dots, observed.typical)
    return Finding(
        100.0 * grid.missing,
        f"{grid.found} {dots.polarity} dots {dots.pitch:.0f} px apart, {100 * grid.closed:.0f} % regular, "
        f"{100 * grid.missing:.0f} % missing, contrast {grid.contrast:.0f} grey levels",
        "motion at missing dots is interpolated from their neighbours",
        "check with tactflow detect SRC --picture FILE; set polarity and dot, reprint worn dots",
    )
