"""How an object has moved since it was touched, frame by frame."""

from __future__ import annotations

import cmath
from typing import Final, Literal, NamedTuple

import numpy as np

from tactflow.vision.arrays import Floats, Mask
from tactflow.vision.flow.displacement_field import CELL_PITCHES, DisplacementField
from tactflow.vision.geometry.similarity import as_complex, fit_similarity
from tactflow.vision.pose.align import MOTION_PRIOR_STDDEV, Alignment, Gel, align
from tactflow.vision.pose.imprint import Imprint, Template, imprint_of, template_of
from tactflow.vision.pose.rigid import adjoint, inverse, vector
from tactflow.vision.types import Depth, Pose, Scale

MIN_OVERLAP: Final = 0.7
"""A keyframe that shows a smaller share of the present contact, of object or gel, is replaced."""
MIN_CELLS: Final = 30
"""Smallest number of cells inside the rim of a tracked object: a contact of 25 px."""
MAX_MISFIT: Final = 82.0
"""Largest misfit due to errors of the expected size: the mean of chi squared with 44 degrees of freedom (25
patches, two components, six unknowns) plus four standard deviations."""
MAX_RESIDUAL: Final = 0.6
"""Residual of the normals, over their spread, above which an imprint is of another object."""
DEFAULT_HEIGHT_ERROR: Final = 0.1
"""Relative error of heights with an unknown error."""
SLOPE_ERROR_PARTS: Final = np.array([0, 0, 1, 1, 1, 0])
"""Parts of a small motion with the relative error of all slopes and heights: height and tilts."""
_TO_DEGREES: Final = np.array([1.0, 1.0, 1.0, *np.degrees([1.0, 1.0, 1.0])])
"""Degrees per radian of a small motion's last three parts."""


class _Frame(NamedTuple):
    """A frame: the imprint; the field of the gel, its share (rows, columns) in contact, and the standard
    error of its mean displacement, px, or None."""

    imprint: Imprint
    gel: tuple[DisplacementField, Floats, float] | None


class _Keyframe(NamedTuple):
    """A frame that others are compared with.

    Attributes
    ----------
    center : (3,), of its template, from that of the first one, mm.
    motion, back : (4, 4), from the start to it about its centre, and its inverse.
    carry : (6, 6), of `back`, see `adjoint`.
    covariance : (6, 6), of the motion.
    by_slopes : (6,), what of the motion is in proportion to the slopes.
    """

    frame: _Frame
    template: Template
    center: Floats
    motion: Floats
    back: Floats
    carry: Floats
    covariance: Floats
    by_slopes: Floats


