"""The force on the gel, linear in what is seen of the contact.

An elastic gel answers to a press in one of two ways. A layer that is thin compared with the contact is a bed
of springs: the force is proportional to the volume that is indented in the contact (Winkler). In a deep one
it is proportional to depth times width, for a ball (Hertz) as for a flat punch. A real gel lies between the
two, and so do linear combinations of both. The area is there for objects that are softer than the gel, which
spread instead of sinking in. Where heights are not known, the change of the light stands for them: under a
ball the integral of the slopes is proportional to Hertz's force.

Sideways it is the same: a thin layer answers with the integral of the shear over the contact, a deep one with
shear times width (Mindlin).

References
----------
K. L. Johnson, Contact Mechanics (1985): ch. 3.4, 4.2 and 4.3, 7.2.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.types import Contact, Depth, Flow, Force, Scale

BY_DEPTH: Final = ("volume", "depth_by_width", "area")
"""What the force is linear in where heights are known: mm^3, mm^2, mm^2."""
BY_CHANGE: Final = ("change", "area")
"""The same without heights: grey levels times mm^2, mm^2."""
BY_SHEAR: Final = ("shear_by_area", "shear_by_width")
"""What the force sideways is linear in, along x and y: mm^3, mm^2."""
EVERY_ROW: Final = 4
"""The change of the light is summed over every so many rows: contacts are far larger, and all rows would cost
0.2 copies of a raw frame of 800 x 600 px."""
BEYOND: Final = 1.1
"""How far beyond the largest contact of the fit a contact may be to count as in range, relative. By hand."""


class Seen(NamedTuple):
    """What is seen of a contact that tells of its force.

    press : name -> value, those of `BY_DEPTH` and `BY_CHANGE` that are known. drag : name -> (x, y), those of
    `BY_SHEAR`; empty where the flow is not known.
    """

    press: dict[str, float]
    drag: dict[str, tuple[float, float]]


def total_change(image: NDArray[np.uint8], untouched: NDArray[np.uint8]) -> float:
    """Sum of all differences between two pictures, (H, W, 3) uint8 without markers, grey levels.

    It is the sum over every `EVERY_ROW`-th row, times that.

    >>> total_change(np.full((8, 2, 3), 7, np.uint8), np.full((8, 2, 3), 9, np.uint8))
    96.0
    """
    return EVERY_ROW * float(cv2.norm(image[::EVERY_ROW], untouched[::EVERY_ROW], cv2.NORM_L1))


def seen(contact: Contact, scale: Scale, depth: Depth | None, change: float, flow: Flow | None) -> Seen:
    """What is seen of a contact.

    contact : with its hull's area. change : less that of a gel which nothing touches, grey levels times mm^2.

    >>> contact = Contact(400.0, (0, 0), None, None, np.zeros((0, 2)), None)
    >>> found = seen(contact, Scale(0.1, 0.1, (0, 0), (0, 0)), None, 5.0, Flow((3.0, 0.0), 4))
    >>> {name: round(value, 6) for name, value in found.press.items()}
    {'area': 4.0, 'change': 5.0}
    >>> [round(x, 6) for x, _ in found.drag.values()]
    [1.2, 0.6]
    """
    area = scale.area(contact.area)
    width = math.sqrt(area)
    press = {"area": area, "change": max(change, 0.0)}
    if depth is not None:
        press["volume"] = depth.pressed
        press["depth_by_width"] = depth.greatest * width
    if flow is None or flow.mean is None:
        return Seen(press, {})
    x, y = scale.vector(flow.mean)
    return Seen(press, {"shear_by_area": (x * area, y * area), "shear_by_width": (x * width, y * width)})


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
class ForceModel:
    """The force on the gel from what is seen of a contact.

    press : of z. drag : of x and of y, the same for both; None where the calibration had no such reference.
    change_at_rest : the change of a gel that nothing touches, from noise alone, grey levels times mm^2.

    >>> model = ForceModel(LinearForce({"volume": 2.0}, {"volume": 1.0}, (0.1, 0.0)), None, 0.0)
    >>> model.force(Seen({"volume": 0.5, "area": 3.0}, {}))
    Force(value=(None, None, 1.0), stderr=(None, None, 0.1), in_range=True)
    """

    press: LinearForce
    drag: LinearForce | None
    change_at_rest: float

    @property
    def needs_depth(self) -> bool:
        """Whether it is no use without heights."""
        return "change" not in self.press.stiffness

    def force(self, contact: Seen) -> Force:
        """The force of a contact. Raises KeyError where a feature of the press is missing."""
        pressed = self.press.value(contact.press)
        in_range = self.press.knows(contact.press)
        if self.drag is None or not contact.drag:
            return Force((None, None, pressed), (None, None, self.press.stderr(pressed)), in_range)
        along = [{name: vector[axis] for name, vector in contact.drag.items()} for axis in (0, 1)]
        x, y = (self.drag.value(features) for features in along)
        in_range = in_range and all(self.drag.knows(features) for features in along)
        stderr = (self.drag.stderr(x), self.drag.stderr(y), self.press.stderr(pressed))
        return Force((x, y, pressed), stderr, in_range)
