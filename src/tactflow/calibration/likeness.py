"""Whether the default calibration of a kind of sensor holds for the pictures of one sensor.

The light at rest tells. The logarithm of each channel, less its mean, does not depend on exposure and white
balance, only on where the lamps are. A quadratic polynomial of the place describes it, and its linear terms
grow with the part of the gel that a picture shows, its quadratic ones with the square of that: so it also
gives the turn of a picture and its zoom. Left and right of a Mini are alike at rest; a mirrored picture is
found by its first contact instead (`Surface`).
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.calibration.file import LOOK, Calibration, small_picture
from tactflow.calibration.scale import scale_from_pitch
from tactflow.system.spelling import distinct
from tactflow.vision.arrays import Floats
from tactflow.vision.geometry import PixelMapping
from tactflow.vision.types import Scale

LIGHT_FLOOR: Final = 20.0
"""Grey levels added before the logarithm, so that the noise of a dark channel does not count."""
LARGEST_MISFIT: Final = 0.09
"""RMS difference of the logarithms above which the light is that of another kind of sensor. Minis of five
labs have 0.04 to 0.07, nine other kinds of sensor 0.18 to 0.6."""
LEAST_ZOOM: Final = 0.45
"""Zoom below which nothing is recognised: the light of a small part of the gel is as even as that of many
sensors."""
LARGEST_ZOOM: Final = 1.25
"""Factor, or its inverse, between the zoom of a picture and that of the calibration, above which it is not
used: by the light, five Minis have 0.9 to 1.0, and pictures cropped to one half 0.55 to 0.67."""
LARGEST_DISAGREEMENT: Final = 1.4
"""The same between the zoom by the pitch of the dots and that by the light, which errs by up to 1.25."""
PITCH_ERROR: Final = 0.03
"""Relative standard error of the pitch of a kind's dots: on one gel it differs by 3.5 % between x and y."""
LARGEST_BORDER_STEP: Final = 0.1
"""Step of the logarithm of a channel near a border of the picture, over 1 / 50 of its side, above which it
shows the housing around the gel. Minis of five labs have 0.04 to 0.06, one with its housing 0.15; where dots
were removed, up to 0.15, so that there the dots tell."""
WIDEST_WITH_DOTS: Final = 1.1
"""Zoom by the pitch of the dots up to which a picture shows no housing: that begins beyond 1.2."""
BORDER: Final = 1 / 8
"""Part of the picture along each side in which the housing may show."""
ZOOMS: Final = np.exp(np.arange(-1.2, 0.55, 0.05))
"""Zooms that are tried: 0.3 to 1.6 in steps of 5 %."""
CROPS: Final = (0.9, 0.85, 0.8, 0.75, 0.7)
"""Central parts of a picture that are tried where it may show the housing around the gel."""


class Match(NamedTuple):
    """How the light at rest of a picture compares with that of a calibration.

    Attributes
    ----------
    misfit : RMS difference of the logarithms.
    zoom : side of the part of the gel that the picture shows, over that of the calibration.
    """

    misfit: float
    zoom: float

    @property
    def fits(self) -> bool:
        """Whether the light is that of the kind, at any zoom."""
        return self.misfit <= LARGEST_MISFIT and self.zoom >= LEAST_ZOOM


class Placement(NamedTuple):
    """How a calibration applies to pictures.

    Attributes
    ----------
    scale : of the pictures; None where the calibration must not be used.
    words : why not, and what to do; or how the scale was found.
    """

    scale: Scale | None
    words: str


