"""What the vision functions return.

Coordinates are pixels of the processed frame, x right, y down, with the centre of the top-left pixel at
(0, 0). Angles are degrees, counter-clockwise as seen on the screen from the +x axis, in (-90, 90].
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Evidence = Literal["light", "dots", "both"]
"""What shows a contact: a change of the light, motion of the markers, or both."""


class MarkerStatus(IntEnum):
    """How a marker's position is known.

    >>> MarkerStatus(1).name
    'INFERRED'
    """

    TRACKED = 0
    """Seen in this frame."""
    INFERRED = 1
    """Not seen in this frame; placed from its neighbours."""
    LOST = 2
    """The position is the last known or inferred one; do not trust it."""


@dataclass(frozen=True, slots=True)
class Ellipse:
    """An ellipse.

    Attributes
    ----------
    center : (x, y), px.
    axes : full lengths (major, minor), px, major >= minor > 0.
    angle : of the major axis, degrees in (-90, 90]; None for a circle.
    """

    center: tuple[float, float]
    axes: tuple[float, float]
    angle: float | None


@dataclass(frozen=True, slots=True)
class Contact:
    """Geometry of the contact region.

    Attributes
    ----------
    area : of the convex hull of the imprint up to its outer edge, px^2, >= 0.
    center : centroid (x, y) of the contact region itself, px.
    angle : principal axis of the region, degrees in (-90, 90]; None where the region has no direction.
    slope : dy/dx of that axis in image coordinates (y down), -tan(angle); None where vertical or
        undirected.
    hull : (N, 2) float64, vertices of the convex hull in order, px.
    ellipse : fitted ellipse, or None where none can be fitted.
    confidence : of the direction, in [0, 1]: 0 for a disc, towards 1 for a line.
    region_area : number of pixels of the region, px^2.
    evidence : what shows it.
    probability : of being a contact, 0 to 1; None where that is not known.
    separate : every separate contact of the frame, that with the most pixels first; empty where there is
        only this one.
    core_area : of the convex hull of the core, where the gel clings to the object, px^2: `area` is of the
        whole imprint. None where that is not known.

    Examples
    --------
    >>> square = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0]])
    >>> Contact(4.0, (1.0, 1.0), None, None, square, None).center
    (1.0, 1.0)
    """

    area: float
    center: tuple[float, float]
    angle: float | None
    slope: float | None
    hull: NDArray[np.float64]
    ellipse: Ellipse | None
    confidence: float = 0.0
    region_area: float = 0.0
    evidence: Evidence = "light"
    probability: float | None = None
    separate: tuple[Contact, ...] = ()
    core_area: float | None = None


@dataclass(frozen=True, slots=True)
class Markers:
    """The markers of the reference frame, now. Index i is the same physical marker for the whole run.

    Markers that are found later come last.

    Attributes
    ----------
    origin : (N, 2) float64, position in the reference frame, px.
    position : (N, 2) float64, position in this frame, px. Finite for every status.
    status : (N,) uint8, values of `MarkerStatus`.
    stderr : (N,) float64, standard error of each coordinate of `position`, px; NaN where unknown.
    radius : of a marker in the reference frame, px; None where the method does not know it.
    probability : (N,) float64, of being a marker at all, 0 to 1, by its looks in the reference frame and
        its motion since; NaN where unknown. None where the method does not tell.

    Examples
    --------
    >>> origin = np.array([[10.0, 20.0]])
    >>> markers = Markers(origin, origin + [1.0, 0.5], np.zeros(1, np.uint8), np.array([0.01]))
    >>> markers.displacement
    array([[1. , 0.5]])
    """

    origin: NDArray[np.float64]
    position: NDArray[np.float64]
    status: NDArray[np.uint8]
    stderr: NDArray[np.float64]
    radius: float | None = None
    probability: NDArray[np.float64] | None = None

    @property
    def displacement(self) -> NDArray[np.float64]:
        """(N, 2) float64, position - origin, px."""
        return self.position - self.origin


@dataclass(frozen=True, slots=True)
class Flow:
    """How the gel inside the contact has moved.

    Attributes
    ----------
    mean : (dx, dy), px: the mean displacement; None where it is not known, as where count is 0.
    count : number of markers inside. A mean over markers is one of so many; that of the displacement field
        also rests on markers around.
    stderr : (dx, dy) standard error of the mean, px; None when unknown.
    rotation : in-plane rotation (twist), degrees, counter-clockwise as seen on the screen; None with fewer
        than 3 markers, where they do not span a plane, or for a contact too small to tell.
    divergence : relative growth in area (press), 1; None where rotation is None.
    residual : RMS of what mean, rotation and divergence leave unexplained, px; None where rotation is None.
    shear : (du/dx - dv/dy, du/dy + dv/dx) of the displacement (u, v), 1; None where no field is known.
    rotation_stderr : degrees.
    divergence_stderr : 1.
    shear_stderr : of each part, 1. None where unknown.

    Examples
    --------
    >>> Flow((1.2, -0.3), 9).mean
    (1.2, -0.3)
    """

    mean: tuple[float, float] | None
    count: int
    stderr: tuple[float, float] | None = None
    rotation: float | None = None
    divergence: float | None = None
    residual: float | None = None
    shear: tuple[float, float] | None = None
    rotation_stderr: float | None = None
    divergence_stderr: float | None = None
    shear_stderr: float | None = None


SlipKind = Literal["creeping", "sliding", "lost"]
"""How an object slips: slowly; fast; so fast that its picture cannot be followed."""


@dataclass(frozen=True, slots=True)
class Slip:
    """Motion of the object relative to the gel.

    Attributes
    ----------
    slipping : whether slip is reported: two of three frames have clearly shown it. A gripper may act on it.
    stick_ratio : share of the contact on which the gel still moves with it, 0 to 1; 0 while it slides.
    probability : that it slips, from all frames up to now, 0 to 1: that it moves farther over the gel in
        0.1 s than a contact that sticks, and in the direction in which it drags the gel; or that its picture
        was lost while it dragged the gel.
    translation : (x, y), px: how far the middle of the contact has moved over the gel since frame `since`.
    rotation : how far it has turned on the gel since then, degrees, counter-clockwise as seen on the
        screen.
    speed : RMS over the contact in the last 0.1 s, px/s; None in the first frame.
    since : seq of the frame in which it was touched, or measured anew.
    translation_stderr : (x, y), px.
    rotation_stderr : degrees.
    speed_stderr : px/s. Standard errors; None where unknown.
    kind : of the slip that is reported: creeping; sliding, which is faster; lost, where the picture changes
        within a frame so much that no motion explains it. None without a report.
    onset : time of the first frame of the slip that is reported, s, as the time of a frame.

    Examples
    --------
    >>> Slip(False, 0.7).stick_ratio
    0.7
    """

    slipping: bool
    stick_ratio: float
    probability: float | None = None
    translation: tuple[float, float] | None = None
    rotation: float | None = None
    speed: float | None = None
    since: int | None = None
    translation_stderr: tuple[float, float] | None = None
    rotation_stderr: float | None = None
    speed_stderr: float | None = None
    kind: SlipKind | None = None
    onset: float | None = None


@dataclass(frozen=True, slots=True)
class Scale:
    """Millimetres of the gel's surface per pixel of the processed frame.

    The axes of the mm coordinates are those of the picture, x right and y down; z points out of the gel,
    away from the camera and towards the object, so that the three are right-handed.

    Attributes
    ----------
    x, y : mm per px along each axis of the picture, > 0.
    stderr : (x, y) of their standard errors, mm per px.
    origin : (x, y), px: where the mm coordinates are 0.

    Examples
    --------
    >>> scale = Scale(0.1, 0.1, (0.001, 0.001), (159.5, 119.5))
    >>> scale.point((169.5, 119.5)), scale.area(100.0)
    ((1.0, 0.0), 1.0)
    >>> round(scale.point_stderr((169.5, 119.5))[0], 3)
    0.01
    """

    x: float
    y: float
    stderr: tuple[float, float]
    origin: tuple[float, float]

    def point(self, place: tuple[float, float]) -> tuple[float, float]:
        """(x, y), mm, of a place (x, y), px."""
        return self.vector((place[0] - self.origin[0], place[1] - self.origin[1]))

    def point_stderr(self, place: tuple[float, float]) -> tuple[float, float]:
        """What the scale's own error does to `point`, mm; 0 at the origin."""
        return self.vector_stderr((place[0] - self.origin[0], place[1] - self.origin[1]))

    def vector(self, moved: tuple[float, float]) -> tuple[float, float]:
        """(x, y), mm, of a displacement (x, y), px."""
        return (moved[0] * self.x, moved[1] * self.y)

    def vector_stderr(
        self, moved: tuple[float, float], own: tuple[float, float] = (0.0, 0.0)
    ) -> tuple[float, float]:
        """Standard error of `vector`, mm. own : of the displacement itself, px."""
        return (
            math.hypot(moved[0] * self.stderr[0], own[0] * self.x),
            math.hypot(moved[1] * self.stderr[1], own[1] * self.y),
        )

    def area(self, pixels: float) -> float:
        """Mm^2 of an area of so many px^2."""
        return pixels * self.x * self.y

    def area_stderr(self, pixels: float) -> float:
        """What the scale's own error does to `area`, mm^2."""
        return self.area(pixels) * math.hypot(self.stderr[0] / self.x, self.stderr[1] / self.y)


