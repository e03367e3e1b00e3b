"""Collects, frame by frame, how far answers are from the truth, and sums them up as named quantities."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.bench import metrics
from tactflow.sim import Truth
from tactflow.vision.types import Contact, Flow, Markers, MarkerStatus

DIRECTED = 2.0
"""Ratio of a contact's axes from which on its direction is judged. Chosen by hand."""

_ROUND = 100
"""Pixels from which on a contact is large enough to be called round. Chosen by hand."""


def _drop_unknown(values: dict[str, float | None]) -> dict[str, float]:
    # What is left of floating-point rounding in a perfect result is no error.
    return {name: round(value, 9) for name, value in values.items() if value is not None}


def aspect_ratio(mask: NDArray[np.generic]) -> float:
    """Ratio of the principal axes of a region, >= 1; 1 where there is none, inf for a line.

    A pixel has an extent of its own: 1/12 px^2 along each axis belongs to the variance.
    """
    moments = cv2.moments(np.asarray(mask, dtype=np.uint8), binaryImage=True)
    count = moments["m00"]
    if count == 0:
        return 1.0
    xx, yy, xy = (moments[name] / count for name in ("mu20", "mu02", "mu11"))
    middle, half = (xx + yy) / 2 + 1 / 12, float(np.hypot(xx - yy, 2 * xy)) / 2
    return float(np.sqrt((middle + half) / (middle - half)))


@dataclass(slots=True)
class ContactScore:
    """Where is the contact, and is there one?

    Outline errors (mask, hull, area, centre, direction) are averaged over the frames in which the truth and
    the method both see a contact. A missed contact of at least half depth enters with an overlap of 0; what
    was missed in all is counted beside. Directions are judged where the truth is at least `DIRECTED` times as
    long as wide.

    iou, hull : overlaps in [0, 1], of masks and of convex hulls. area : %. center : px. angle : degrees.
    directed, undirected : frames whose truth has a direction, and whose truth is round; without_direction,
    invented_direction : those of them in which the method disagrees. idle, touched, deep : frames without
    contact, with one, and with one of at least half depth; false, missed, missed_deep : those of them in
    which the method disagrees.
    """

    iou: list[float] = field(default_factory=list[float])
    hull: list[float] = field(default_factory=list[float])
    area: list[float] = field(default_factory=list[float])
    center: list[float] = field(default_factory=list[float])
    angle: list[float] = field(default_factory=list[float])
    directed: int = 0
    without_direction: int = 0
    undirected: int = 0
    invented_direction: int = 0
    idle: int = 0
    false: int = 0
    touched: int = 0
    missed: int = 0
    deep: int = 0
    missed_deep: int = 0

    def detected(self, touching: bool, truth: Truth, deep: bool) -> bool:
        """Count one frame's yes or no; True if both say yes."""
        if not truth.touching:
            self.idle += 1
            self.false += touching
            return False
        self.touched += 1
        self.missed += not touching
        if deep:
            self.deep += 1
            self.missed_deep += not touching
            if not touching:
                self.iou.append(0.0)
                self.hull.append(0.0)
        return touching

    def mask(self, mask: NDArray[np.uint8], truth: Truth) -> None:
        """Compare the mask, and its centroid, of a frame with contact."""
        self.iou.append(metrics.mask_iou(mask, truth.contact_mask))

    def centroid(self, mask: NDArray[np.uint8], truth: Truth) -> None:
        """Compare the centroid of a mask, where no geometry follows."""
        moments = cv2.moments(mask, binaryImage=True)
        if moments["m00"] > 0 and truth.center is not None:
            x, y = moments["m10"] / moments["m00"], moments["m01"] / moments["m00"]
            self.center.append(float(np.hypot(x - truth.center[0], y - truth.center[1])))

    def geometry(self, contact: Contact, truth: Truth) -> None:
        """Compare the geometry of a frame with contact."""
        self.hull.append(metrics.convex_iou(contact.hull, truth.hull))
        area = metrics.lattice_area(truth.hull)
        if area > 0:
            self.area.append(100 * abs(contact.area - area) / area)
        if truth.center is not None:
            self.center.append(
                float(np.hypot(contact.center[0] - truth.center[0], contact.center[1] - truth.center[1]))
            )
        if truth.angle is None:
            if np.count_nonzero(truth.contact_mask) >= _ROUND:
                self.undirected += 1
                self.invented_direction += contact.angle is not None
        elif aspect_ratio(truth.contact_mask) >= DIRECTED:
            self.directed += 1
            if contact.angle is None:
                self.without_direction += 1
            else:
                self.angle.append(metrics.angle_error(contact.angle, truth.angle))

    def errors(self) -> dict[str, float]:
        """Quantity -> value."""
        return _drop_unknown(
            {
                "contact_iou": metrics.mean(self.iou),
                "hull_iou": metrics.mean(self.hull),
                "area_error": metrics.mean(self.area),
                "center_error": metrics.mean(self.center),
                "angle_mean": metrics.mean(self.angle),
                "angle_max": max(self.angle, default=None),
                "angle_missing": 100 * self.without_direction / self.directed if self.directed else None,
                "angle_invented": 100 * self.invented_direction / self.undirected
                if self.undirected
                else None,
                "false_contacts": 100 * self.false / self.idle if self.idle else None,
                "missed_contacts": 100 * self.missed / self.touched if self.touched else None,
                "missed_half_depth": 100 * self.missed_deep / self.deep if self.deep else None,
            }
        )


