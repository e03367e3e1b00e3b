"""Compare results with the truth of a simulated scene, frame by frame."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.sim import Truth
from tactflow.sim.gel import MM_PER_PX
from tactflow.tools.bench import metrics
from tactflow.tools.bench.lockstep import TimedResult
from tactflow.tools.bench.quantities import Tally
from tactflow.tools.bench.scenes import Rendered
from tactflow.vision.flow import DisplacementField
from tactflow.vision.geometry import PixelMapping
from tactflow.vision.types import Contact, Depth, Flow, Markers, MarkerStatus

MIN_DIRECTED_AXIS_RATIO = 2.0
"""Minimum ratio of the axes of a contact whose direction is judged. Chosen by hand."""

_FIELD_POINT_COUNT = 100
"""Places at which a displacement field is compared."""

MIN_DEPTH_MM = 0.1
"""True depth from which a height map is judged, mm: of less, a relative error says nothing."""

_MIN_ROUND_PIXELS = 100
"""Minimum number of pixels of a contact whose roundness is judged. Chosen by hand."""


def add_decision(tally: Tally, touching: bool, truth: Truth, deep: bool) -> bool:
    """Count a decision; returns True for a contact that was found.

    A missed contact of at least half depth counts as an outline with an overlap of 0. Its other errors are
    unknown; misses are counted separately.

    deep : whether the contact has at least half of its depth.
    """
    if not truth.touching:
        tally.percent(false_contacts=touching)
        return False
    tally.percent(missed_contacts=not touching)
    if deep:
        tally.percent(missed_half_depth=not touching)
        if not touching:
            tally.add(contact_iou=0.0, hull_iou=0.0)
    return touching


def add_mask(tally: Tally, mask: NDArray[np.uint8], truth: Truth) -> None:
    """Compare the mask (H, W) of a contact."""
    tally.add(contact_iou=metrics.mask_iou(mask, truth.contact_mask))


def add_centroid(tally: Tally, mask: NDArray[np.uint8], truth: Truth) -> None:
    """Compare the centroid of a mask (H, W), where no geometry follows."""
    moments = cv2.moments(mask, binaryImage=True)
    if moments["m00"] > 0 and truth.center is not None:
        center = moments["m10"] / moments["m00"], moments["m01"] / moments["m00"]
        tally.add(center_error=metrics.distance(center, truth.center))


def add_geometry(tally: Tally, contact: Contact, truth: Truth) -> None:
    """Compare outline, area, centre and direction of a contact.

    Directions are judged where the truth is at least `MIN_DIRECTED_AXIS_RATIO` times as long as wide.
    """
    shape = truth.contact_mask.shape
    tally.add(hull_iou=metrics.polygon_iou(contact.hull, truth.hull, shape))
    area = metrics.pixel_area(truth.hull)
    tally.add(area_error=100 * abs(contact.area - area) / area)
    if truth.center is not None:
        tally.add(center_error=metrics.distance(contact.center, truth.center))
    if truth.angle is None:
        if np.count_nonzero(truth.contact_mask) >= _MIN_ROUND_PIXELS:
            tally.percent(angle_invented=contact.angle is not None)
    elif metrics.aspect_ratio(truth.contact_mask) >= MIN_DIRECTED_AXIS_RATIO:
        tally.percent(angle_missing=contact.angle is None)
        if contact.angle is not None:
            error = metrics.angle_error(contact.angle, truth.angle)
            tally.add(angle_mean=error, angle_max=error)


def add_flow(tally: Tally, flow: Flow | None, truth: Truth) -> None:
    """Compare the mean flow, where both know it, and its error with the standard error that it states."""
    if flow is None or flow.mean is None or truth.contact_flow is None:
        return
    error = metrics.distance(flow.mean, truth.contact_flow)
    tally.add(flow_error=error, flow_rms=error)
    if flow.stderr is not None and min(flow.stderr) > 0:
        tally.within("flow", np.subtract(flow.mean, truth.contact_flow), flow.stderr)


def add_field(tally: Tally, field: DisplacementField | None, truth: Truth) -> None:
    """Compare the displacement field where the gel is in contact, at up to `_FIELD_POINT_COUNT` places."""
    rows, columns = np.nonzero(truth.contact_mask)
    if field is None or not len(rows):
        return
    chosen = np.unique(np.linspace(0, len(rows) - 1, _FIELD_POINT_COUNT).round().astype(np.int64))
    points = np.column_stack([columns, rows])[chosen].astype(np.float64)
    errors = field.at(points) - truth.displacement(points)
    tally.add(field_rms=np.hypot(*errors.T))


def add_depth(tally: Tally, depth: Depth | None, truth: Truth) -> None:
    """Compare a height map within the true contact, from `MIN_DEPTH_MM` on."""
    if depth is None or not truth.touching:
        return
    true = truth.sunk * MM_PER_PX
    greatest = float(true.max())
    if greatest < MIN_DEPTH_MM:
        return
    tally.add(depth_rms=(depth.heights - true)[truth.contact_mask])
    tally.add(depth_greatest=100 * abs(depth.greatest / greatest - 1))
    if depth.greatest_stderr is not None:
        tally.within("depth", depth.greatest - greatest, depth.greatest_stderr)


def add_detection(tally: Tally, points: NDArray[np.float64], truth: Truth) -> None:
    """Compare detected dots (N, 2) px with the visible ones."""
    visible = truth.position[np.asarray(truth.visible, dtype=np.bool_)]
    if len(visible) < 2:
        return
    recall, precision, errors = metrics.detection(points, visible, metrics.dot_pitch(visible) / 2)
    tally.add(marker_recall=recall, marker_precision=precision, localisation_rms=errors)


class MarkerScore:
    """Compares positions and identities of the markers tracked in one recording.

    The first frame assigns the method's markers to the true ones. Displacement errors are lengths of
    error vectors: their RMS over the markers that kept their identity, their 99th percentile over all that
    the method does not call lost. A visible marker that the method never found is lost.
    """

    def __init__(self, tally: Tally) -> None:
        self._tally = tally
        self._index: NDArray[np.int64] | None = None
        """(N,), true marker -> the method's, -1 for none."""
        self._pitch = 0.0

    def add(self, markers: Markers, truth: Truth) -> None:
        """Compare one frame."""
        if len(truth.origin) == 0:
            return
        index = self._match(markers, truth) if self._index is None else self._index
        visible = np.asarray(truth.visible, dtype=np.bool_)
        found = index >= 0
        own = index[found]
        lost = ~found
        lost[found] = markers.status[own] == MarkerStatus.LOST
        # A marker may also be confused with one that the method never found.
        position = np.array(truth.position, dtype=np.float64)
        position[found] = markers.position[own]
        claimed = visible & ~lost
        wrong = claimed & metrics.identity_errors(position, truth.position, self._pitch)
        self._tally.percent(wrong_percent=wrong[visible], lost_percent=lost[visible])
        error = np.zeros(len(found))
        true_displacement = (truth.position - truth.origin)[found]
        error[found] = metrics.distance(markers.position[own] - markers.origin[own], true_displacement)
        self._tally.add(displacement_rms=error[claimed & ~wrong], displacement_p99=error[claimed])

    def _match(self, markers: Markers, truth: Truth) -> NDArray[np.int64]:
        """Find the marker of the method that belongs to each true one, and count the unmatched ones.

        Inferred markers are not counted as false.
        """
        self._pitch = metrics.dot_pitch(truth.origin)
        index = metrics.match_points(markers.origin, truth.origin, self._pitch / 2)
        tracked = np.flatnonzero(markers.status == MarkerStatus.TRACKED)
        self._tally.add(
            markers_missed=np.count_nonzero(truth.visible & (index < 0)),
            markers_false=len(np.setdiff1d(tracked, index)),
        )
        self._index = index
        return index


class PipelineScore:
    """Compares the results of a whole pipeline on one scene.

    Parameters
    ----------
    tally : gets the errors; may be shared by several scenes.
    """

    def __init__(self, rendered: Rendered, tally: Tally) -> None:
        self.tally = tally
        self._rendered = rendered
        self._markers = MarkerScore(tally)

    def add(self, result: TimedResult) -> str:
        """Compare one frame; returns what it shows: "contact" or "idle"."""
        height, width = result.frame.image.shape[:2]
        mapping = result.mapping or PixelMapping.identity((width, height))
        truth, deep = self._rendered.truths(mapping)[result.seq], self._rendered.deep(result.seq)
        contact = result.contact
        if add_decision(self.tally, contact is not None, truth, deep):
            assert contact is not None
            add_geometry(self.tally, contact, truth)
            if result.contact_mask is not None:
                add_mask(self.tally, result.contact_mask, truth)
        if result.markers is not None:
            self._markers.add(result.markers, truth)
        add_flow(self.tally, result.flow, truth)
        add_field(self.tally, result.field, truth)
        add_depth(self.tally, result.depth, truth)
        return "contact" if truth.touching else "idle"