@dataclass(frozen=True, slots=True)
class Depth:
    """How far the gel's surface has been pushed in.

    Attributes
    ----------
    heights : (H, W) float32, mm, >= 0; 0 where nothing touches. Of the processed frame's size.
    greatest : the largest of them, mm.
    greatest_stderr : its standard error, mm; None where unknown.
    volume : between the untouched surface and this one, mm^3.
    volume_stderr : the same for it.
    pressed : the part of the volume that lies in the contact, mm^3.

    Examples
    --------
    >>> Depth(np.zeros((2, 3), np.float32), 0.0, None, 0.0, None).heights.shape
    (2, 3)
    """

    heights: NDArray[np.float32]
    greatest: float
    greatest_stderr: float | None
    volume: float
    volume_stderr: float | None
    pressed: float = 0.0


@dataclass(frozen=True, slots=True)
class Force:
    """The force on the gel.

    Attributes
    ----------
    value : (x, y, z), N, along the axes of `Scale`: z is how hard the object presses, >= 0; x and y are how
        it drags the gel. None for a component that the calibration does not know.
    stderr : standard error of each component, N; None where `value` is, NaN where it is not known.
    in_range : whether the contact, or the force by dots, is like those the calibration was fitted to;
        `stderr` only holds there.
    torque : on the gel about z, through the middle of the contact, N mm, positive from x to y: what the
        elasticity of a round contact gives for the twist of the gel. None where that, or `value` of x and y,
        is not known.
    as_calibrated : false where the gel at rest, or a known load, differs from the calibration; `stderr`
        is wider then.

    Examples
    --------
    >>> Force((None, None, 2.5), (None, None, 0.2), True).value[2]
    2.5
    """

    value: tuple[float | None, float | None, float]
    stderr: tuple[float | None, float | None, float]
    in_range: bool
    torque: float | None = None
    as_calibrated: bool = True


