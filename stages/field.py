"""Stage `field`: displacement of the gel between its markers."""

from __future__ import annotations

from typing import NamedTuple

from tactflow.engine.contract import Stage
from tactflow.engine.frame import Absent
from tactflow.ports import Image
from tactflow.vision.flow.displacement_field import MIN_MARKERS, DisplacementField, FieldModel
from tactflow.vision.types import Markers


class FieldPorts(NamedTuple):
    """Motion of the gel.

    Attributes
    ----------
    field : displacement on a regular grid.
    """

    field: DisplacementField | None


class Field(Stage):
    """Displacement field of the gel from the displacements of its markers, with standard errors.

    >>> import numpy as np
    >>> import tactflow
    >>> origin = np.mgrid[10:90:20, 10:90:20].reshape(2, -1).T.astype(float)
    >>> markers = Markers(origin, origin + [1.0, 0.5], np.zeros(16, np.uint8), np.full(16, 0.02))
    >>> field = tactflow.stage("field").process(markers, np.zeros((90, 90, 3), np.uint8)).field
    >>> field.displacement[8, 8].round(2).tolist()
    [0.97, 0.49]
    """

    memory = "pure"

    def process(self, markers: Markers, image: Image) -> FieldPorts | Absent:
        """The field of this frame; absent where fewer than three markers are seen."""
        if len(markers.origin) < MIN_MARKERS:
            return Absent("no_markers")
        model = self.once(FieldModel, markers.origin, (image.shape[1], image.shape[0]))
        field = model(markers)
        return Absent("no_markers") if field is None else FieldPorts(field)
