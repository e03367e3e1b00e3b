"""Flow of the gel and its markers.

`motion` tests whether markers move as a contact moves them. `displacement_field` interpolates their motion;
`in_mask` summarises it for the contact, or else the motion of the markers `inside`. `slip` measures how the
object moves against the gel, by `registration` of its picture, and `slip_event` when to report that.
"""

from tactflow.vision.flow.displacement_field import DisplacementField, FieldModel
from tactflow.vision.flow.in_mask import flow_in_mask, flow_of_field
from tactflow.vision.flow.inside import inside_mask
from tactflow.vision.flow.motion import Motion, MotionTest
from tactflow.vision.flow.slip import SlipTracker

__all__ = [
    "DisplacementField",
    "FieldModel",
    "Motion",
    "MotionTest",
    "SlipTracker",
    "flow_in_mask",
    "flow_of_field",
    "inside_mask",
]
