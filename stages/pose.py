"""Stage `pose`: motion of the object since it touched the gel."""

from __future__ import annotations

from tactflow.engine.contract import Stage, StageParams
from tactflow.engine.frame import Absent, Frame
from tactflow.ports import ContactMask, Slipping, Touching
from tactflow.vision.flow.displacement_field import DisplacementField
from tactflow.vision.pose.tracker import PoseTracker
from tactflow.vision.types import Depth, Scale
from tactflow.vision.types import Pose as ObjectPose


class Pose(Stage):
    """Translation and rotation of the object, with a covariance, from normals and heights of its contact.

    It needs the stage `depth` above and its calibration. The stage `field` adds how the gel below the object
    has moved, which tells how smooth objects turn; the stage `slip` tells when the gel does not follow. Two
    objects at once are tracked as one. This stage needs no gate: it returns at once without a contact.

    >>> import numpy as np
    >>> import tactflow
    >>> frame = Frame("main", 0, 0.0, np.zeros((60, 80, 3), np.uint8))
    >>> mask = np.zeros((60, 80), np.uint8)
    >>> tactflow.stage("pose").process(frame=frame, touching=False, contact_mask=mask)
    Absent(reason='no_contact')
    """

    memory = "stateful"

    def __init__(self, params: StageParams) -> None:
        super().__init__(params)
        self._tracker: tuple[Scale, PoseTracker] | None = None

    def reset(self) -> None:
        """A new reference follows: displacements of the gel are measured anew."""
        self._tracker = None

    def process(
        self,
        frame: Frame,
        touching: Touching,
        contact_mask: ContactMask,
        scale: Scale | None = None,
        depth: Depth | None = None,
        field: DisplacementField | None = None,
        slipping: Slipping | None = None,
    ) -> ObjectPose | Absent:
        """The pose of this frame's contact; absent without one, and where it is too small to tell."""
        if not touching:
            self.reset()
            return Absent("no_contact")
        if scale is None or depth is None:
            return Absent("no_calibration")
        if self._tracker is None or self._tracker[0] is not scale:
            self._tracker = scale, PoseTracker(scale)
        pose = self._tracker[1](frame.seq, depth, contact_mask, field, bool(slipping))
        return Absent("contact_too_small") if pose is None else pose
