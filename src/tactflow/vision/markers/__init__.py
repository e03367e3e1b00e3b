"""The printed markers of a gel: detection, mask, removal and tracking.

Detection, once per reference: `spots` finds spots of every size, and `selection` chooses the marks among them
by the `lattice` that they form and their likeness to each other; `detection` combines both.

Tracking, in each frame: `tracking` aligns each mark with its `template`, from its last position. If one is
missing or does not move like its neighbours, `matching` grows the smooth part of the field over the spots of
the frame, and interpolates invisible marks. `motion` rejects marks that do not move with the gel.

`mask` marks the pixels that markers cover, and `inpaint` fills them.
"""

from tactflow.vision.markers.detection import Detection, NoMarkersError, detect_markers
from tactflow.vision.markers.inpaint import remove_markers
from tactflow.vision.markers.lattice import neighbour_graph
from tactflow.vision.markers.mask import Dot, find_dot, marker_mask
from tactflow.vision.markers.selection import Candidate
from tactflow.vision.markers.tracking import MarkerTracker

__all__ = [
    "Candidate",
    "Detection",
    "Dot",
    "MarkerTracker",
    "NoMarkersError",
    "detect_markers",
    "find_dot",
    "marker_mask",
    "neighbour_graph",
    "remove_markers",
]
