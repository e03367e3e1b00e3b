"""The checks of `tactflow doctor`: each measures one thing and says what it does to the results.

The bounds of `warning` and `fault` stand where an error of the default pipeline becomes twice and five times
what it is without the fault, on the scene `press` of the simulated sensor; docs/doctor.md has the table.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from tactflow.doctor import measures
from tactflow.doctor.observation import LEAST_FRAMES, Observation

Verdict = Literal["good", "warning", "fault", "unknown"]


@dataclass(frozen=True, slots=True)
class Finding:
    """What one check found.

    name : of the check. verdict : `unknown` where the source does not show it. number : the measured value,
    None where there is none, in `unit`. says : the value in words. effect : what it does to the errors.
    advice : what to change; both empty where all is good.
    """

    name: str
    verdict: Verdict
    says: str
    number: float | None = None
    unit: str = ""
    effect: str = ""
    advice: str = ""


@dataclass(frozen=True, slots=True)
class Bounds:
    """From where on a number is a warning, and from where on a fault; falling: it is low values that are."""

    warning: float
    fault: float
    falling: bool = False

    def verdict(self, number: float) -> Verdict:
        """The verdict on a number.

        >>> [Bounds(1, 2).verdict(x) for x in (0.5, 1, 3)]
        ['good', 'warning', 'fault']
        """
        sign = -1.0 if self.falling else 1.0
        if sign * number >= sign * self.fault:
            return "fault"
        return "warning" if sign * number >= sign * self.warning else "good"


Curve = tuple[tuple[float, float], ...]
"""(value, times as large an error), measured."""

BLUR: Final[Curve] = ((0.09, 1), (0.13, 1.1), (0.2, 1.6), (0.28, 2.1), (0.35, 2.7), (0.41, 4.6), (0.47, 8.8))
"""Blur as it is measured, in sizes of a dot, and the error of a dot's displacement."""
NOISE: Final[Curve] = ((2, 1), (4, 1.3), (8, 2.3), (12, 3.5), (16, 4.9))
"""Noise, grey levels, and the error of a dot's displacement."""
JPEG: Final[Curve] = ((2, 1.05), (10, 1.5), (20, 2.2), (37, 3.4), (69, 6.3))
"""Step of JPEG, grey levels, and the error of a dot's displacement."""
BANDS: Final[Curve] = ((0.005, 1), (0.01, 1.05), (0.019, 1.3), (0.028, 8.5), (0.037, 21), (0.047, 86))
"""Amplitude of bands, relative, and the error of the contact's centre."""
CLIPPED: Final[Curve] = ((0, 1), (0.012, 1.7), (0.13, 5.4), (0.9, 4.1), (0.95, 32))
"""Share of the gel that is clipped, and the error of the contact's centre."""

BLUR_SIZES: Final = Bounds(0.28, 0.42)
"""Blur, in sizes of a dot."""
DOT_PITCHES: Final = 0.15
"""Radius of a dot over the pitch at most, for its size: a blurred dot looks larger. Found by hand: 0.11 to
0.15 in the simulated scenes."""
BLUR_WIDTHS: Final = Bounds(0.005, 0.01)
"""Blur over the width of the picture, on gels without dots: there the contact's centre is off by twice as
much at 4 px of 800. The fault is chosen by hand."""
NOISE_LEVELS: Final = Bounds(7.0, 16.0)
"""Noise, grey levels."""
JPEG_STEPS: Final = Bounds(18.0, 55.0)
"""Step of JPEG, grey levels: qualities of about 30 and 10."""
BAND_SHARES: Final = Bounds(0.015, 0.025)
"""Amplitude of bands, relative. From 0.02 to 0.03 of the light's own bands the error grows from 1.3 to 8.5
times. Large contacts make up to 0.009 on real gels (sts_640)."""
CLIPPED_SHARES: Final = Bounds(0.015, 0.1)
"""Share of the gel that is clipped."""
LEVELS: Final = Bounds(50.0, 30.0, falling=True)
"""Brightness of the gel, grey levels: at 46 dots are off by 1.3 times as much, at 23 they are not found."""
RATES: Final = Bounds(20.0, 12.0, falling=True)
"""Frames a second. Chosen by hand: the slowest cameras of such sensors are sold with 25."""
DELIVERED: Final = Bounds(0.9, 0.7, falling=True)
"""Frames that come over frames that were promised. Chosen by hand: a camera that lengthens its exposure in
the dark falls to a half."""
JITTER: Final = Bounds(0.25, 1.0)
"""Deviation of the time between frames, over that time. Chosen by hand."""
LOST: Final = Bounds(0.01, 0.1)
"""Share of the frames that did not come, or came twice. Chosen by hand."""
STILL: Final = Bounds(0.2, 0.5)
"""Share of the frames of a video that equal the one before. Chosen by hand: a coder that sees no change
repeats frames, too, up to 0.1 in good ones (measured)."""
DRIFT: Final = Bounds(0.15, 1.0)
"""Drift of the resting gel, px: all of it is error of the dots' displacement, which is 0.01 px on a resting
simulated gel, and 0.05 px is what this check itself may be off by. Chosen by hand."""
DELAY: Final = Bounds(0.1, 0.3)
"""Age of a frame when it is read, s. Chosen by hand: three and nine frames at 30 a second."""
MISSING: Final = Bounds(0.15, 0.4)
"""Share of a grid's places without a dot. Chosen by hand: real grids have up to 0.13, also in perspective."""
FLICKER: Final = 0.06
"""Deviation of the light from frame to frame up to which nothing suffers (measured), relative."""
LIGHT_CHANGE: Final = 0.5
"""Change of the light up to which nothing suffers (measured), relative."""
PITCHES: Final = 0.9
"""Pitches that dots may move between two frames and still be themselves (scene `jumps`)."""
STEADY: Final = 0.35
"""95th percentile of the dots' displacement, px, up to which nothing touches the gel: the bound by which the
recordings of franka_mini were labelled."""
POINTS: Final = 10
"""Points that have to be followed to tell a drift. Chosen by hand."""
LATER: Final = 3
"""Untouched frames in the second half of a recording that tell a drift. Chosen by hand."""
FOLLOWED: Final = 200
"""Points that are followed on a gel without dots, at most. Chosen by hand."""


