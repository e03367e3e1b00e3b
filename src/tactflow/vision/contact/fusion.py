"""Fusion of the contacts that the light and the markers show.

Each has a test with its own rate of false alarms, and a contact is reported if either detects one, so the
rates add up. The markers also check the light: a change that covers many markers of which none moves comes
from the lamp or the camera; and a change no larger than a marker, beside a marker, is a residue of
inpainting.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.arrays import Floats32, Mask
from tactflow.vision.contact.background import CELL_PX
from tactflow.vision.flow.inside import inside_mask
from tactflow.vision.flow.motion import Motion, MotionTest
from tactflow.vision.geometry.region import measure_region
from tactflow.vision.types import Evidence, Markers, MarkerStatus

MIN_RESTING_MARKERS: Final = 6
"""Minimum number of resting markers below a change of the light that make it a change of illumination.
Measured: frames in contact in which no marker moved had at most 5 (simulator, mini_ball, gelslim_ball,
handmade_dots, sts_640 and franka_mini)."""
HULL_MARGIN_PITCHES: Final = 0.125
"""Margin of a region around the hull of its markers, pitches. Chosen by hand."""
MAX_RESIDUE_DISTANCE_PX: Final = 5.0
"""Maximum distance of inpainting residue from a marker's border, px: a cell of `background`, and a pixel for
smoothing. Chosen by hand. On sts_640 and tactip_video the centres of residues lie up to 4.4 px away."""
_TRACKED: Final = np.uint8(MarkerStatus.TRACKED)


class FusedContact(NamedTuple):
    """The contact of a frame.

    Attributes
    ----------
    mask : (H, W) uint8, 255 in contact.
    evidence : what showed it; None without contact.
    light_changed : whether a change of the light is not a contact.
    """

    mask: Mask
    evidence: Evidence | None
    light_changed: bool = False

    @property
    def touching(self) -> bool:
        """Whether anything is in contact."""
        return self.evidence is not None


def fuse_contact(
    light: Mask, markers: Markers, test: MotionTest, deviations: Floats32 | None = None
) -> FusedContact:
    """Combine the contact that the light shows with the one that the markers show.

    Parameters
    ----------
    light : (H, W) uint8, 255 where the light shows contact; returned unchanged if that is the contact.
    markers : of the same frame. test : motion test of these markers; it must see every frame in order.
    deviations : (2, h, w) float32, non-zero in cells that have changed; None: those of `light`.

    Returns
    -------
    FusedContact : with the region of the light if there is one, because its outline is finer; otherwise the
        convex hull of the most stretched part of the gel.

    Examples
    --------
    >>> origin = np.array([[x, y] for y in range(0, 100, 20) for x in range(0, 100, 20)], float)
    >>> position = origin.copy()
    >>> position[[6, 7, 8]] += [4.0, 0.0]
    >>> markers = Markers(origin, position, np.zeros(25, np.uint8), np.full(25, 0.02))
    >>> fused = fuse_contact(np.zeros((100, 100), np.uint8), markers, MotionTest(origin))
    >>> fused.evidence, fused.mask[20, 40]
    ('dots', np.uint8(255))
    """
    motion = test(markers)
    if not cv2.hasNonZero(light):
        if not motion.clearly:
            return FusedContact(light, None)
        return FusedContact(_hull_of(test.stretched(markers), test.pitch, light), "dots")
    if motion.moving:
        return FusedContact(light, "both")
    changed = light if deviations is None else changed_mask(deviations, light.shape)
    if _rests(changed, markers, motion):
        return FusedContact(np.zeros_like(light), None, light_changed=True)
    if deviations is not None and not _without_rims(changed, markers, CELL_PX).any():
        return FusedContact(np.zeros_like(light), None)
    mask = _without_rims(light, markers)
    return FusedContact(mask, "light" if cv2.countNonZero(mask) else None)


def changed_mask(deviations: Floats32, shape: tuple[int, ...]) -> Mask:
    """(H, W) uint8, 255 in changed cells; deviations : (2, h, w), 0 in all other cells."""
    cells = (deviations.max(axis=0) > 0).view(np.uint8) * np.uint8(255)
    return np.ascontiguousarray(cells.repeat(CELL_PX, axis=0).repeat(CELL_PX, axis=1)[: shape[0], : shape[1]])


def _rests(light: Mask, markers: Markers, motion: Motion) -> bool:
    """Whether enough markers lie below a change of the light, and all of them are at rest."""
    seen = markers.status == _TRACKED
    below = inside_mask(markers.position[seen], light)
    resting = motion.still()[seen][below]
    return len(resting) >= MIN_RESTING_MARKERS and bool(resting.all())


def _without_rims(light: Mask, markers: Markers, coarse: int = 0) -> Mask:
    """Remove regions that are residue of inpainting at the rim of a marker; the same array if there are none.

    coarse : side of the cells that the mask consists of, px.
    A marker that has moved by a fraction of a pixel is not quite where it is painted over.
    """
    radius = markers.radius
    if radius is None or not len(markers.position):
        return light
    # OpenCV takes twenty times as long for the whole frame as for the box around a first touch.
    left, top, width, height = measure_region(light)[:4]
    window = light[top : top + height, left : left + width]
    count, labels, boxes, centers = cv2.connectedComponentsWithStats(window)
    small = np.flatnonzero(
        boxes[:, cv2.CC_STAT_AREA] <= np.pi * (radius + MAX_RESIDUE_DISTANCE_PX + coarse) ** 2
    )
    places = centers[small] + (left, top)
    away = np.hypot(*(places[:, None] - markers.position).transpose(2, 0, 1)).min(axis=1)
    rims = small[(away <= radius + MAX_RESIDUE_DISTANCE_PX) & (small > 0)]
    if not len(rims):
        return light
    kept = np.ones(count, np.bool_)
    kept[[0, *rims]] = False
    left_over = np.zeros_like(light)
    left_over[top : top + height, left : left + width] = np.where(kept[labels], 255, 0)
    return left_over


def _hull_of(points: NDArray[np.float64], pitch: float, like: Mask) -> Mask:
    """The convex hull of markers with a margin, so that collinear markers have one, too."""
    region = np.zeros_like(like)
    hull = cv2.convexHull(np.rint(points).astype(np.int32))
    cv2.fillConvexPoly(region, hull, 255)
    cv2.polylines(region, [hull], True, 255, max(1, round(2 * HULL_MARGIN_PITCHES * pitch)))
    return region
