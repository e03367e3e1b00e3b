"""The gel: where an indenter touches it, what its surface looks like, and how its markers move.

Contact. A soft surface gives way before it is touched. Around a ball of radius R pressed by d into a deep gel
it has sunk by d / 2 at the edge of the contact, whose radius is sqrt(R d) (Hertz); a thin layer on a plate
sinks only where it is touched, and the radius is the sqrt(2 R d) of the geometric overlap (Johnson, Contact
Mechanics, 1985, ch. 4 and 5.8). The gel of a sensor is a layer of moderate depth: here it has sunk by
`SINK_IN` d at the edge, and for every shape the contact is where the indenter reaches deeper than that. There
the gel's surface is the indenter's surface. Around it the surface decays smoothly to rest, as the pyramid of
Gaussians of Taxim (Si and Yuan, "Taxim: An Example-based Simulation Model for GelSight Tactile Sensors",
RA-L 2022) makes it, but in closed form: with s = SINK_IN d it is s exp(RIM (reached / s - 1)).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactflow.sim.shapes import Array, Shape

SINK_IN = 0.3
"""Share of the depth by which the gel has sunk at the edge of a contact. Chosen by hand, between a thin layer
(0) and a deep gel (0.5)."""
RIM = 0.6
"""Slope of the surface just outside a contact, relative to just inside: the crease at the edge.
Chosen by hand."""
TOUCH_DEPTH = 0.25
"""Depth below which an indenter does not count as touching, px. Chosen by hand."""
_MOST_STICK = 0.999
"""Part of a contact's radius that sticks at most: where all sticks, the edge has a traction without bound."""
_BISECTIONS = 20
"""Steps in which the radius of a contact is found: to a millionth of an indenter's reach."""
SHEAR_SPREAD = 110.0
"""How far around a contact the gel follows its shear and twist, px (standard deviation of a Gaussian).
Chosen by hand: four to five pitches of the markers."""


@dataclass(frozen=True, slots=True)
class Press:
    """One indenter at one moment.

    x, y : its origin in gel coordinates, px. angle : rotation, radians, clockwise on the screen (y down).
    depth : px, 0 when it is off the gel.
    shear : (sx, sy) by which the gel under it has been dragged, px. twist : the same for rotation, radians.
    dilation : largest displacement by which the press pushes the gel apart, px.
    sink, rim : the gel's `SINK_IN` and `RIM`.
    stick : for a ball, radius of the part of the contact that still follows the shear over that of the whole
        contact, 0 to 1: around it the gel slips (Mindlin). None: all of the contact follows.
    sliding : whether the indenter moves on while the gel under it stays behind.
    """

    shape: Shape
    x: float
    y: float
    angle: float
    depth: float
    shear: tuple[float, float] = (0.0, 0.0)
    twist: float = 0.0
    dilation: float = 0.0
    sink: float = SINK_IN
    rim: float = RIM
    stick: float | None = None
    sliding: bool = False

    @property
    def radius(self) -> float:
        """Distance from the origin along x up to which the gel is in contact, px: the radius of a ball's."""
        near, far = 0.0, self.shape.reach
        for _ in range(_BISECTIONS):
            middle = np.array([(near + far) / 2], np.float32)
            touched = self.depth - float(self.shape.gap(middle, middle * 0)[0]) > self.sink * self.depth
            near, far = ((near + far) / 2, far) if touched else (near, (near + far) / 2)
        return near

    @property
    def stick_ratio(self) -> float:
        """Share of the contact's area on which the gel sticks to the indenter."""
        if self.sliding:
            return 0.0
        return 1.0 if self.stick is None else self.stick**2

    @property
    def touching(self) -> bool:
        """Whether it is pressed deep enough to count."""
        return self.depth > TOUCH_DEPTH


def reached(press: Press, x: Array, y: Array) -> Array:
    """Depth the indenter reaches below the untouched surface at (x, y), px; negative where it stays above."""
    cos, sin = np.float32(np.cos(press.angle)), np.float32(np.sin(press.angle))
    dx, dy = x - np.float32(press.x), y - np.float32(press.y)
    gap = press.shape.gap(dx * cos + dy * sin, dy * cos - dx * sin)
    return np.asarray(np.float32(press.depth) - gap, dtype=np.float32)


