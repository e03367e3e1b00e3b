"""The printed markers of a gel: detection, mask, removal and tracking."""

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