@dataclass(slots=True)
class MarkerScore:
    """Where are the markers, and are they still themselves?

    The first frame tells which of the method's markers is which true one. Displacement errors are lengths of
    error vectors: their RMS over the markers that kept their identity, their 99th percentile over all whose
    position the method claims to know. A visible marker that the method never found is lost.

    missed, false : markers that the method did not find in the first frame, and what it took for markers
    besides; the places of missing ones that it only inferred are not counted.
    index : (N,), true marker -> the method's, -1 for none. pitch : of the true ones, px. right, claimed :
    errors, px, of markers that kept their identity, and of all that are claimed to be known. visible, wrong,
    lost : markers, summed over the frames.
    """

    index: NDArray[np.int64] | None = None
    pitch: float = 0.0
    right: list[NDArray[np.float64]] = field(default_factory=list[NDArray[np.float64]])
    claimed: list[NDArray[np.float64]] = field(default_factory=list[NDArray[np.float64]])
    visible: int = 0
    wrong: int = 0
    lost: int = 0
    missed: int = 0
    false: int = 0

    def add(self, markers: Markers, truth: Truth) -> None:
        """Compare one frame."""
        if len(truth.origin) == 0:
            return
        if self.index is None:
            self.pitch = metrics.grid_pitch(truth.origin) if len(truth.origin) > 1 else 1e9
            self.index = metrics.match(markers.origin, truth.origin, self.pitch / 2)
            self.missed = int(np.count_nonzero(truth.visible & (self.index < 0)))
            seen = np.flatnonzero(markers.status == MarkerStatus.TRACKED)
            self.false = len(np.setdiff1d(seen, self.index))
        found = self.index >= 0
        visible = np.asarray(truth.visible, dtype=np.bool_)
        self.visible += int(np.count_nonzero(visible))
        self.lost += int(np.count_nonzero(visible & ~found))
        own = self.index[found]
        lost = markers.status[own] == MarkerStatus.LOST
        # Every true marker counts as a possible thief, also those that the method never found.
        position = np.array(truth.position, dtype=np.float64)
        position[found] = markers.position[own]
        judged = visible & found
        all_lost = np.zeros(len(found), dtype=np.bool_)
        all_lost[found] = lost
        identity = metrics.identity_errors(position, truth.position, judged, all_lost, self.pitch)
        self.wrong += int(np.count_nonzero(identity.wrong))
        self.lost += int(np.count_nonzero(identity.lost))
        error = metrics.displacement_errors(
            markers.position[own] - markers.origin[own], (truth.position - truth.origin)[found]
        )
        claimed = (judged & ~all_lost)[found]
        self.claimed.append(error[claimed])
        self.right.append(error[claimed & ~identity.wrong[found]])

    def errors(self) -> dict[str, float]:
        """Quantity -> value."""
        if not self.visible:
            return {}
        right = np.concatenate(self.right) if self.right else np.zeros(0)
        claimed = np.concatenate(self.claimed) if self.claimed else np.zeros(0)
        return _drop_unknown(
            {
                "displacement_rms": metrics.rms(right),
                "displacement_p99": metrics.percentile(claimed, 99),
                "wrong_percent": 100 * self.wrong / self.visible,
                "lost_percent": 100 * self.lost / self.visible,
                "markers_missed": self.missed,
                "markers_false": self.false,
            }
        )