class PoseTracker:
    """Tracks an object on the gel.

    Each frame is aligned with a keyframe, at first that in which the contact began. As the contact moves on,
    the keyframe is replaced, and the errors of both add up; within one they do not grow. Where the object
    slides over the gel, or the normals contradict the gel, only the normals count, until the next keyframe.

    Parameters
    ----------
    scale : mm per px.

    Examples
    --------
    >>> y, x = np.mgrid[:100, :100]
    >>> def ball(left):
    ...     return np.maximum(0.8 - 0.002 * ((x - left) ** 2 + (y - 50) ** 2), 0).astype(np.float32)
    >>> tracker = PoseTracker(Scale(0.05, 0.05, (0, 0), (49.5, 49.5)))
    >>> for seq, left in enumerate((50, 53)):
    ...     heights = ball(left)
    ...     mask = np.where(heights > 0, 255, 0).astype(np.uint8)
    ...     pose = tracker(seq, Depth(heights, 0.8, 0.01, 1.0, None), mask)
    >>> [round(abs(part), 2) for part in pose.translation], pose.stderr[5] > 30
    ([0.15, 0.0, 0.0], True)
    """

    def __init__(self, scale: Scale) -> None:
        self._scale = scale
        self._mm = np.array([scale.x, scale.y])
        self._relative = np.array(scale.stderr) / self._mm
        self.reset()

    def reset(self) -> None:
        """Nothing touches the gel: the next object is another one."""
        self._key: _Keyframe | None = None
        self._since, self._origin = 0, np.zeros(3)
        self._last = np.eye(4)
        self._slid = False

    def __call__(
        self,
        seq: int,
        depth: Depth,
        mask: Mask,
        field: DisplacementField | None = None,
        slipping: bool = False,
    ) -> Pose | None:
        """The pose in the next frame; None where the contact is too small to tell.

        seq : of the frame. mask : (H, W) uint8, 255 in contact. slipping : whether it slides over the gel.
        """
        frame = self._seen(depth, mask, field)
        if frame is None or frame.imprint.area < MIN_CELLS:
            self.reset()
            return None
        key = self._key
        if key is None:
            template = template_of(frame.imprint)
            self._since, self._origin = seq, template.center
            self._key = self._keyframe(frame, template, np.eye(4), np.zeros((6, 6)), np.zeros(6))
            return self._pose("tracked", np.eye(4), np.zeros((6, 6)))
        self._slid |= slipping
        found, gel = self._aligned(key, frame)
        if found is None:
            lost = self._pose("lost", self._last, key.covariance + np.diag(MOTION_PRIOR_STDDEV**2))
            self.reset()
            return lost
        motion, covariance, by_slopes = self._since_start(key, found)
        self._last = motion
        overlap = found.overlap if gel is None else min(found.overlap, gel.overlap)
        if overlap < MIN_OVERLAP or (self._slid and not slipping):
            self._key = self._keyframe(frame, template_of(frame.imprint), motion, covariance, by_slopes)
            self._slid = slipping
        error = frame.imprint.error
        return self._pose("tracked", motion, covariance + error**2 * np.outer(by_slopes, by_slopes))

    def _seen(self, depth: Depth, mask: Mask, field: DisplacementField | None) -> _Frame | None:
        error = DEFAULT_HEIGHT_ERROR
        if depth.greatest_stderr is not None and depth.greatest > 0:
            error = depth.greatest_stderr / depth.greatest
        imprint = imprint_of(depth.heights, mask, self._scale, error)
        motion = None if field is None else field.motion(mask)
        if imprint is None or field is None or motion is None:
            return None if imprint is None else _Frame(imprint, None)
        return _Frame(imprint, (field, field.share(mask), motion.stderr))

    def _aligned(self, key: _Keyframe, now: _Frame) -> tuple[Alignment | None, Gel | None]:
        """The alignment, and the gel that it used."""
        gel = None if self._slid else self._same_gel(key.frame, now)
        found = self._matched(key, now, gel)
        if gel is not None and (found is None or found.misfit > MAX_MISFIT):
            without = self._matched(key, now, None)
            if without is not None and without.misfit <= MAX_MISFIT:
                # The object does not move with the gel below it.
                self._slid = True
                return without, None
        return found, gel

    def _matched(self, key: _Keyframe, now: _Frame, gel: Gel | None) -> Alignment | None:
        """The alignment, starting from the last motion; None if it does not fit."""
        start = self._last @ key.back
        start[:3, 3] -= key.center
        found = align(key.template, now.imprint, start, gel)
        return found if found is not None and found.residual < MAX_RESIDUAL * key.template.signal else None

    def _keyframe(
        self, frame: _Frame, template: Template, motion: Floats, covariance: Floats, by_slopes: Floats
    ) -> _Keyframe:
        """A frame that others are compared with. motion : from the start to it, about the first centre."""
        center = template.center - self._origin
        about = motion.copy()
        about[:3, 3] -= center
        back = inverse(about)
        return _Keyframe(frame, template, center, about, back, adjoint(back), covariance, by_slopes)

    def _since_start(self, key: _Keyframe, found: Alignment) -> tuple[Floats, Floats, Floats]:
        """Motion, covariance and `by_slopes` from the start to now."""
        motion = found.motion @ key.motion
        motion[:3, 3] += key.center
        covariance = key.covariance + key.carry @ found.covariance @ key.carry.T
        return motion, covariance, key.by_slopes + key.carry @ (SLOPE_ERROR_PARTS * vector(found.motion))

    def _same_gel(self, before: _Frame, now: _Frame) -> Gel | None:
        """How the gel that is in contact in both frames has moved."""
        if before.gel is None or now.gel is None or before.gel[1].shape != now.gel[1].shape:
            return None
        (old_field, old_share, old_stderr), (field, new_share, stderr) = before.gel, now.gel
        both = old_share * new_share
        inside = both > 0
        total = float(both.sum())
        if not total:
            return None
        share = both[inside] / total
        rest = field.grid.points[inside] - self._scale.origin
        old, new = (as_complex(self._mm * (rest + f.displacement[inside])) for f in (old_field, field))
        fit = fit_similarity(old, new, share)
        # The residual of the rigid motion; displacements a pitch apart are independent.
        square = float(share @ np.abs(new - fit.mean) ** 2)
        stretch = (fit.spread + square) / 2 - abs(fit.slope) * fit.spread
        variance = (old_stderr**2 + stderr**2) * float(self._mm.prod()) + stretch / max(
            total * CELL_PITCHES**2, 1.0
        )
        overlap = total / float(new_share.sum())
        return Gel(fit.middle, fit.mean, cmath.phase(fit.slope), variance, fit.spread, overlap)

    def _pose(self, status: Literal["tracked", "lost"], motion: Floats, covariance: Floats) -> Pose:
        """The pose in the sensor's axes, in mm and degrees, with the error of the scale."""
        axes = np.zeros((6, 6))
        axes[:3, :3] = axes[3:, 3:] = motion[:3, :3]
        stated = axes @ covariance @ axes.T
        stated[[0, 1], [0, 1]] += (self._relative * motion[:2, 3]) ** 2
        stated *= np.outer(_TO_DEGREES, _TO_DEGREES)
        cx, cy, cz = self._origin.tolist()
        x, y, z, rx, ry, rz = (vector(motion) * _TO_DEGREES).tolist()
        return Pose(status, self._since, (cx, cy, cz), (x, y, z), (rx, ry, rz), stated)