def examine(seen: Observation) -> list[Finding]:
    """All checks, in the order in which they are told.

    >>> from tactflow.doctor import observe
    >>> sorted({finding.verdict for finding in examine(observe("sim:idle?frames=8", 1.0))})
    ['good', 'unknown']
    """
    return [
        _rate(seen),
        _lost(seen),
        _latency(seen),
        _exposure(seen),
        _clipping(seen),
        _focus(seen),
        _noise(seen),
        _banding(seen),
        _light(seen),
        _jpeg(seen),
        _dots(seen),
        _drift(seen),
    ]


def worst(findings: list[Finding]) -> Verdict:
    """The worst verdict of all: fault, warning, or good."""
    verdicts = {finding.verdict for finding in findings}
    return "fault" if "fault" in verdicts else "warning" if "warning" in verdicts else "good"


def _worse(*verdicts: Verdict) -> Verdict:
    order: list[Verdict] = ["unknown", "good", "warning", "fault"]
    return max(verdicts, key=order.index)


def _told(finding: Finding) -> Finding:
    """Without effect and advice where all is good."""
    if finding.verdict in ("warning", "fault"):
        return finding
    return Finding(finding.name, finding.verdict, finding.says, finding.number, finding.unit)


def _grown(curve: Curve, value: float, what: str) -> str:
    factor = float(np.interp(value, [x for x, _ in curve], [y for _, y in curve]))
    least = "at least " if value > curve[-1][0] else ""
    return f"{what} {least}{factor:.2g} times as much (simulated sensor)"


def _rate(seen: Observation) -> Finding:
    times = seen.times
    if times is None:
        return Finding("rate", "unknown", "single pictures have no times")
    gaps = np.diff(times)
    if len(times) < LEAST_FRAMES or gaps.sum() <= 0:
        return Finding("rate", "unknown", f"{len(times)} frames are too few")
    rate = len(gaps) / float(gaps.sum())
    usual = float(np.median(gaps))
    jitter = measures.MAD_TO_SIGMA * float(np.median(np.abs(gaps - usual))) / usual if usual > 0 else 1.0
    verdict = _worse(RATES.verdict(rate), JITTER.verdict(jitter))
    promised = ""
    if seen.live and seen.promised:
        promised = f" of {seen.promised:.3g} promised"
        verdict = _worse(verdict, DELIVERED.verdict(rate / seen.promised))
    dots = seen.dots
    reach = "" if dots is None else f"; dots may move by {PITCHES * dots.pitch * rate:.0f} px/s"
    return _told(
        Finding(
            "rate",
            verdict,
            f"{rate:.3g} frames/s{promised}, jitter {100 * jitter:.0f} %",
            rate,
            "1/s",
            f"a contact shorter than {1000 / rate:.0f} ms may pass unseen{reach} before they are mistaken",
            "a fixed short exposure with more light (automatic exposure halves the rate in the dark); format "
            "MJPG or fewer pixels; a USB port of its own",
        )
    )


