"""The shape of a gel, up to a factor, from the change of its light.

Light from the side responds to slope: for a gel with surface z, the channels of the picture change by
A (dz/dx, dz/dy), where the three rows of A describe the directions of this sensor's lamps. A is unknown, but
slopes must be integrable (A. Yuille, D. Snow, "Shape and albedo from multiple images using integrability",
CVPR 1997). So the two mixtures of the channels that are closest to the slopes of a surface are the slopes, up
to a factor, and that surface is the gel's (R. Frankot, R. Chellappa, "A method for enforcing integrability in
shape from shading algorithms", PAMI 10, 1988).

If all channels change alike, as in a gray camera, one slope is seen at most, along the direction in which the
change is closest to the slope of a surface. It may be another one for each contact, as lamps stand all around
many gels. A flank in the shade darkens by more than a lit one brightens, though an object is as steep on both
sides; a quadratic response makes them equal. Nothing shows across the direction, so of all surfaces with that
slope the one that is flattest and nearest to rest is taken (ridge regression; A. Hoerl, R. Kennard,
Technometrics 12, 1970). If contacts brighten or darken as a whole, rather than brighten on one flank and
darken on the other, the light responds to depth, and the size of the change stands in for the height.

As long as no mixtures of different channels are nearly integrable, the size of the change stands in for the
height as well.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Final, NamedTuple

import cv2
import numpy as np
from scipy import linalg

from tactflow.vision.arrays import Floats, Floats32, Indices
from tactflow.vision.compiled import kernel

PADDING_SHARE: Final = 0.15
"""Padding with gel at rest at both ends of a side, as a fraction of it: the integrated surface is
periodic."""
MIN_WAVELENGTH_CELLS: Final = 4
"""Shortest wavelength, cells: cells are means over three by three."""
MAX_CURL_SHARE: Final = 0.2
"""Largest fraction of the slopes' power that an integrable pair may lack. A single slope of a round contact,
as seen in light from one side, lacks 0.25; sensors with lamps on several sides lack 0.00 to 0.15."""
UNSEEN_SLOPE_WEIGHT: Final = 0.2
"""Weight of the squared slopes of a surface against the squared errors of the one slope that is seen. With
0.05 to 0.5, outlines of gray pictures overlap equally well with real ones within 0.02."""
HEIGHT_WEIGHT: Final = 0.002
"""Weight of the squared heights, per cell^2, against the same errors: along what is not seen, the surface
returns to rest within 1 / sqrt(0.002) = 22 cells. With 0.001 to 0.03, outlines of gray pictures overlap
equally well with real ones within 0.03."""
MIN_MIXTURE_POWER: Final = 0.01
"""Minimum power of a mixture of channels, relative to the strongest one, to count as a slope: a tenth in
amplitude. Weaker ones are noise, in a faint contact that brightens as a whole."""
MIN_FLANK_RATIO: Final = 0.45
"""Minimum ratio of the largest brightening and darkening, the smaller one to the other, if both are flanks of
contacts: the halo of a contact that darkens as a whole has up to 0.4 of it. With 0.39 to 0.5, outlines of
gray pictures overlap equally well with real ones within 0.02."""
MIN_FRAME_POWER_SHARE: Final = 0.1
"""Minimum power of a frame to learn from, relative to the total so far: a sensor is known after ten such
frames. With 0.02 to 0.3, outlines overlap equally well with real ones within 0.01."""


class Heights(NamedTuple):
    """The shape of a gel.

    Attributes
    ----------
    values : (h, w) float32, height of each cell above the gel at rest, in an arbitrary unit, or the size of
        its change.
    mixtures : (k, 3) float32, weights of the channels: two are the slopes along x and y; one is the only
        change there is; three, the identity, if neither is known yet.
    slopes : (2, h, w) float32, along x and y, if they follow from the only change there is; or None.
    """

    values: Floats32
    mixtures: Floats32
    slopes: Floats32 | None = None

    @property
    def sloping(self) -> bool:
        """Whether slopes are known, so that the values are heights."""
        return len(self.mixtures) == 2 or self.slopes is not None


class HeightModel:
    """Learns how the light of a sensor responds to slopes, and integrates them.

    Attributes
    ----------
    alike : whether all channels have changed alike so far, as in a gray camera.

    Examples
    --------
    Red responds to slopes along x, blue to those along y:

    >>> y, x = np.mgrid[-16:16, -16:16] / 6
    >>> bump = np.exp(-(x**2 + y**2))
    >>> change = np.stack([y * bump, 0 * bump, x * bump]).astype(np.float32)
    >>> heights = HeightModel()(change)
    >>> bool(abs(np.corrcoef(heights.values.ravel(), bump.ravel())[0, 1]) > 0.99)
    True
    """

    def __init__(self) -> None:
        self._missing, self._power = np.zeros((6, 6)), np.zeros((3, 3))
        self.alike = False
        self._mixtures = np.eye(3, dtype=np.float32)
        self._before = np.zeros((2, 3), np.float32)

    def __call__(self, change: Floats32) -> Heights:
        """Shape of the gel, (h, w); change : (3, h, w) float32, in standard deviations, 0 where no gel is."""
        self._learn(change)
        if len(self._mixtures) == 3:
            size = cv2.magnitude(cv2.magnitude(change[0], change[1]), change[2])
            return Heights(np.asarray(size, np.float32), self._mixtures)
        high, wide = change.shape[1:]
        shown = (self._mixtures @ change.reshape(3, -1)).reshape(-1, high, wide)
        if len(shown) == 1:
            if not has_two_flanks(shown[0]):
                return Heights(np.abs(shown[0]), self._mixtures)
            surface, *slopes = _surface_of_one_slope(shown[0])
            return Heights(surface, self._mixtures, np.stack(slopes))
        down, across = _waves(high), _waves(wide)
        climbs = down.values @ shown[0] @ across.slopes.T + down.slopes @ shown[1] @ across.values.T
        climbs /= _squares(high, wide)
        return Heights(np.asarray(down.values.T @ climbs @ across.values, np.float32), self._mixtures)

    def _learn(self, change: Floats32) -> None:
        """Add a change to the statistics of power and integrability, unless it is too weak to matter."""
        flat = change.reshape(3, -1)
        if not cv2.norm(flat, cv2.NORM_L2SQR) > MIN_FRAME_POWER_SHARE * self._power.trace():
            return
        high, wide = change.shape[1:]
        down, across = _waves(high), _waves(wide)
        along_x = down.values @ change @ across.slopes.T
        along_y = down.slopes @ change @ across.values.T
        climbs = np.concatenate([along_x, along_y]) / np.sqrt(_squares(high, wide))
        both = np.asarray(climbs.reshape(6, -1), np.float64)
        power = np.asarray(flat @ flat.T, np.float64)
        self._power += power
        self._missing += _twice(power) - both @ both.T
        self._mixtures = self._showing()
        if len(self._mixtures) == 2:
            # The sign is arbitrary, so keep it.
            self._mixtures *= np.float32(1 if (self._mixtures * self._before).sum() >= 0 else -1)
            self._before = self._mixtures

    def _showing(self) -> Floats32:
        """Mixtures (k, 3) of the channels that show the shape, as in `Heights`."""
        powers, directions = np.linalg.eigh(self._power)
        basis = _twice(directions[:, powers >= MIN_MIXTURE_POWER * powers[-1]])
        self.alike = basis.shape[1] == 2
        if self.alike:
            return np.asarray(directions[:, -1:].T, np.float32)
        power = basis.T @ _twice(self._power) @ basis
        missing, found = linalg.eigh(basis.T @ self._missing @ basis, power)
        if missing[0] > MAX_CURL_SHARE:
            return np.eye(3, dtype=np.float32)
        slopes = np.asarray((basis @ found[:, 0]).reshape(2, 3), np.float32)
        return slopes / np.linalg.norm(slopes)


def _twice(block: Floats) -> Floats:
    """(2 m, 2 n), block diagonal, of a block (m, n): for slopes along x and y."""
    rows, columns = block.shape
    whole = np.zeros((2 * rows, 2 * columns))
    whole[:rows, :columns] = whole[rows:, columns:] = block
    return whole


class _Waves(NamedTuple):
    """Fourier basis along one padded side of the picture: cosines, then sines.

    Attributes
    ----------
    values : (k, n) float32, at each cell.
    slopes : (k, n) float32, their derivatives per cell.
    frequencies : (k,) float32, radians per cell, from 0. The squares of a wave sum up to 1 over the padded
        side.
    parity : (k,) float32, 1 for cosines and -1 for sines. partners : (k,), index of the sine of each cosine
        and the other way round; the constant's own.
    """

    values: Floats32
    slopes: Floats32
    frequencies: Floats32
    parity: Floats32
    partners: Indices


@lru_cache(maxsize=4)
def _waves(side: int) -> _Waves:
    """The basis for a side of this many cells."""
    margin = max(round(PADDING_SHARE * side), 1)
    length = side + 2 * margin
    frequencies = 2 * np.pi / length * np.arange(length // MIN_WAVELENGTH_CELLS + 1)[:, None]
    phases = frequencies * (margin + np.arange(side))
    cosines, sines = np.cos(phases), np.sin(phases)
    cosines[0] /= np.sqrt(2)
    values = np.concatenate([cosines, sines[1:]])
    slopes = np.concatenate([-frequencies * sines, (frequencies * cosines)[1:]])
    scale = np.sqrt(2 / length)
    return _Waves(
        np.asarray(scale * values, np.float32),
        np.asarray(scale * slopes, np.float32),
        np.asarray(np.concatenate([frequencies, frequencies[1:]])[:, 0], np.float32),
        np.where(np.arange(len(values)) < len(cosines), np.float32(1), np.float32(-1)),
        np.concatenate([[0], np.arange(len(cosines), len(values)), np.arange(1, len(cosines))]),
    )


@lru_cache(maxsize=4)
def _squares(high: int, wide: int) -> Floats32:
    """(k, l) float32: squared slopes of each wave, summed over the picture; infinite for the constant one."""
    squares = np.add.outer(_waves(high).frequencies ** 2, _waves(wide).frequencies ** 2)
    squares[0, 0] = np.inf
    return squares


def _surface_of_one_slope(change: Floats32) -> Floats32:
    """The surface of which a change (h, w) is the slope along one direction: (3, h, w), the surface and its
    slopes along x and y.

    The direction is the one in which most of the change is a slope. The highest place of the surface is
    farther from rest than the lowest.
    """
    darkest, brightest = smooth_range(change)
    # It stays monotonic, as the smaller one has more than sqrt(2) - 1 of the other.
    curvature = -(brightest + darkest) / (brightest**2 + darkest**2)
    change = change * (1 + np.float32(curvature) * change)
    high, wide = change.shape
    down, across = _waves(high), _waves(wide)
    climbs = np.stack([down.values @ change @ across.slopes.T, down.slopes @ change @ across.values.T])
    squares = _squares(high, wide)
    along = (climbs / np.sqrt(squares)).reshape(2, -1)
    toward = np.asarray(np.linalg.eigh(along @ along.T)[1][:, -1], np.float32)
    seen = np.add.outer(toward[1] ** 2 * down.frequencies**2, toward[0] ** 2 * across.frequencies**2)
    power = seen + np.float32(UNSEEN_SLOPE_WEIGHT) * squares + np.float32(HEIGHT_WEIGHT)
    power[0, 0] = 1
    # Along an oblique direction, cosines along both sides also show as sines along both.
    mixed = np.multiply.outer(down.parity * down.frequencies, across.parity * across.frequencies)
    mixed *= 2 * toward[0] * toward[1]
    shown = np.tensordot(toward, climbs, 1)
    partners = shown[down.partners[:, None], across.partners]
    waves = (power * shown + mixed * partners) / (power**2 - mixed**2)
    surface = np.stack(
        [
            down.values.T @ waves @ across.values,
            down.values.T @ waves @ across.slopes,
            down.slopes.T @ waves @ across.values,
        ]
    )
    return np.asarray(surface if surface[0].max() >= -surface[0].min() else -surface, np.float32)


def has_two_flanks(change: Floats32) -> bool:
    """Whether a change (h, w) is about as strong in both directions, as slopes are and depth is not; False
    without any change."""
    least, largest = smooth_range(change)
    return min(-least, largest) > MIN_FLANK_RATIO * max(-least, largest)


@kernel
def smooth_range(change: Floats32) -> tuple[float, float]:
    """The smallest and the largest mean over 3 x 3 values of a plane."""
    smooth = cv2.blur(change, (3, 3))
    return float(smooth.min()), float(smooth.max())
