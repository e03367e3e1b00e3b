"""The original script as stages that replace the built-in ones in `pipelines/classic.yaml`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from tactflow.classic.functions import difference, get_convex_hull_area, mask_marker, mean_flow
from tactflow.classic.tracker import GridTracker
from tactflow.engine.contract import Stage, StageParams
from tactflow.engine.frame import Absent, Frame
from tactflow.ports import ContactMask, Image, MarkerMask, Touching, Unmarked
from tactflow.vision.types import Contact, Flow, Markers


class MaskMarker(Stage):
    """Mask of dark marker dots, by the script's `mask_marker`."""

    memory = "pure"

    def process(self, image: Image) -> MarkerMask:
        """255 where a marker covers the gel."""
        return mask_marker(image)


class ContactPorts(NamedTuple):
    """contact_mask : 255 in contact. touching : whether any pixel is."""

    contact_mask: ContactMask
    touching: Touching


class Difference(Stage):
    """Contact where the gel is brighter than in the last reference frame, by the script's `difference`."""

    memory = "stateful"

    def __init__(self, params: StageParams) -> None:
        super().__init__(params)
        self.reset()

    def reset(self) -> None:
        """Forget the reference."""
        self._reference: NDArray[np.uint8] | None = None

    def process(self, unmarked: Unmarked, frame: Frame) -> ContactPorts:
        """Compare with the last reference, or with the first frame if none is marked as a reference."""
        if frame.reference or self._reference is None:
            self._reference = unmarked.copy()
        mask = difference(unmarked, self._reference)
        return ContactPorts(mask, bool(mask.any()))


class ConvexHull(Stage):
    """Hull, line and ellipse of the contact, by the script's `get_convex_hull_area`."""

    memory = "pure"

    def process(self, contact_mask: ContactMask) -> Contact | Absent:
        """Geometry of the contact, or Absent("no_contact") for an empty mask."""
        contact = get_convex_hull_area(contact_mask)
        return Absent("no_contact") if contact is None else contact


class Tracker(Stage):
    """Tracks the markers of the first frame by the script's `marker_center` and its search `m`."""

    memory = "stateful"

    def __init__(self, params: StageParams) -> None:
        super().__init__(params)
        self.reset()

    def reset(self) -> None:
        """Forget the grid; the next frame defines it."""
        self._tracker: GridTracker | None = None

    def process(self, image: Image) -> Markers:
        """Position and status of every marker of the first frame."""
        if self._tracker is None:
            self._tracker = GridTracker(image)
        return self._tracker.track(image)


class FlowMask(Stage):
    """Mean displacement of the markers inside the contact, as in the script's `draw_flow_mask`."""

    memory = "pure"

    class Params(StageParams):
        """Margin around the contact."""

        dilate: int = Field(8, ge=0, le=1000, description="pixels by which a square dilates the contact")

    def process(self, markers: Markers, contact_mask: ContactMask) -> Flow:
        """The flow inside the contact; its mean is None where no marker is inside."""
        return mean_flow(markers, contact_mask, self.params.dilate)
