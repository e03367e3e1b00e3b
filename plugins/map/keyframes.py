"""Keyframes: the frames of a contact that show new parts of an object, and how it moved between them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from tactflow.vision.arrays import Flags, Floats, Mask
from tactflow.vision.flow.displacement_field import DisplacementField
from tactflow.vision.pose.imprint import Imprint, Template, imprint_of, template_of
from tactflow.vision.pose.rigid import adjoint, inverse, rigid, vector
from tactflow.vision.pose.tracker import (
    DEFAULT_HEIGHT_ERROR,
    MIN_OVERLAP,
    SLOPE_ERROR_PARTS,
    PoseTracker,
)
from tactflow.vision.types import Depth, Pose, Scale

MAX_SLOPE_SHARE: Final = 0.9
"""Largest share of a pose's variance that is ascribed to the common error of all slopes: tracking that was
started anew on the way does not state it exactly."""

MIN_COSINE: Final = 0.5
"""Smallest cosine between normals of the same side of an object: 60 degrees."""


class Touch(NamedTuple):
    """A frame of a contact.

    Attributes
    ----------
    seq : of the frame.
    scale, depth : of the stages of these names.
    mask : (H, W) uint8, 255 in contact.
    field : of the stage of that name; None without dots.
    slipping : whether the stage `slip` reports that the object slides over the gel.
    """

    seq: int
    scale: Scale
    depth: Depth
    mask: Mask
    field: DisplacementField | None = None
    slipping: bool = False


class Edge(NamedTuple):
    """A measured motion between two keyframes.

    Attributes
    ----------
    before, now : indices of the keyframes.
    motion : (4, 4), mm, of the object, from where it was to where it is, in the axes of `Scale`.
    covariance : (6, 6), mm and radians, of e in: true motion = rigid(e + s by_slopes) @ motion.
    by_slopes : (6,), what the relative error s of all slopes and heights does to it.
    """

    before: int
    now: int
    motion: Floats
    covariance: Floats
    by_slopes: Floats


class Keyframe(NamedTuple):
    """A frame that shows new parts of the object. seq : of the frame."""

    seq: int
    imprint: Imprint
    template: Template


@dataclass
class Contact:
    """One contact: its keyframes, and the motions from each to the next.

    Attributes
    ----------
    keyframes, edges : in order; edges are one fewer.
    frames : number of frames in which the object was tracked.
    """

    keyframes: list[Keyframe]
    edges: list[Edge]
    frames: int = 1


def contacts_of(touches: Iterable[Touch | None]) -> list[Contact]:
    """The contacts of a recording; one also ends where the object cannot be tracked.

    touches : frame by frame, None without contact.
    """
    found: list[Contact] = []
    tracker: _Tracker | None = None
    for touch in touches:
        keyframe = None if touch is None else keyframe_of(touch)
        if touch is None or keyframe is None:
            tracker = None
        elif tracker is None or not tracker.follow(touch, keyframe):
            tracker = _Tracker(touch, keyframe)
            found.append(tracker.contact)
    return found


class _Tracker:
    """Follows one contact. Each keyframe starts the tracking of the object anew, so that the motions between
    keyframes have independent errors."""

    def __init__(self, touch: Touch, keyframe: Keyframe) -> None:
        self.contact = Contact([keyframe], [])
        self._tracker = PoseTracker(touch.scale)
        self._track(touch)

    def follow(self, touch: Touch, seen: Keyframe) -> bool:
        """Add a frame. False if the object cannot be tracked into it."""
        pose = self._track(touch)
        if pose is None or pose.status == "lost":
            return False
        contact = self.contact
        contact.frames += 1
        edge = edge_of(pose, len(contact.keyframes) - 1, seen.imprint.error)
        if overlap(contact.keyframes[-1].imprint, seen.template, inverse(edge.motion)) < MIN_OVERLAP:
            contact.keyframes.append(seen)
            contact.edges.append(edge)
            self._tracker.reset()
            self._track(touch)
        return True

    def _track(self, touch: Touch) -> Pose | None:
        return self._tracker(touch.seq, touch.depth, touch.mask, touch.field, touch.slipping)


def keyframe_of(touch: Touch) -> Keyframe | None:
    """What a frame shows of the object; None where the contact is too small."""
    depth, error = touch.depth, DEFAULT_HEIGHT_ERROR
    if depth.greatest_stderr is not None and depth.greatest > 0:
        error = depth.greatest_stderr / depth.greatest
    imprint = imprint_of(depth.heights, touch.mask, touch.scale, error)
    return None if imprint is None else Keyframe(touch.seq, imprint, template_of(imprint))


def edge_of(pose: Pose, before: int, slope_error: float) -> Edge:
    """The motion of a pose whose tracking started in a keyframe, to the next one.

    before : index of the keyframe. slope_error : relative standard error of all slopes, which is taken out of
        the covariance of the pose.
    """
    radians = np.array([1.0, 1.0, 1.0, *np.radians([1.0, 1.0, 1.0])])
    motion = rigid(np.array([*pose.translation, *pose.rotation]) * radians)
    covariance = pose.covariance * np.outer(radians, radians)
    by_slopes = turned(motion) @ (SLOPE_ERROR_PARTS * vector(motion))
    # What is left has no negative variance, and at least a tenth of that along `by_slopes`.
    most = MAX_SLOPE_SHARE / max(float(by_slopes @ np.linalg.solve(covariance, by_slopes)), 1e-12)
    covariance -= min(slope_error**2, most) * np.outer(by_slopes, by_slopes)
    return about_origin(before, before + 1, motion, covariance, by_slopes, np.array(pose.center))


def turned(motion: Floats) -> Floats:
    """(6, 6): a small motion in the axes that a motion (4, 4) rotates, in those of the sensor."""
    return np.asarray(np.kron(np.eye(2), motion[:3, :3]), np.float64)


def about_origin(
    before: int, now: int, motion: Floats, covariance: Floats, by_slopes: Floats, center: Floats
) -> Edge:
    """The edge of a motion (4, 4) about a centre (3,); covariance and `by_slopes` are of the moved centre."""
    there, moved = np.eye(4), np.eye(4)
    there[:3, 3], moved[:3, 3] = center, center + motion[:3, 3]
    carry = adjoint(moved)
    motion = there @ motion @ inverse(there)
    return Edge(before, now, motion, carry @ covariance @ carry.T, carry @ by_slopes)


def overlap(shown: Imprint, template: Template, motion: Floats) -> float:
    """Share of the points of a template that an imprint shows; arguments as for `shared_points`."""
    return float(np.mean(shared_points(shown, template, motion)))


def shared_points(shown: Imprint, template: Template, motion: Floats) -> Flags:
    """(N,): whether an imprint shows each point of a template, from the same side.

    motion : (4, 4), from the frame of the template to that of the imprint, about the origin.
    """
    points = (template.points[:, :3] + template.center) @ motion[:2, :3].T + motion[:2, 3]
    across, down = template.points[:, 3:5].T
    upright = np.sqrt(np.maximum(1 - across**2 - down**2, 0))
    facing = np.column_stack([across, down, upright]) @ motion[2, :3]
    columns, rows = np.rint((points - shown.first) / shown.cell).astype(int).T
    high, wide = shown.planes.shape[:2]
    inside = (columns >= 0) & (columns < wide) & (rows >= 0) & (rows < high) & (facing > MIN_COSINE)
    inside[inside] = shown.planes[rows[inside], columns[inside], 3] > 0
    return np.asarray(inside, np.bool_)
