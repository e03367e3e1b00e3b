"""Stage `depth`: how far the gel is pushed in, as a height map in mm."""

from __future__ import annotations

from pathlib import Path

from tactflow.calibration.file import Calibration
from tactflow.engine.contract import Stage, StageParams
from tactflow.engine.frame import Absent
from tactflow.ports import ContactMask, Gradients, Unmarked, Untouched
from tactflow.vision.depth.darkness import DarkSurface
from tactflow.vision.depth.surface import Rest, Surface
from tactflow.vision.types import Depth as HeightMap
from tactflow.vision.types import Scale


class Depth(Stage):
    """Heights from the colour of the gel, or from its darkening, by the sensor's calibration, or from the
    gradients of a network.

    Absent without a calibration, or with one that knows the scale alone and no network.
    """

    memory = "pure"

    def __init__(self, params: StageParams, calibration: Path | None = None) -> None:
        """Prepare. calibration : the file."""
        super().__init__(params)
        self._known = None if calibration is None else Calibration.load(calibration)
        self._surface: tuple[Scale, bool, Surface | DarkSurface] | None = None
        self._rest: tuple[Untouched, Rest] | None = None

    def process(
        self,
        unmarked: Unmarked,
        untouched: Untouched,
        contact_mask: ContactMask,
        scale: Scale,
        gradients: Gradients | None = None,
    ) -> HeightMap | Absent:
        """The height map of the contact."""
        known = self._known
        if known is None or (gradients is None and known.slopes is None and known.darkness is None):
            return Absent("no_calibration")
        if not contact_mask.any():
            return Absent("no_contact")
        if self._rest is None or self._rest[0] is not untouched:
            self._rest = untouched, Rest(untouched)
        given = gradients is not None
        if self._surface is None or self._surface[0] is not scale or self._surface[1] != given:
            self._surface = scale, given, _surface_of(known, scale, given)
        surface = self._surface[2]
        if isinstance(surface, Surface):
            return surface.depth(unmarked, self._rest[1], contact_mask, gradients)
        return surface.depth(unmarked, self._rest[1], contact_mask)


def _surface_of(known: Calibration, scale: Scale, by_network: bool) -> Surface | DarkSurface:
    """What makes the height maps of a calibration. by_network : whether slopes are given."""
    if known.darkness is not None and not by_network:
        return DarkSurface(known.darkness.model(), scale, known.darkness.stderr)
    photometric = known.photometric
    return Surface(known.slopes, scale, None if photometric is None else photometric.errors())
