"""Direction of a region: its principal axis, if it has one."""

from __future__ import annotations

import math
import statistics
from typing import Final

import numpy as np

from tactflow.vision.arrays import Floats, Numbers
from tactflow.vision.compiled import kernel
from tactflow.vision.geometry.region import Contours, Moments

FALSE_DIRECTION_RATE: Final = 1e-3
"""Rate at which regions without a direction get one by chance. Chosen by hand."""
VERTICAL_TOLERANCE_DEG: Final = 6e-6
"""Angle to the vertical, degrees, within which an axis has no slope. Derived: 1e-7 rad, where rounding
decides the sign of the slope."""

_GRID_ANISOTROPY_VARIANCE: Final = 0.122
"""Variance of the anisotropy of a disc of radius R px on a pixel grid at random phase, along its stronger
component, times R^3. Derived in `anisotropy_limit`."""
_ROUGHNESS_HARMONICS: Final = range(3, 10)
"""Harmonics that measure the roughness of the outline; 0 to 2 are size, place and elongation. The end is
chosen by hand."""
_MAX_LINEAR_ANISOTROPY: Final = 0.6
"""Anisotropy up to which it is proportional to the second harmonic: axis ratio 2. Chosen by hand."""
_MIN_VARIANCE_PX2: Final = 1e-12
"""Smallest variance that is divided by, px^2: that across a line of pixels is 0."""
_MIN_RELATIVE_RADIUS: Final = 1e-9
"""Smallest distance of an outline point from the centre that is divided by, 1."""
_MIN_HARMONIC_POWER_RATIO: Final = math.sqrt(1.25 + math.sqrt(1 + 840 / FALSE_DIRECTION_RATE)) - 5.5
"""Power of a harmonic, over the median power of seven others, that chance exceeds at the rate
`FALSE_DIRECTION_RATE`. Derived in `anisotropy_limit`: the t at which the product equals that rate, since
(t + 4) (t + 5) (t + 6) (t + 7) is the square of (t + 5.5)^2 - 1.25, less 1."""


def axis_direction(theta: float) -> tuple[float, float | None]:
    """Angle and slope of an axis.

    theta : direction of the axis, radians, from +x towards +y (y down).
    Returns (angle, slope): degrees in (-90, 90], counter-clockwise on the screen, and dy/dx (y down); the
    slope is None where the axis is vertical.

    >>> axis_direction(0.0)
    (0.0, 0.0)
    >>> axis_direction(math.pi / 2)
    (90.0, None)
    """
    angle = -math.degrees(theta)
    angle = angle - 180 * math.floor((angle + 90) / 180)
    if angle <= -90.0:
        angle += 180.0
    slope = None if abs(abs(angle) - 90) < VERTICAL_TOLERANCE_DEG else math.tan(theta) + 0.0
    return angle + 0.0, slope


def anisotropy_limit(contours: Contours, moments: Moments, pixels: int, confidence: float) -> float:
    """Anisotropy that a region without a direction exceeds by chance at the rate `FALSE_DIRECTION_RATE`.

    contours, moments : of the region. pixels : their number. confidence : its anisotropy, 0 to 1.

    There are two causes, and the larger limit counts.

    (1) The pixel grid. For a disc of radius R at random phase, the sum of x^2 - y^2 over its pixels has the
    variance R^5 / (2 pi^2) times the sum of cos^2(2 phi_k) / |k|^3 over the reciprocal lattice, 5.94, and
    that of 2 x y the same with 3.08 (the argument of Kendall, 1948, for the number of lattice points in an
    oval). Relative to R^2 / 2 and the area, the anisotropy has variance 0.122 / R^3, and its length exceeds t
    with a probability of at most exp(-t^2 / (2 * 0.122 / R^3)).

    (2) The roughness of the outline, relative to the ellipse of the region's second moments. For noise
    shorter than the outline, the harmonics 2, 3, 4, ... have equal, exponentially distributed power, and an
    anisotropy c is 4 times the second harmonic. Their power is estimated by the median of harmonics 3 to 9,
    because a polygon has a few strong harmonics and is not rough. The probability that an exponential
    variable exceeds t times the median of seven others is the product of j / (j + t) for j = 4 ... 7.
    """
    radius = math.sqrt(pixels / math.pi)
    limit = math.sqrt(-2 * math.log(FALSE_DIRECTION_RATE) * _GRID_ANISOTROPY_VARIANCE / radius**3)
    if confidence > _MAX_LINEAR_ANISOTROPY or confidence <= limit:
        return limit
    power = _outline_power(contours, moments)
    # Of seven numbers, `np.median` takes a hundred times as long.
    rough = 4 * math.sqrt(_MIN_HARMONIC_POWER_RATIO * statistics.median(power.tolist()))
    return min(max(limit, rough), _MAX_LINEAR_ANISOTROPY)


def _outline_power(contours: Contours, moments: Moments) -> Floats:
    """Power of `_ROUGHNESS_HARMONICS` of the outlines, relative to the ellipse of the region's moments."""
    center_x, center_y, xx, xy, yy = moments
    # Whitening by the Cholesky factor: in these coordinates the ellipse of second moments is a circle.
    l11 = math.sqrt(xx)
    l21 = xy / l11
    l22 = math.sqrt(max(yy - l21 * l21, _MIN_VARIANCE_PX2))
    to_circle = np.array([center_x, center_y, l11, l21, l22])
    harmonics = np.zeros((len(_ROUGHNESS_HARMONICS), 2))
    for contour in contours:
        sum_harmonics(contour[:, 0], to_circle, _MIN_RELATIVE_RADIUS, _ROUGHNESS_HARMONICS.start, harmonics)
    return np.asarray((harmonics * harmonics).sum(axis=1))


@kernel
def sum_harmonics(outline: Numbers, to_circle: Floats, least: float, first: int, harmonics: Floats) -> None:
    """Add the Fourier coefficients of an outline's distance from its centre, relative to that of a circle.

    outline : (n, 2), pixels. to_circle : (5,), centre, and l11, l21 and l22 of the matrix whose inverse makes
    it a circle of radius 2. least : smallest distance that is divided by. first : number of the first
    harmonic. harmonics : (m, 2), real and imaginary parts, added to.
    """
    z = np.empty(len(outline), np.complex128)
    z.real = (outline[:, 0] - to_circle[0]) / to_circle[2]
    z.imag = (outline[:, 1] - to_circle[1] - to_circle[3] * z.real) / to_circle[4]
    distance = np.maximum(np.abs(z), least)
    turn = z / distance
    # Fraction of the full turn that each outline point stands for.
    fraction = np.imag(np.conj(np.roll(turn, 1)) * np.roll(turn, -1)) / (4 * math.pi)
    for power, harmonic in enumerate(harmonics, first):
        total = ((distance / 2 - 1) * fraction * turn**power).sum()
        harmonic += total.real, total.imag
