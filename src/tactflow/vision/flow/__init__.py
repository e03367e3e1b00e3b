"""Flow of the gel and its markers: whether they move, how the gel moves between them and in the contact.

`motion` tests whether markers move as something that touches the gel moves them. `displacement_field` tells
how the gel moves between them; `in_mask` sums that up for the contact, or else the motions of the markers
that are `inside` of it; `slip` measures how the object moves against the gel, by the
`registration` of its picture.
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
