"""Whether and where something touches the gel, from what the light and what the markers say.

Each has a test with a rate of false alarms of its own, and if either sees a contact there is one: the rates
add up. The markers also check the light: a change that covers many of them, none of which moves, is one of
the lamp or the camera; a second one, around which none moves, is a reflection of the first; and one no larger
than a marker, beside a marker, is what its removal has left.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.arrays import Mask
from tactflow.vision.flow.inside import inside_mask
from tactflow.vision.flow.motion import Motion, MotionTest
from tactflow.vision.geometry.region import Region, measure_region
from tactflow.vision.types import Evidence, Markers, MarkerStatus

UNMOVED: Final = 6
"""Markers below a change of the light, none of which moves, from which on it is no contact; and as many
around one region while others move. Measured: of the frames in contact of the simulator, mini_ball,
gelslim_ball, handmade_dots, sts_640 and franka_mini, those in which no marker moved had 5 at most."""

DRAGGED: Final = 0.1
"""Part of the largest motion up to which a marker is not pressed but dragged along with all of the gel. The
markers around a simulated reflection move by 0.06 of it at most; around separate contacts of franka_mini the
one that moves most does so by 0.13 at least."""
MARGIN: Final = 0.125
"""How much wider than the hull of its markers a region is, pitches. Chosen by hand."""
SPREAD: Final = 5.0
"""How far beyond a marker's border what is left of it may be drawn, px: a cell of `background`, and a pixel
more for smoothing. Chosen by hand. On sts_640 and tactip_video the middle of such remains is up to 4.4 px
beyond it."""
_TRACKED: Final = np.uint8(MarkerStatus.TRACKED)


class FusedContact(NamedTuple):
    """Where a frame shows contact.

    mask : (H, W) uint8, 255 in contact. evidence : what showed it; None where nothing touches.
    light_changed : whether there is a change of the light that is no contact.
    """

    mask: Mask
    evidence: Evidence | None
    light_changed: bool = False

    @property
    def touching(self) -> bool:
        """Whether anything is in contact."""
        return self.evidence is not None


def fuse_contact(light: Mask, markers: Markers, test: MotionTest) -> FusedContact:
    """Join the contact that the light shows and the one that the markers show.

    Parameters
    ----------
    light : (H, W) uint8, 255 where the light shows contact; returned as it is where it shows the contact.
    markers : of the same frame. test : of the motion of these markers, given every frame in order.

    Returns
    -------
    FusedContact : the region is that of the light if it sees any, for its outline is the finer one; else the
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
    motion, region = test(markers), measure_region(light)
    if not region.pixels:
        if not motion.clearly:
            return FusedContact(light, None)
        return FusedContact(_hull_of(test.stretched(markers), test.pitch, light), "dots")
    if motion.moving:
        return FusedContact(_without_strays(light, region, markers, motion, test.pitch), "both")
    if _rests(light, markers, motion):
        return FusedContact(np.zeros_like(light), None, light_changed=True)
    mask = _without_rims(light, region, markers)
    return FusedContact(mask, "light" if cv2.countNonZero(mask) else None)


def _rests(light: Mask, markers: Markers, motion: Motion) -> bool:
    """Whether many markers lie below a change of the light, and all of them are at rest."""
    seen = markers.status == _TRACKED
    below = inside_mask(markers.position[seen], light)
    resting = motion.still()[seen][below]
    return len(resting) >= UNMOVED and bool(resting.all())


def _without_strays(light: Mask, region: Region, markers: Markers, motion: Motion, reach: float) -> Mask:
    """Of several regions those that are neither reflections nor rims of markers; none is left out alone.

    region : all of them. reach : how far around a region markers tell what it is, px.
    """
    if region.in_one_piece:
        return light
    left, top, width, height = region[:4]
    window = light[top : top + height, left : left + width]
    outlines, _ = cv2.findContours(window, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE, offset=(left, top))
    if len(outlines) < 2:
        return light
    moved = _without_reflections(light, outlines, markers, motion, reach)
    if all(pixels > _largest_rim(markers) for pixels in _fewest_pixels(light, outlines)):
        return moved
    kept = _without_rims(moved, region, markers)
    return kept if cv2.countNonZero(kept) else moved


