"""Flow of the markers: whether they move, and how those inside the contact do."""

from tactflow.vision.flow.in_mask import HIDDEN, flow_in_mask
from tactflow.vision.flow.inside import inside_mask
from tactflow.vision.flow.motion import Motion, MotionTest

__all__ = ["HIDDEN", "Motion", "MotionTest", "flow_in_mask", "inside_mask"]