def match_light(look: NDArray[np.float32], untouched: NDArray[np.uint8]) -> Match:
    """Compare the untouched gel without markers, (H, W, 3) uint8, with a `look` (12, 16, 3) of the same
    orientation.

    >>> ramp = np.tile(np.linspace(60, 120, 160, dtype=np.uint8)[:, None], (120, 1, 3))
    >>> match_light(small_picture(ramp), ramp).fits
    True
    >>> match_light(small_picture(ramp), np.ascontiguousarray(ramp[:, ::-1])).fits
    False
    """
    light = _log_light(small_picture(untouched))
    terms = _place_terms()
    kind = np.linalg.lstsq(terms, _log_light(look), rcond=None)[0]
    linear, quadratic = (
        part - part.mean(axis=0) for part in (terms[:, 1:3] @ kind[1:3], terms[:, 3:] @ kind[3:])
    )
    zooms = ZOOMS[:, None, None]
    misfits = np.sqrt(np.mean((light - zooms * linear - zooms**2 * quadratic) ** 2, axis=(1, 2)))
    best = int(np.argmin(misfits))
    # The light of some kinds is no quadratic polynomial.
    as_it_is = float(np.sqrt(np.mean((light - _log_light(look)) ** 2)))
    if as_it_is <= misfits[best]:
        return Match(as_it_is, 1.0)
    return Match(float(misfits[best]), float(ZOOMS[best]))


def place(
    calibration: Calibration,
    untouched: NDArray[np.uint8],
    mapping: PixelMapping,
    dots: Floats | None = None,
) -> Placement:
    """Compare the default of a kind with the pictures of a sensor, before it is used.

    untouched : (H, W, 3) uint8, the gel without markers. dots : (N, 2), px, its markers; None without.
    """
    misfit = calibration.misfit(mapping)
    if misfit is not None:
        return Placement(None, misfit)
    match = match_light(calibration.look, untouched)
    usual = calibration.scale_at(mapping.size)
    by_dots = None if dots is None else _scale_by_dots(calibration, dots, mapping.size)
    # Where dots were removed, a border is not smooth; but dots that are far apart show that it is the gel.
    is_inner = by_dots is not None and by_dots.x <= WIDEST_WITH_DOTS * usual.x
    if not match.fits or (not is_inner and border_step(untouched) > LARGEST_BORDER_STEP):
        return Placement(None, _difference(calibration, untouched, mapping, match))
    if by_dots is not None:
        return _placement_by_dots(usual, by_dots, match)
    return _placement_by_light(usual, match)


def _scale_by_dots(calibration: Calibration, dots: Floats, size: tuple[int, int]) -> Scale | None:
    """The scale by the pitch of the kind's dots; None where there are too few, or in no grid."""
    if calibration.dot_pitch is None:
        return None
    try:
        return scale_from_pitch(dots, calibration.dot_pitch, size)
    except ValueError:
        return None


def _placement_by_light(usual: Scale, match: Match) -> Placement:
    """The usual scale, unless the light says that the picture shows another part of the gel."""
    if max(match.zoom, 1 / match.zoom) <= LARGEST_ZOOM:
        return Placement(usual, "")
    return Placement(
        None,
        f"by the light at rest, the picture shows about {match.zoom:.1f} times the width of its gel: it is "
        "cropped or zoomed, or of another sensor. Show the whole sensing area (stages.preprocess.crop), or "
        "calibrate this picture: `tactflow calibrate --area WIDTH HEIGHT --ball-radius MM`",
    )


def _placement_by_dots(usual: Scale, by_dots: Scale, match: Match) -> Placement:
    """The scale by the pitch of the dots, along both axes in the proportion that the kind has."""
    across, down = by_dots.x / usual.x, by_dots.y / usual.y
    zoom = math.sqrt(across * down)
    if zoom > LARGEST_ZOOM or max(zoom / match.zoom, match.zoom / zoom) > LARGEST_DISAGREEMENT:
        return Placement(
            None,
            f"by its dots the picture shows {zoom:.2f} times the width of its gel, by the light at rest "
            f"{match.zoom:.2f} times: another gel, or another sensor; calibrate it: `tactflow calibrate "
            "--pitch MM --ball-radius MM`",
        )
    error = math.hypot(PITCH_ERROR, abs(math.log(across / down)) / 2)
    scale = Scale(
        usual.x * zoom, usual.y * zoom, (error * usual.x * zoom, error * usual.y * zoom), usual.origin
    )
    return Placement(scale, f"scale by the pitch of the dots, {zoom:.2f} times the usual one")


