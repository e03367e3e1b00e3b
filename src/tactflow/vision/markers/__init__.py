"""The printed markers of a gel: detection, mask, removal and tracking.

Once for each reference, `detection` finds them: `scale_space` looks for spots of every size, and `selection`
tells which of them are marks by the `lattice` that they form and by how much they look like each other.

In each frame, `mask` tells where markers cover the gel, and `inpaint` fills these places. `tracking` follows
the markers: `template` aligns each one from where it was last. Where a marker is missing or does not move
like its neighbours, `spots` finds spots of the markers' size, `matching` chooses one for each marker, and
`interpolation` places those that are not seen.
"""

from tactflow.vision.markers.detection import Candidate, Detection, NoMarkersError, detect_markers
from tactflow.vision.markers.inpaint import remove_markers
from tactflow.vision.markers.lattice import neighbour_graph
from tactflow.vision.markers.mask import Dot, find_dot, marker_mask
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