@dataclass(frozen=True, slots=True)
class Pose:
    """How an object has moved since it was touched.

    Attributes
    ----------
    status : "tracked", or "lost" where what touches the gel now cannot be matched; then the motion is that
        of the last frame before, and the next frame is a new start.
    since : seq of the frame in which it started.
    center : (x, y, z), mm, the middle of the contact in that frame, in the axes of `Scale`. The object's
        own axes were parallel to these, from there.
    translation : (x, y, z), mm, by how much this point of the object has moved since.
    rotation : (x, y, z), degrees, rotation vector of the object about it.
    covariance : (6, 6) float64, of translation (mm) and of a small rotation about the axes of the sensor
        (degrees). What is not seen has large variances: 57 degrees, and as many mm as that turns the
        object's surface by.

    Examples
    --------
    >>> Pose("tracked", 12, (0, 0, -0.3), (0.1, 0, 0), (0, 0, 5), np.eye(6)).stderr[0]
    1.0
    """

    status: Literal["tracked", "lost"]
    since: int
    center: tuple[float, float, float]
    translation: tuple[float, float, float]
    rotation: tuple[float, float, float]
    covariance: NDArray[np.float64]

    @property
    def stderr(self) -> tuple[float, ...]:
        """Standard errors of translation (mm) and rotation (degrees)."""
        return tuple(np.sqrt(np.diag(self.covariance)).tolist())


@dataclass(frozen=True, slots=True)
class Features:
    """What a network says about a frame, in numbers of its own.

    Attributes
    ----------
    values : (N,) float32.
    unit : of them.

    Examples
    --------
    >>> Features(np.zeros(2, np.float32), "1").values.shape
    (2,)
    """

    values: NDArray[np.float32]
    unit: str