def _largest_rim(markers: Markers) -> float:
    """Pixels of what removing a marker may leave, at most; 0 where the size of markers is not known."""
    return 0.0 if markers.radius is None else np.pi * (markers.radius + SPREAD) ** 2


def _fewest_pixels(light: Mask, outlines: Sequence[cv2.typing.MatLike]) -> Iterator[int]:
    """How many pixels each region has at least: those in its box, less where boxes of others overlap it.

    To tell the regions apart pixel by pixel takes fifty times as long.
    """
    boxes = [cv2.boundingRect(outline) for outline in outlines]
    for number, (left, top, width, height) in enumerate(boxes):
        pixels = cv2.countNonZero(light[top : top + height, left : left + width])
        for x, y, wide, high in boxes[:number] + boxes[number + 1 :]:
            across = min(left + width, x + wide) - max(left, x)
            down = min(top + height, y + high) - max(top, y)
            pixels -= max(across, 0) * max(down, 0)
        yield pixels


def _without_reflections(
    light: Mask, outlines: Sequence[cv2.typing.MatLike], markers: Markers, motion: Motion, reach: float
) -> Mask:
    """The regions around which markers move; the same array if these are all, or none.

    Whatever presses the gel moves the markers beside it. outlines : of the regions.
    """
    seen = markers.status == _TRACKED
    places, unmoved = markers.position[seen], motion.still(DRAGGED)[seen]
    boxes = np.array([cv2.boundingRect(outline) for outline in outlines], np.float64)[:, None]
    low, high = boxes[..., :2] - reach, boxes[..., :2] + boxes[..., 2:] + reach
    beside = ((low <= places) & (places <= high)).all(axis=2)
    resting = (np.count_nonzero(beside, axis=1) >= UNMOVED) & ~(beside & ~unmoved).any(axis=1)
    if not resting.any() or resting.all():
        return light
    kept = light.copy()
    cv2.drawContours(kept, [outlines[index] for index in np.flatnonzero(resting).tolist()], -1, 0, cv2.FILLED)
    return kept


def _without_rims(light: Mask, region: Region, markers: Markers) -> Mask:
    """The regions that are more than what removing a marker leaves at its rim; the same array if all are.

    region : all of them.
    A marker that has moved by a part of a pixel is not quite where it is painted over.
    """
    radius = markers.radius
    if radius is None or not len(markers.position):
        return light
    # OpenCV takes twenty times as long for the whole frame as for the box around a first touch.
    left, top, width, height = region[:4]
    window = light[top : top + height, left : left + width]
    count, labels, boxes, centers = cv2.connectedComponentsWithStats(window)
    small = np.flatnonzero(boxes[:, cv2.CC_STAT_AREA] <= _largest_rim(markers))
    places = centers[small] + (left, top)
    away = np.hypot(*(places[:, None] - markers.position).transpose(2, 0, 1)).min(axis=1)
    rims = small[(away <= radius + SPREAD) & (small > 0)]
    if not len(rims):
        return light
    kept = np.ones(count, np.bool_)
    kept[[0, *rims]] = False
    left_over = np.zeros_like(light)
    left_over[top : top + height, left : left + width] = np.where(kept[labels], 255, 0)
    return left_over


def _hull_of(points: NDArray[np.float64], pitch: float, like: Mask) -> Mask:
    """The convex hull of markers, a little wider, so that markers in a line have one, too."""
    region = np.zeros_like(like)
    hull = cv2.convexHull(np.rint(points).astype(np.int32))
    cv2.fillConvexPoly(region, hull, 255)
    cv2.polylines(region, [hull], True, 255, max(1, round(2 * MARGIN * pitch)))
    return region