@dataclass(slots=True)
class DetectionScore:
    """Are the dots found, and nothing else? One number a frame; distance : px, one for each dot found."""

    recall: list[float] = field(default_factory=list[float])
    precision: list[float] = field(default_factory=list[float])
    distance: list[NDArray[np.float64]] = field(default_factory=list[NDArray[np.float64]])

    def add(self, points: NDArray[np.float64], truth: Truth) -> None:
        """Compare one frame's detections, (N, 2) px, with the visible markers."""
        visible = truth.position[np.asarray(truth.visible, dtype=np.bool_)]
        if len(visible) < 2:
            return
        found = metrics.detection(points, visible, metrics.grid_pitch(visible) / 2)
        self.recall.append(found.recall)
        self.precision.append(found.precision)
        self.distance.append(found.errors)

    def errors(self) -> dict[str, float]:
        """Quantity -> value."""
        return _drop_unknown(
            {
                "marker_recall": metrics.mean(self.recall),
                "marker_precision": metrics.mean(self.precision),
                "localisation_rms": metrics.rms(np.concatenate(self.distance)) if self.distance else None,
            }
        )


@dataclass(slots=True)
class FlowScore:
    """Is the mean flow of the gel in contact right, and its standard error honest?

    error : length of the error vector, px, one a frame. ratio : error of a component over its stated standard
    error, two a frame that states one.
    """

    error: list[float] = field(default_factory=list[float])
    ratio: list[float] = field(default_factory=list[float])

    def add(self, flow: Flow | None, truth: Truth) -> None:
        """Compare one frame, if both know a mean flow."""
        if flow is None or flow.mean is None or truth.contact_flow is None:
            return
        off = np.abs(np.subtract(flow.mean, truth.contact_flow))
        self.error.append(float(np.hypot(*off)))
        if flow.stderr is not None and min(flow.stderr) > 0:
            self.ratio.extend((off / flow.stderr).tolist())

    def errors(self) -> dict[str, float]:
        """Quantity -> value."""
        ratio = np.array(self.ratio)
        within = [100.0 * float(np.mean(ratio < bound)) if len(ratio) else None for bound in (1, 2)]
        return _drop_unknown(
            {
                "flow_error": metrics.mean(self.error),
                "flow_rms": metrics.rms(self.error),
                "flow_within_one": within[0],
                "flow_within_two": within[1],
            }
        )


@dataclass(slots=True)
class RemovalScore:
    """Does the picture without markers look as the gel would without them?

    mae : mean absolute error inside the marker mask, grey levels, one a frame. psnr : dB.
    """

    mae: list[float] = field(default_factory=list[float])
    psnr: list[float] = field(default_factory=list[float])

    def add(self, unmarked: NDArray[np.uint8], truth: NDArray[np.uint8], mask: NDArray[np.uint8]) -> None:
        """Compare one frame inside the marker mask."""
        mae = metrics.masked_mae(unmarked, truth, mask)
        psnr = metrics.masked_psnr(unmarked, truth, mask)
        if mae is not None and psnr is not None:
            self.mae.append(mae)
            self.psnr.append(psnr)

    def errors(self) -> dict[str, float]:
        """Quantity -> value."""
        return _drop_unknown({"inpaint_mae": metrics.mean(self.mae), "inpaint_psnr": metrics.mean(self.psnr)})
