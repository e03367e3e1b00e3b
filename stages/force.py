"""Stage `force`: normal and shear force on the gel, N."""

from __future__ import annotations

import logging
import math

from tactflow.calibration.file import UNLIKE, Calibration
from tactflow.engine.contract import Stage, StageParams
from tactflow.engine.frame import Absent
from tactflow.ports import Unmarked, Untouched
from tactflow.vision.arrays import Floats
from tactflow.vision.field_force import displacement
from tactflow.vision.flow.displacement_field import MIN_MARKERS, FieldModel
from tactflow.vision.force import LightChange, Seen, seen, seen_without_contact, widened
from tactflow.vision.types import Contact, Depth, Flow, Markers, Scale
from tactflow.vision.types import Force as ForceOnGel

logger = logging.getLogger("tactflow")


class Force(Stage):
    """Force in N, by the force part of the sensor's calibration; nothing without it.

    Where the calibration measures the press by the displacement of the dots, every frame has a force. Else it
    is that of a contact. A calibration with neither heights nor dots measures the change of the light of the
    whole gel. Where that is larger than it is ever at rest, it is a force, though no contact is found: a soft
    object that covers all of the gel has no outline. A contact or a force larger than those that the
    calibration was fitted to is a warning, once. Where the gel at rest has another light than in the
    calibration, or known loads have shown another force since (`tactflow calibrate check --weights`), the
    standard errors are wider by this difference.

    >>> import numpy as np
    >>> import tactflow
    >>> image, hull = np.zeros((60, 80, 3), np.uint8), np.zeros((0, 2))
    >>> contact = Contact(50.0, (13.0, 13.0), None, None, hull, None)
    >>> scale = Scale(0.1, 0.1, (0.0, 0.0), (0.0, 0.0))
    >>> tactflow.stage("force").process(contact, scale, image, image)
    Absent(reason='no_calibration')
    """

    memory = "pure"

    def __init__(self, params: StageParams, calibration: Calibration | None = None) -> None:
        """Prepare. calibration : of the sensor."""
        super().__init__(params)
        self._calibration = calibration
        self._entry = None if calibration is None else calibration.force
        field = None if calibration is None else calibration.field_force
        self._model = None if self._entry is None else self._entry.model(field)
        self._warned = False

    def process(
        self,
        contact: Contact | None,
        scale: Scale,
        unmarked: Unmarked,
        untouched: Untouched,
        depth: Depth | None = None,
        flow: Flow | None = None,
        markers: Markers | None = None,
    ) -> ForceOnGel | Absent:
        """The force of this frame's contact, or of the gel as a whole."""
        if self._model is None or self._entry is None:
            return Absent("no_calibration")
        moved = None if markers is None else self._displacement(markers, scale, unmarked)
        if self._model.press is None and moved is None:
            return Absent("no_markers")
        features = self._features(contact, scale, unmarked, untouched, depth, flow)
        if isinstance(features, Absent):
            return features
        force = widened(self._model.force(features, moved), self._drift(untouched))
        if not force.in_range and not self._warned:
            self._warned = True
            logger.warning(
                "force: %.2f N is of a larger contact, or one with more shear, than those the calibration "
                "was fitted to (%.2f to %.2f N); its standard error does not hold (said once)",
                force.value[2],
                *self._entry.pressing.range,
            )
        return force

    def _drift(self, untouched: Untouched) -> float:
        """Relative difference of the gel today from that of the calibration, beyond what is usual."""
        if self._calibration is None or self._entry is None:
            return 0.0
        unlike = self.once(self._calibration.unlikeness, untouched)
        return math.hypot(self._entry.drift, unlike if unlike > UNLIKE else 0.0)

    def _displacement(self, markers: Markers, scale: Scale, image: Unmarked) -> Floats | None:
        """(S, 2), mm, see `field_force`; None where it is unknown or not needed."""
        if self._model is None or self._model.dots is None or len(markers.origin) < MIN_MARKERS:
            return None
        size = (image.shape[1], image.shape[0])
        return displacement(self.once(FieldModel, markers.origin, size), markers, scale, size)

    def _features(
        self,
        contact: Contact | None,
        scale: Scale,
        unmarked: Unmarked,
        untouched: Untouched,
        depth: Depth | None,
        flow: Flow | None,
    ) -> Seen | Absent:
        """What light and heights show of the contact, or of the gel as a whole."""
        model = self._model
        if model is None or model.press is None:
            return Seen({}, {}) if contact is None else seen(contact, scale, None, 0.0, flow)
        if contact is None and (model.needs_depth or model.least_change is None):
            return Absent("no_contact")
        change = 0.0
        if model.needs_depth:
            if depth is None:
                return Absent("no_depth")
        else:
            light_change = self.once(LightChange, untouched)
            change = scale.area(light_change(unmarked)) - model.change_at_rest
        if contact is not None:
            return seen(contact, scale, depth, change, flow)
        if model.least_change is not None and change > model.least_change:
            return seen_without_contact(change)
        return Absent("no_contact")