def _difference(
    calibration: Calibration, untouched: NDArray[np.uint8], mapping: PixelMapping, match: Match
) -> str:
    """Why the light does not fit: a turned picture, the housing around the gel, or another sensor."""
    for quarters in () if match.fits else (2, 1, 3):
        if match_light(calibration.look, np.rot90(untouched, quarters)).fits:
            return (
                f"by the light at rest, the picture is turned by {90 * quarters} degrees clockwise, or "
                f"mirrored upside down: add {360 - 90 * quarters} to stages.preprocess.rotate"
            )
    cut = _crop_to_gel(calibration, untouched, mapping)
    if cut is not None:
        return (
            "the picture shows the housing around the gel; crop it to the sensing area, such as "
            f"stages.preprocess.crop={cut}"
        )
    if match.fits:
        return (
            f"near its border the light changes by {100 * border_step(untouched):.0f} % in a step: the "
            "picture shows the housing around the gel, or something touches it; see stages.preprocess.crop"
        )
    measured, limit = distinct(100 * match.misfit, 100 * LARGEST_MISFIT)
    return (
        f"the light of the untouched gel differs from that of one by {measured} % ({limit} % at most): "
        "another sensor, or something touches it"
    )


def _crop_to_gel(
    calibration: Calibration, untouched: NDArray[np.uint8], mapping: PixelMapping
) -> list[int] | None:
    """[x, y, width, height], raw px, of the central part whose light is that of the calibration at its zoom;
    None if there is none."""
    height, width = untouched.shape[:2]
    wide, high = mapping.raw_size
    least, crop = LARGEST_MISFIT, None
    for share in CROPS:
        margin = (1 - share) / 2
        x, y = round(width * margin), round(height * margin)
        part = untouched[y : height - y, x : width - x]
        match = match_light(calibration.look, part)
        zoomed = max(match.zoom, 1 / match.zoom) > LARGEST_ZOOM
        if zoomed or match.misfit >= least or border_step(part) > LARGEST_BORDER_STEP:
            continue
        least = match.misfit
        crop = [round(side) for side in (wide * margin, high * margin, wide * share, high * share)]
    return crop


def border_step(untouched: NDArray[np.uint8]) -> float:
    """Largest step of the logarithm of a channel near the border of a picture (H, W, 3) uint8.

    >>> gel = np.full((120, 160, 3), 100, np.uint8)
    >>> gel[:, :10] = 150
    >>> border_step(gel) > 0.3 > border_step(gel[:, 20:])
    True
    """
    height, width = untouched.shape[:2]
    smooth = cv2.GaussianBlur(untouched, (0, 0), 1).astype(np.float32) + LIGHT_FLOOR
    steps = []
    for lines in (
        smooth[height // 4 : height - height // 4].mean(axis=0),
        smooth[:, width // 4 : width - width // 4].mean(axis=1),
    ):
        light, apart = np.log(lines), max(1, len(lines) // 50)
        step = np.abs(light[apart:] - light[:-apart]).max(axis=1)
        edge = max(1, round(len(step) * BORDER))
        steps += [step[:edge].max(), step[-edge:].max()]
    return float(max(steps))


def _log_light(look: NDArray[np.floating]) -> Floats:
    """(192, 3): logarithms of a small picture (12, 16, 3), less the mean of each channel."""
    light = np.log(look.reshape(-1, 3).astype(np.float64) + LIGHT_FLOOR)
    return np.asarray(light - light.mean(axis=0))


def _place_terms() -> Floats:
    """(192, 6): 1, x, y, x^2, x y, y^2 of the cells of a small picture, -1 to 1 across it."""
    columns, rows = LOOK
    across, down = ((np.arange(n) + 0.5) * 2 / n - 1 for n in (columns, rows))
    x, y = (part.ravel() for part in np.meshgrid(across, down))
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
