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
            turn = weight * press.twist * grip
            # A turn by an angle that varies with the distance keeps areas; a faded displacement would not.
            moved[:, 0] += offset[:, 0] * (np.cos(turn) - 1.0) - offset[:, 1] * np.sin(turn)
            moved[:, 1] += offset[:, 0] * np.sin(turn) + offset[:, 1] * (np.cos(turn) - 1.0)
            moved += weight[:, None] * shear
    return moved