def _lost(seen: Observation) -> Finding:
    late = 0
    if seen.times is not None and len(seen.times) >= LEAST_FRAMES:
        gaps = np.diff(seen.times)
        usual = max(float(np.median(gaps)), 1e-9)
        late = int(np.maximum(np.rint(gaps / usual) - 1, 0).sum())
    missing = max(late, seen.missing)
    total = seen.frames + missing
    share, same = missing / total, seen.repeated / total
    verdict = _worse(LOST.verdict(share), (LOST if seen.live else STILL).verdict(same))
    says = f"{missing} of {total} frames missing, {seen.repeated} repeated"
    if seen.stopped:
        verdict, says = "fault", f"{says}; then: {seen.stopped}"
    return _told(
        Finding(
            "drop-outs",
            verdict,
            says,
            100 * (share + same),
            "%",
            "contacts begin late, and dots move further between two frames",
            "another cable and port (no hub), fewer pixels or MJPG, nothing else that needs the processor",
        )
    )


def _latency(seen: Observation) -> Finding:
    if not seen.delays:
        why = "a recording has none" if not seen.live else "frames come without the time they were taken"
        return Finding("latency", "unknown", why)
    delay = float(np.median(seen.delays))
    return _told(
        Finding(
            "latency",
            DELAY.verdict(delay),
            f"frames are {1000 * delay:.0f} ms old when they are read",
            1000 * delay,
            "ms",
            "whatever acts on the results acts that much later",
            "fewer pixels or an uncompressed format; a driver that keeps fewer frames",
        )
    )


def _exposure(seen: Observation) -> Finding:
    level = float(np.median([exposure.level for exposure in seen.exposures]))
    return _told(
        Finding(
            "exposure",
            LEVELS.verdict(level),
            f"the brighter gel has {level:.0f} of 255 grey levels",
            level,
            "grey levels",
            "dots and shades sink into the noise; below 24 grey levels the gel counts as no gel",
            "more light, or a longer exposure as far as the rate allows it",
        )
    )


def _clipping(seen: Observation) -> Finding:
    share = float(np.mean([exposure.clipped for exposure in seen.exposures]))
    return _told(
        Finding(
            "clipping",
            CLIPPED_SHARES.verdict(share),
            f"{round(100 * share, 2):.2g} % of the gel is clipped",
            100 * share,
            "%",
            "a contact there shows no shades: " + _grown(CLIPPED, share, "its centre is off"),
            "less exposure or gain, fixed and not automatic; lamps that do not shine into the camera",
        )
    )


def _focus(seen: Observation) -> Finding:
    blur = measures.blur(seen.typical)
    if blur is None:
        return Finding("focus", "unknown", "there is no sharp edge in the picture to tell it by")
    dots = seen.dots
    advice = "focus the lens on the gel's surface, clean it; a shorter exposure if the gel moves fast"
    if dots is None:
        verdict = BLUR_WIDTHS.verdict(blur / seen.typical.shape[1])
        effect = "outlines of contacts are blurred"
        return _told(Finding("focus", verdict, f"blur of {blur:.1f} px", blur, "px", effect, advice))
    relative = blur / min(dots.dot_radius, DOT_PITCHES * dots.pitch)
    return _told(
        Finding(
            "focus",
            BLUR_SIZES.verdict(relative),
            f"blur of {blur:.1f} px, dots of radius {dots.dot_radius:.1f} px",
            blur,
            "px",
            _grown(BLUR, relative, "displacements of dots are off"),
            advice,
        )
    )


def _noise(seen: Observation) -> Finding:
    noise = measures.noise_of(seen.pairs)
    return _told(
        Finding(
            "noise",
            NOISE_LEVELS.verdict(noise),
            f"{noise:.1f} grey levels",
            noise,
            "grey levels",
            _grown(NOISE, noise, "displacements of dots are off"),
            "more light and less gain; a longer exposure as far as the rate allows it",
        )
    )


def _banding(seen: Observation) -> Finding:
    if len(seen.pairs) < LEAST_FRAMES:
        return Finding("banding", "unknown", f"{len(seen.pairs)} frames are too few")
    amplitude, axis = measures.bands(seen.grays)
    return _told(
        Finding(
            "banding",
            BAND_SHARES.verdict(amplitude),
            f"bands of {100 * amplitude:.1f} % of the light across the {axis}",
            100 * amplitude,
            "%",
            "bands are taken for contacts: " + _grown(BANDS, amplitude, "centres are off"),
            "lamps on direct current; else exposures of whole periods of the mains (10 or 8.33 ms), and no "
            "daylight tubes that shine through the gel",
        )
    )


