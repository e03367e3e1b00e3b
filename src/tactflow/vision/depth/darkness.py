"""The height map of a gel that is darker the deeper it is pressed.

A translucent layer over a dark one reflects less light where it is thinner, so that on a gel in white light
the depth of a pixel is a monotone function of its darkening. Unlike slopes, it needs no integration.

References
----------
C. Lin, H. Zhang, J. Xu, L. Wu, H. Xu, "9DTact: A Compact Vision-Based Tactile Sensor for Accurate 3D Shape
Reconstruction and Generalizable 6D Force Estimation", RA-L 2024.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.arrays import Bytes, Floats, Floats32
from tactflow.vision.depth.surface import Rest, colour_change, half_resolution, measured
from tactflow.vision.depth.surroundings import surroundings
from tactflow.vision.types import Depth, Scale

TABLE_ENTRIES: Final = 512
"""Entries of the table of a curve; linear between them, which is off by 3e-5 of the depth on simulated
gels."""


class DarknessModel:
    """Depth of the gel from its darkening, relative to the light at rest.

    Monotone cubic interpolation (PCHIP) through 0 and the given points; beyond the last one, the depth stays.

    Raises ValueError on other points.

    Parameters
    ----------
    darkening : (n,), > 0, increasing.
    depth : (n,), mm, > 0, increasing.

    Examples
    --------
    >>> DarknessModel([0.2, 0.4], [0.5, 1.0])(np.array([-0.1, 0.0, 0.2, 0.3, 0.9])).round(3).tolist()
    [0.0, 0.0, 0.5, 0.75, 1.0]
    """

    def __init__(self, darkening: NDArray[np.floating] | list[float], depth: Floats | list[float]) -> None:
        x, y = (np.concatenate([[0.0], np.asarray(part, np.float64)]) for part in (darkening, depth))
        increasing = x.size == y.size > 1 and bool((np.diff(x) > 0).all() and (np.diff(y) > 0).all())
        if not increasing or not np.isfinite([x, y]).all():
            raise ValueError("darkness: required increasing darkening and depth above 0, as many of each")
        # Only here, as SciPy takes a while to load.
        from scipy.interpolate import PchipInterpolator

        self._darkening = np.linspace(0, x[-1], TABLE_ENTRIES)
        self._depth = PchipInterpolator(x, y)(self._darkening)

    @property
    def deepest(self) -> float:
        """Depth that no darkening exceeds, mm."""
        return float(self._depth[-1])

    def __call__(self, darkening: NDArray[np.floating]) -> Floats32:
        """Depth, mm, of pixels (...); 0 where they became brighter."""
        return np.asarray(np.interp(darkening, self._darkening, self._depth), np.float32)


class DarkSurface:
    """Height maps of a gel by its darkening; takes the place of `Surface`.

    Parameters
    ----------
    model : of the depth.
    scale : mm per px of the processed frame.
    stderr : of the depth of a pixel, mm; None where it is not known. A contact that is at least as deep as
        the deepest press has no standard errors.
    thickness : of the gel, mm, as in `Surface`.
    """

    def __init__(
        self,
        model: DarknessModel,
        scale: Scale,
        stderr: float | None = None,
        thickness: float | None = None,
    ) -> None:
        self._model = model
        self._scale = scale
        self._stderr = stderr
        self._thickness = thickness

    def depth(self, image: Bytes, rest: Rest, mask: Bytes) -> Depth:
        """The height map of a frame, of the contact and its surroundings, see `Surface.depth`."""
        half = half_resolution(image)
        at_rest = rest.around(half, mask)
        window = surroundings(mask, rest.window, at_rest.margin).window
        low = self._model(-colour_change(half, rest, window, at_rest.gain).mean(axis=2))
        greatest, relative_error = float(low.max()), None
        # Errors of the curve are common to all pixels.
        if self._stderr is not None and 0 < greatest < self._model.deepest:
            relative_error = self._stderr / greatest
        return measured(low, window, mask, self._scale, relative_error, self._thickness)
