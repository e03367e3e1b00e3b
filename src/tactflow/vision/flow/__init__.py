"""Flow of the markers inside the contact: mean displacement, rotation and divergence."""

from tactflow.vision.flow.in_mask import HIDDEN, flow_in_mask
from tactflow.vision.flow.inside import inside_mask

__all__ = ["HIDDEN", "flow_in_mask", "inside_mask"]