def in_contact(presses: Sequence[Press], x: Array, y: Array) -> NDArray[np.bool_]:
    """Where the gel is in contact: bool, of the shape of x and y (float32 gel coordinates, px)."""
    mask = np.zeros(x.shape, dtype=np.bool_)
    for press in presses:
        if press.touching:
            mask |= reached(press, x, y) > press.sink * press.depth
    return mask


def surface(press: Press, depth: Array) -> Array:
    """How far the gel's surface has sunk, px >= 0, from the depth that `reached` gives."""
    sink = np.float32(press.sink * press.depth)
    outside = sink * np.exp(np.float32(press.rim) * (np.minimum(depth, sink) / sink - np.float32(1.0)))
    return np.maximum(depth, outside)


def displacement(presses: Sequence[Press], rest: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 2) float64 displacement, px, of gel points whose rest positions (N, 2) are given.

    Press pushes the gel apart, shear drags it along, twist turns it about the contact, each with a Gaussian
    decay around the contact, after FOTS (Zhao et al., RA-L 2024). Shear and twist act in full within the
    push's spread around the shape and fade beyond; all fade with the depth when the contact is released.
    The spread grows with the shear so that its slope stays below 1: the gel never folds over.
    """
    moved = np.zeros_like(rest)
    for press in presses:
        if press.depth <= 0:
            continue
        grip = min(1.0, press.depth / (0.3 * press.shape.depth))
        grip = grip * grip * (3.0 - 2.0 * grip)
        shear = np.asarray(press.shear) * grip
        center = np.array([press.x, press.y]) - shear
        angle = press.angle - press.twist * grip
        cos, sin = np.cos(angle), np.sin(angle)
        own_axes = np.array([[cos, -sin], [sin, cos]])
        offset = rest - center
        local = offset @ own_axes
        if press.dilation:
            strength = press.dilation * press.depth / press.shape.depth
            moved += strength * press.shape.push(local) @ own_axes.T
        if press.shear != (0.0, 0.0) or press.twist:
            away = local[:, None, :] - press.shape.sources[None, :, :]
            distance = np.sqrt(np.min(np.sum(away * away, axis=-1), axis=1))
            beyond = np.maximum(distance - press.shape.spread, 0.0)
            spread = max(SHEAR_SPREAD, 1.2 * float(np.hypot(*shear)))
            weight = np.exp(-(beyond**2) / (2.0 * spread**2))
            if press.stick is not None:
                weight = partial_slip(distance / max(press.radius, 1e-6), press.stick)
            turn = weight * press.twist * grip
            # A turn by an angle that varies with the distance keeps areas; a faded displacement would not.
            moved[:, 0] += offset[:, 0] * (np.cos(turn) - 1.0) - offset[:, 1] * np.sin(turn)
            moved[:, 1] += offset[:, 0] * np.sin(turn) + offset[:, 1] * (np.cos(turn) - 1.0)
            moved += weight[:, None] * shear
    return moved


def partial_slip(distance: NDArray[np.float64], stick: float) -> NDArray[np.float64]:
    """How far the gel follows a ball that is dragged along, 0 to 1, where only the middle still sticks.

    distance : (N,), from the middle, in radii of the contact. stick : radius of the part that sticks, in
    radii of the contact, 0 to 1. There the result is 1; around it the gel follows less and less.

    References
    ----------
    R. D. Mindlin, "Compliance of elastic bodies in contact", J. Appl. Mech. 16 (1949); K. L. Johnson, Contact
    Mechanics (1985), ch. 7.2: the traction of full slip on the contact less one of the same form on the part
    that sticks, each with the displacement that a Hertz pressure has (eq. 3.41, 3.42).

    >>> partial_slip(np.array([0.0, 0.5, 1.0]), 0.0).tolist()
    [1.0, 0.875, 0.5]
    """
    stick = min(stick, _MOST_STICK)
    return np.asarray((_hertz(distance, 1.0) - _hertz(distance, stick)) / (2 * (1 - stick * stick)))


def _hertz(distance: NDArray[np.float64], radius: float) -> NDArray[np.float64]:
    """Form of the displacement, 1, at distances from the middle of a Hertz traction on a disc."""
    if radius <= 0:
        return np.zeros_like(distance)
    away = np.maximum(distance, radius)
    outside = (2 * radius**2 - away**2) * np.arcsin(radius / away)
    outside += radius * np.sqrt(away**2 - radius**2)
    return np.where(distance <= radius, 2 * radius**2 - distance**2, 2 / np.pi * outside)
