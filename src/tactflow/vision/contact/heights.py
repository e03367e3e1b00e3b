"""The shape of a gel, up to a factor, from how its light has changed.

Light from the side answers with slope: of a gel whose surface is z, the channels of the picture change by
A (dz/dx, dz/dy), where the three rows of A say how the lamps of this sensor stand. Nobody tells A, but slopes
are those of a surface: they can be integrated (A. Yuille, D. Snow, "Shape and albedo from multiple images
using integrability", CVPR 1997). So the two mixtures of the channels that differ least from the slopes of any
surface are the slopes, up to a factor, and that surface is the gel's (R. Frankot, R. Chellappa, "A method for
enforcing integrability in shape from shading algorithms", PAMI 10, 1988).

Where no mixtures are nearly integrable, the light answers otherwise: with depth, which brightens or darkens
the contact as a whole, or to slopes of one direction. Then the size of the change stands for the shape.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import fft, linalg

from tactflow.vision.arrays import Floats32

MARGIN: Final = 0.15
"""Part of the longer side of the picture by which it is extended with gel at rest on all sides: the surface
that is integrated has to return to where it was."""
INTEGRABLE: Final = 0.2
"""Part of the slopes' power that may be missing in those of a surface. One slope of a round contact, which is
what light from one side shows, misses 0.25 with nothing beside it; sensors with lamps on several sides miss
0.00 to 0.15."""
WEAKEST: Final = 0.01
"""Power of a mixture of channels, relative to the strongest one, from which on it tells of a slope: a tenth
in size. Below is noise, in a faint contact that brightens as a whole."""


class Heights(NamedTuple):
    """The shape of a gel.

    values : (h, w) float32, height of each cell above the gel at rest, in some unit, or how much it has
    changed. slopes : (2, 3) float32, mixtures of the channels that are slopes along x and y; None where no
    mixtures are.
    """

    values: Floats32
    slopes: Floats32 | None


class HeightModel:
    """Learns how the light of a sensor answers to slopes, and integrates them.

    Examples
    --------
    Red answers to slopes along x, blue to those along y:

    >>> y, x = np.mgrid[-16:16, -16:16] / 6
    >>> bump = np.exp(-(x**2 + y**2))
    >>> change = np.stack([y * bump, 0 * bump, x * bump]).astype(np.float32)
    >>> heights = HeightModel()(change)
    >>> bool(abs(np.corrcoef(heights.values.ravel(), bump.ravel())[0, 1]) > 0.99)
    True
    """

    def __init__(self) -> None:
        self._missing, self._power = np.zeros((6, 6)), np.zeros((3, 3))
        self._mixtures = np.zeros((2, 3), np.float32)

    def __call__(self, change: Floats32) -> Heights:
        """Shape of the gel, (h, w); change : (3, h, w) float32, in standard deviations, 0 where no gel is."""
        high, wide = change.shape[1:]
        margin = max(round(MARGIN * max(high, wide)), 1)
        size = tuple(fft.next_fast_len(side + 2 * margin, real=True) for side in (high, wide))
        spectrum = np.asarray(fft.rfft2(change, size), np.complex64)
        down = np.asarray(fft.fftfreq(size[0])[:, None], np.float32)
        across = np.asarray(fft.rfftfreq(size[1])[None], np.float32)
        self._learn(spectrum, across, down)
        mixtures = self._slopes()
        if mixtures is None:
            return Heights(np.sqrt(np.square(change).sum(axis=0)), None)
        slopes = np.tensordot(mixtures, spectrum, 1)
        square = across**2 + down**2
        square[0, 0] = 1
        surface = -1j * (across * slopes[0] + down * slopes[1]) / square
        extended = fft.irfft2(surface, size)
        rest = np.median(np.concatenate([extended[high:].ravel(), extended[:high, wide:].ravel()]))
        return Heights(np.asarray(extended[:high, :wide] - rest, np.float32), mixtures)

    def _learn(self, spectrum: NDArray[np.complex64], across: Floats32, down: Floats32) -> None:
        """Add the power of a change, and what of it would be missing in a surface.

        Of slopes (p, q) at the frequency (u, v), (v p - u q) / |(u, v)| is no slope of a surface, nor is
        their mean.
        """
        weight = np.full(spectrum.shape[1:], np.sqrt(2), np.float32)
        weight[:, 0] = 1
        weighed = spectrum * weight
        length = np.maximum(np.hypot(across, down), 1e-9)
        curl = np.concatenate([weighed * (-down / length), weighed * (across / length)]).reshape(6, -1)
        flat, mean = weighed.reshape(3, -1), spectrum[:, 0, 0].real.astype(np.float64)
        self._power += (flat @ flat.conj().T).real
        self._missing += (curl @ curl.conj().T).real
        self._missing[:3, :3] += np.outer(mean, mean)
        self._missing[3:, 3:] += np.outer(mean, mean)

    def _slopes(self) -> Floats32 | None:
        """Mixtures (2, 3) of the channels that are slopes along x and y; None where none are of a surface."""
        powers, directions = np.linalg.eigh(self._power)
        directions = directions[:, powers >= WEAKEST * powers[-1]]
        if directions.shape[1] < 2 or not powers[-1] > 0:
            return None
        basis = linalg.block_diag(directions, directions)
        power = linalg.block_diag(self._power, self._power)
        missing, found = linalg.eigh(basis.T @ self._missing @ basis, basis.T @ power @ basis)
        if missing[0] > INTEGRABLE:
            return None
        mixtures = np.asarray((basis @ found[:, 0]).reshape(2, 3), np.float32)
        mixtures /= np.linalg.norm(mixtures)
        # Up to the sign, which stays as it was.
        self._mixtures = mixtures if (mixtures * self._mixtures).sum() >= 0 else -mixtures
        return self._mixtures