def _light(seen: Observation) -> Finding:
    """Change and flicker of the light, from the median ratio of each frame to the typical one."""
    typical = np.maximum(seen.typical, measures.DIM)
    levels = np.array([float(np.median(gray / typical)) for gray in seen.grays])
    change = float(levels.max() / max(levels.min(), 1e-9) - 1.0)
    flicker = _flicker(seen, typical)
    bad = change > LIGHT_CHANGE or flicker > FLICKER
    return _told(
        Finding(
            "light",
            "warning" if bad else "good",
            f"changes by {100 * change:.1f} %, flickers by {100 * flicker:.1f} %",
            100 * max(change, flicker),
            "%",
            "up to 50 % and 6 % nothing suffers; more was not measured",
            "exposure and white balance fixed, and not automatic; let lamps warm up",
        )
    )


def _flicker(seen: Observation, typical: measures.Gray) -> float:
    """From neighbouring frames: half of their difference is what one of them has."""
    ratios = []
    for pair, gray in zip(seen.pairs, seen.grays, strict=True):
        if pair.after is not None and seen.times is not None:
            after = measures.grey(pair.after)
            ratios.append(float(np.median(after / typical) - np.median(gray / typical)))
    return measures.MAD_TO_SIGMA * float(np.median(np.abs(ratios))) / np.sqrt(2.0) if ratios else 0.0


def _jpeg(seen: Observation) -> Finding:
    step = seen.jpeg_step
    if step is None:
        return Finding("compression", "good", "no trace of JPEG", 0.0, "grey levels")
    return _told(
        Finding(
            "compression",
            JPEG_STEPS.verdict(step),
            f"JPEG of quality {measures.jpeg_quality(step):.0f} or so, steps of {step:.0f} grey levels",
            step,
            "grey levels",
            _grown(JPEG, step, "displacements of dots are off") + "; outlines are cut to blocks of 8 px",
            "a higher quality, or an uncompressed format (YUYV); record with tactflow record, without loss",
        )
    )


def _dots(seen: Observation) -> Finding:
    dots = seen.dots
    if dots is None:
        return Finding(
            "dots", "unknown", "none found; fine for a gel without: pipelines/markerless.yaml", 0.0
        )
    found = measures.lattice(dots, seen.typical)
    says = f"{found.found} {dots.polarity} dots {dots.pitch:.0f} px apart, {100 * found.closed:.0f} % regular"
    return _told(
        Finding(
            "dots",
            MISSING.verdict(found.missing),
            f"{says}, {100 * found.missing:.0f} % missing, contrast {found.contrast:.0f} grey levels",
            float(found.found),
            "",
            "where a dot is missing, motion is guessed from its neighbours",
            "look at tactflow detect SRC --picture FILE; give polarity and dot, print worn dots anew",
        )
    )


def _drift(seen: Observation) -> Finding:
    moved = list(_at_rest(seen))
    half = [shift for number, shift in moved if 2 * number >= seen.frames]
    if len(half) < LATER:
        return Finding("drift", "unknown", "too few untouched frames in the second half")
    x, y = np.median(half[-max(LATER, len(half) // 3) :], axis=0)
    drift = float(np.hypot(x, y))
    return _told(
        Finding(
            "drift",
            DRIFT.verdict(drift),
            f"the resting gel has moved by {drift:.2f} px ({x:+.2f}, {y:+.2f})",
            drift,
            "px",
            f"every displacement is off by {drift:.2f} px, and flow with it",
            "fix gel and camera; let the gel settle; take a new reference while nothing touches",
        )
    )


def _at_rest(seen: Observation) -> Iterator[tuple[int, NDArray[np.float64]]]:
    """Frames in which the gel rests: number, and (x, y) px by which it has moved as a whole."""
    dots = seen.dots
    first = seen.pairs[0].image
    points = measures.points(first, FOLLOWED) if dots is None else dots.centers.astype(np.float32)
    follow: Callable[..., NDArray[np.float32]] = partial(measures.motion, measures.smooth(first))
    for pair in seen.pairs[1:]:
        moved = follow(measures.smooth(pair.image), points)
        seen_again = moved[np.isfinite(moved[:, 0])]
        if len(seen_again) < max(POINTS, len(points) / 2):
            continue
        middle = np.median(seen_again, axis=0)
        if np.percentile(np.hypot(*(seen_again - middle).T), 95) < STEADY:
            yield pair.number, middle.astype(np.float64)
