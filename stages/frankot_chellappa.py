"""Stage `frankot_chellappa`: indentation of the gel as a height map, integrated in the Fourier domain."""

from __future__ import annotations

import numpy as np
import scipy.fft

from tactflow.calibration.file import Calibration
from tactflow.engine.contract import Stage, StageParams
from tactflow.engine.frame import Absent
from tactflow.ports import ContactMask, Unmarked, Untouched
from tactflow.vision.depth.surface import Rest, colour_change, half_resolution, measured
from tactflow.vision.types import Depth, Scale


class FrankotChellappa(Stage):
    """Heights from the colour of the gel, as `depth` learns it, integrated over the whole picture at once.

    Use it as the usual method of photometric stereo. It assumes that the picture repeats beyond its borders,
    and takes every difference from the untouched gel for a slope: contacts at the border and uneven light
    tilt its surface. It states no standard errors.

        depth: {use: frankot_chellappa, when: touching}

    R. Frankot, R. Chellappa, "A method for enforcing integrability in shape from shading algorithms", PAMI 10
    (1988).

    >>> import tactflow
    >>> image, mask = np.zeros((60, 80, 3), np.uint8), np.full((60, 80), 255, np.uint8)
    >>> scale = Scale(0.1, 0.1, (0.0, 0.0), (0.0, 0.0))
    >>> tactflow.stage("frankot_chellappa").process(image, image, mask, scale)
    Absent(reason='no_calibration')
    """

    memory = "pure"

    def __init__(self, params: StageParams, calibration: Calibration | None = None) -> None:
        """Prepare. calibration : of the sensor."""
        super().__init__(params)
        self._known = calibration

    def process(
        self, unmarked: Unmarked, untouched: Untouched, contact_mask: ContactMask, scale: Scale
    ) -> Depth | Absent:
        """The height map of the contact."""
        known = self._known
        if known is None or known.slopes is None:
            return Absent("no_calibration")
        if not contact_mask.any():
            return Absent("no_contact")
        rest = self.once(Rest, untouched)
        everywhere = np.ones((rest.window.height, rest.window.width), np.uint8)
        change = colour_change(half_resolution(unmarked), rest, rest.window, np.ones(3, np.float32))
        height, width = contact_mask.shape
        model = self.once(known.at, scale, (width, height)).slopes if known.kind else known.slopes
        assert model is not None
        slope = model.slopes(change, rest.x, rest.y, everywhere)
        # A step is two pixels; slopes rise towards the camera, into which the gel is pushed.
        spectrum = scipy.fft.fft2(slope * np.float32(-2 * scale.x))
        y, x = (2j * np.pi * scipy.fft.fftfreq(side) for side in slope.shape[1:])
        power = np.add.outer(np.abs(y) ** 2, np.abs(x) ** 2)
        power[0, 0] = np.inf
        heights = np.asarray(-scipy.fft.ifft2((x * spectrum[0] + y[:, None] * spectrum[1]) / power).real)
        heights -= np.median(heights)
        low = np.maximum(heights, 0).astype(np.float32)
        return measured(low, rest.window, contact_mask, scale, None)
