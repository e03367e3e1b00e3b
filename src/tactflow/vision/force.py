"""The force on the gel, linear in what is seen of the contact.

An elastic gel responds to a press in one of two ways. A layer that is thin compared with the contact is a bed
of springs: the force is proportional to the volume that is indented in the contact (Winkler). In a deep one
it is proportional to depth times width, for a ball (Hertz) as for a flat punch. A real gel lies between the
two, and so do linear combinations of both. The area is included for objects softer than the gel, which spread
instead of sinking in. Where heights are not known, the change of the light of the whole gel replaces them: an
incompressible gel bulges where it is not pressed, under a soft object more visibly than it sinks in. Under a
ball the integral of the slopes is proportional to Hertz's force; under an object softer than the gel there
are few slopes, and the force follows the changed area. The integral of the square root of the change lies
between the two, and steep slopes, whose light saturates, do not outweigh all others.

Sideways it is the same: the force on a thin layer is the integral of the shear over the contact, that on a
deep one shear times width (Mindlin). The same stiffness resists a twist: for a round contact of radius a, the
torque per rad is the stiffness to shear times a^2 / 2 on a thin layer, whose springs each resist their own
motion, and times a^2 on a deep gel, if that is incompressible and sticks to the object (Reissner and Sagoci).

Where there are dots, `tactflow.vision.field_force` measures the force on the whole gel without a contact.

References
----------
K. L. Johnson, Contact Mechanics (1985): ch. 3.4, 3.7 and 3.9, 4.2 and 4.3, 7.2.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.arrays import Floats, check_color_image
from tactflow.vision.contact.cells import MASKED_MEAN_GREY, to_cells, to_planes
from tactflow.vision.contact.illumination import IlluminationModel, under_illumination
from tactflow.vision.field_force import FieldForce
from tactflow.vision.geometry.valid_area import valid_area
from tactflow.vision.types import Contact, Depth, Flow, Force, Scale

BY_DEPTH: Final = ("volume", "depth_by_width", "area")
"""Features of the force where heights are known: mm^3, mm^2, mm^2."""
BY_CHANGE: Final = ("root_change",)
"""The same without heights: mm^2."""
BY_SHEAR: Final = ("shear_by_area", "shear_by_width")
"""Features of the force sideways, along x and y: mm^3, mm^2."""
CELLS: Final = 80
"""Cells along the longer side of a picture, over which its light is averaged: smaller than most contacts, and
large enough to average noise out. The errors on real grasps are the same with 40."""
FAINT: Final = 0.02
"""Relative change due to noise and the fit of the lamps; a smaller change counts less than its root. The
errors on real grasps are the same from 0.01 to 0.02; those on another day grow from 0.04 on."""
BEYOND: Final = 1.1
"""Largest feature of a contact, or force by dots, in range, over the largest of the fit. Chosen by hand."""


class Seen(NamedTuple):
    """Features of a contact that determine its force.

    press : name -> value, those of `BY_DEPTH` and `BY_CHANGE` that are known. drag : name -> (x, y), those of
    `BY_SHEAR`; empty where the flow is not known. twist : the same for the torque about z, times mm rad;
    empty where the rotation is not known.
    """

    press: dict[str, float]
    drag: dict[str, tuple[float, float]]
    twist: Mapping[str, float] = {}


class LightChange:
    """How much the light of a gel has changed, against an untouched one.

    Lamps, exposure and white balance are fitted and removed first (`IlluminationModel`): on a gripper they
    change within a grasp by as much as a light contact does.

    untouched : (H, W, 3) uint8 without markers. What it does not show as gel (`valid_area`) does not count.

    >>> gel = np.full((60, 80, 3), 100, np.uint8)
    >>> pressed = gel.copy()
    >>> pressed[20:30, 40:60] += 25
    >>> change = LightChange(gel)
    >>> round(change(pressed), -1), round(change(gel // 2), -1)
    (150.0, 0.0)
    """

    def __init__(self, untouched: NDArray[np.uint8]) -> None:
        check_color_image(untouched)
        self.untouched = untouched
        height, width = untouched.shape[:2]
        side = max(1, round(max(height, width) / CELLS))
        self._size = max(1, height // side), max(1, width // side)
        self._light = to_planes(untouched, self._size)
        self._gel = to_cells(valid_area(untouched), self._size) > MASKED_MEAN_GREY
        self._illumination = IlluminationModel(self._light, np.ones_like(self._light), self._gel)

    def __call__(self, image: NDArray[np.uint8]) -> float:
        """The mean over the gel of the square root of the change, times the area of (H, W, 3) uint8, px^2.

        The change is relative to the mean brightness of the gel: relative to itself, a dark place that a
        tilt lights up would outweigh all others. It is a mean, since where the gel ends in the dark differs
        from one reference to the next.
        """
        check_color_image(image)
        light = to_planes(image, self._size)
        lit = under_illumination(self._light, self._illumination.fit(light))[:, self._gel]
        brightness = max(float(lit.mean()), 1.0)
        change = np.linalg.norm(light[:, self._gel] - lit, axis=0) / np.float32(brightness)
        root = np.sqrt(np.hypot(change, np.float32(FAINT)) - np.float32(FAINT))
        return float(root.mean()) * float(image.shape[0] * image.shape[1])


def seen_without_contact(change: float) -> Seen:
    """Features of a gel in which no contact is found. change : as in `seen`, mm^2."""
    return Seen({"root_change": max(change, 0.0)}, {})


def seen(contact: Contact, scale: Scale, depth: Depth | None, change: float, flow: Flow | None) -> Seen:
    """Features of a contact.

    contact : with its hull's area. change : of the light less that of a gel which nothing touches, mm^2.

    >>> contact = Contact(400.0, (0, 0), None, None, np.zeros((0, 2)), None)
    >>> found = seen(contact, Scale(0.1, 0.1, (0, 0), (0, 0)), None, 5.0, Flow((3.0, 0.0), 4))
    >>> {name: round(value, 6) for name, value in found.press.items()}
    {'root_change': 5.0}
    >>> [round(x, 6) for x, _ in found.drag.values()]
    [1.2, 0.6]
    """
    area = scale.area(contact.area)
    width = math.sqrt(area)
    press = {"root_change": max(change, 0.0)}
    if depth is not None:
        press |= {"volume": depth.pressed, "depth_by_width": depth.greatest * width, "area": area}
    if flow is None or flow.mean is None:
        return Seen(press, {})
    x, y = scale.vector(flow.mean)
    drag = {"shear_by_area": (x * area, y * area), "shear_by_width": (x * width, y * width)}
    if flow.rotation is None:
        return Seen(press, drag)
    # Counter-clockwise as seen is against z, which points away from the camera.
    turned, radius2 = -math.radians(flow.rotation), area / math.pi
    twist = {"shear_by_area": turned * radius2 / 2 * area, "shear_by_width": turned * radius2 * width}
    return Seen(press, drag, twist)


@dataclass(frozen=True, slots=True)
class LinearForce:
    """A force that is the sum of features, each times its stiffness.

    stiffness : feature -> N per unit of it, >= 0. greatest : feature -> the largest that it was fitted to.
    error : (absolute, relative): the standard error at a force F is hypot(absolute, relative F), N and 1.
    """

    stiffness: Mapping[str, float]
    greatest: Mapping[str, float]
    error: tuple[float, float]

    def value(self, features: Mapping[str, float]) -> float:
        """The force, N. Raises KeyError where a feature is missing."""
        return sum(stiffness * features[name] for name, stiffness in self.stiffness.items())

    def stderr(self, value: float) -> float:
        """Standard error of a force, N."""
        return math.hypot(self.error[0], self.error[1] * value)

    def knows(self, features: Mapping[str, float]) -> bool:
        """Whether no feature is farther than `BEYOND` from what was fitted."""
        return all(abs(features[name]) <= BEYOND * largest for name, largest in self.greatest.items())


@dataclass(frozen=True, slots=True)
class Accuracy:
    """How well one component is known by the dots.

    error : (absolute, relative): the standard error is hypot(absolute, relative |F|), with |F| the length of
    the force as far as it is known. greatest : largest force of the fit, N.
    """

    error: tuple[float, float]
    greatest: float

    def stderr(self, length: float) -> float:
        """Standard error, N, where the whole force has a length, N."""
        return math.hypot(self.error[0], self.error[1] * length)

    def knows(self, value: float) -> bool:
        """Whether the force is no farther than `BEYOND` from those of the fit."""
        return abs(value) <= BEYOND * self.greatest


@dataclass(frozen=True, slots=True)
class DotsForce:
    """The force by the dots. field : of the displacement. accuracy : of x, y and z; None: not known."""

    field: FieldForce
    accuracy: tuple[Accuracy | None, Accuracy | None, Accuracy | None]


@dataclass(frozen=True, slots=True)
class ForceModel:
    """The force on the gel from what is seen of a contact, from its dots, or from both.

    press : of z; None: the dots give it. drag : of x and of y, the same for both, and of the torque; None
    where the calibration had no such reference. change_at_rest : the change of a gel that nothing touches,
    from noise alone, mm^2. least_change : beyond it, from which the change is a force though no contact is
    found, as under a soft object that covers all of the gel, mm^2; None: it never is. dots : None without;
    what they give counts before drag.

    >>> model = ForceModel(LinearForce({"volume": 2.0}, {"volume": 1.0}, (0.1, 0.0)), None, 0.0)
    >>> model.force(Seen({"volume": 0.5, "area": 3.0}, {}))
    Force(value=(None, None, 1.0), stderr=(None, None, 0.1), in_range=True, torque=None, as_calibrated=True)
    """

    press: LinearForce | None
    drag: LinearForce | None
    change_at_rest: float
    least_change: float | None = None
    dots: DotsForce | None = None

    @property
    def needs_depth(self) -> bool:
        """Whether it is no use without heights."""
        return self.press is not None and "root_change" not in self.press.stiffness

    def force(self, contact: Seen, moved: Floats | None = None) -> Force:
        """The force of a contact. moved : (S, 2) float64, mm, see `field_force.displacement`; None: unknown.

        Raises KeyError where a feature of the press is missing, ValueError where the press is by dots and
        these are unknown.
        """
        components = self._by_dots(moved)
        if self.press is not None:
            pressed = self.press.value(contact.press)
            components[2] = pressed, self.press.stderr(pressed), self.press.knows(contact.press)
        if self.drag is not None and contact.drag and components[0] is None:
            for axis in (0, 1):
                along = {name: vector[axis] for name, vector in contact.drag.items()}
                dragged = self.drag.value(along)
                components[axis] = dragged, self.drag.stderr(dragged), self.drag.knows(along)
        x, y, z = components
        if z is None:
            raise ValueError("required the displacement of the dots, by which this calibration measures")
        return Force(
            (x and x[0], y and y[0], z[0]),
            (x and x[1], y and y[1], z[1]),
            all(component is None or component[2] for component in components),
            self.drag.value(contact.twist) if self.drag is not None and contact.twist else None,
        )

    def _by_dots(self, moved: Floats | None) -> list[tuple[float, float, bool] | None]:
        """Value and standard error, N, of x, y and z, and whether they are in range."""
        if self.dots is None or moved is None:
            return [None, None, None]
        values = self.dots.field(moved).tolist()
        # Nothing pulls at the gel; without this, noise at rest would.
        values[2] = max(values[2], 0.0)
        length = math.hypot(*(value for value in values if math.isfinite(value)))
        return [
            None if accuracy is None else (value, accuracy.stderr(length), accuracy.knows(value))
            for value, accuracy in zip(values, self.dots.accuracy, strict=True)
        ]


def widened(force: Force, drift: float) -> Force:
    """A force by a gel that answers otherwise than in its calibration. drift : relative difference, 0: none.

    >>> widened(Force((None, None, 4.0), (None, None, 0.3), True), 0.1).stderr
    (None, None, 0.5)
    """
    if not drift:
        return force
    x, y, z = (
        None if value is None or error is None else math.hypot(error, drift * value)
        for value, error in zip(force.value, force.stderr, strict=True)
    )
    return replace(force, stderr=(x, y, math.nan if z is None else z), as_calibrated=False)
