"""The printed markers of a gel: detection, mask, removal and tracking.

Find: once for each reference, `spots` are looked for at every size, and `selection` tells which of them are
marks by the `lattice` that they form and by how much they look like each other; `detection` puts it together.

Match and refine: in each frame, `tracking` aligns each mark with its `template`, from where it was last.
Where one is missing or does not move like its neighbours, `matching` grows the smooth part of the field over
the spots of the frame, and places the marks that are not seen. `motion` tells which do not move with the gel.

`mask` tells where markers cover the gel, and `inpaint` fills these places.
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
