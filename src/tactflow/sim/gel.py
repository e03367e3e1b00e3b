"""The gel: contact region, surface and displacement under an indenter.

Contact is where the indenter lies below the surface of the untouched gel. It need not touch the gel there,
since a soft surface sinks: when a ball of radius R is pressed by d into a deep gel, that region has a
radius of sqrt(2 R d), but the gel clings to the ball only up to sqrt(R d), where the surface has sunk by d
/ 2 (Hertz); a thin layer on a plate sinks only where it is touched, so the two regions are the same
(Johnson, Contact Mechanics, 1985, ch. 4 and 5.8). A sensor's gel is in between: here it sinks by s =
SINK_IN_RATIO d where it leaves the indenter, for every shape. Deeper parts have the surface of the indenter
and carry the force. Around them, the surface decays as s exp(RIM_SLOPE_RATIO (reached / s - 1)), a closed
form of the Gaussian pyramid of Taxim (Si and Yuan, "Taxim: An Example-based Simulation Model for GelSight
Tactile Sensors", RA-L 2022).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactflow.sim.shapes import Shape
from tactflow.vision.arrays import Floats32

SINK_IN_RATIO = 0.3
"""Depth of the surface where it leaves the indenter, relative to full depth. Chosen by hand, between a thin
layer (0) and a deep gel (0.5)."""
RIM_SLOPE_RATIO = 0.6
"""Slope of the surface just outside that border relative to just inside; below 1 there is a crease. Chosen by
hand."""
TOUCH_DEPTH_PX = 0.25
"""Depth below which an indenter does not count as touching, px. Chosen by hand."""
_MAX_STICK_RADIUS = 0.999
"""Maximum relative radius of the stick region: with full stick, traction at the edge would be infinite."""
_BISECTIONS = 20
"""Bisection steps for the radius of a contact: to a millionth of an indenter's reach."""
SHEAR_SPREAD_PX = 110.0
"""Standard deviation of the Gaussian decay of shear and twist around a contact, px. Chosen by hand: four to
five marker pitches."""
MM_PER_PX = 0.025
"""Millimetres per raw pixel of the simulated gel: its balls have a radius of 2.375 mm."""
_STIFFNESS_N_PER_MM3 = 1.0
"""Pressure per depth, N/mm^3: a 3 mm layer with a constrained modulus of 3 N/mm^2. Chosen by hand."""
_SHEAR_STIFFNESS_N_PER_MM3 = 0.1
"""Traction per displacement along the gel, N/mm^3. Chosen by hand."""
_FORCE_STEP_PX = 3.0
"""Grid spacing for pressure and traction, px: halving it changes the force by less than 0.2 %."""


@dataclass(frozen=True, slots=True)
class Press:
    """One indenter at one moment.

    Attributes
    ----------
    x, y : its origin in gel coordinates, px.
    angle : rotation, radians, clockwise on the screen (y down).
    depth : px, 0 off the gel.
    shear : (sx, sy), displacement of the gel under it, px.
    twist : rotation of the gel under it, radians.
    dilation : maximum outward displacement of the gel, px.
    sink, rim : `SINK_IN_RATIO` and `RIM_SLOPE_RATIO`.
    stick : for a ball, radius of the stick region relative to `radius`, 0 to 1, with slip around it
        (Mindlin). None: no slip.
    sliding : whether the indenter moves relative to the gel under it.
    tilt : rotation vector about the indenter's centre before it was turned by `angle`, radians; `shape` is
        the one after that.
    """

    shape: Shape
    x: float
    y: float
    angle: float
    depth: float
    shear: tuple[float, float] = (0.0, 0.0)
    twist: float = 0.0
    dilation: float = 0.0
    sink: float = SINK_IN_RATIO
    rim: float = RIM_SLOPE_RATIO
    stick: float | None = None
    sliding: bool = False
    tilt: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def radius(self) -> float:
        """How far along x the gel clings to it, px: for a ball, the radius of the disc that carries force."""
        near, far = 0.0, self.shape.reach
        for _ in range(_BISECTIONS):
            middle = np.array([(near + far) / 2], np.float32)
            touched = self.depth - float(self.shape.gap(middle, middle * 0)[0]) > self.sink * self.depth
            near, far = ((near + far) / 2, far) if touched else (near, (near + far) / 2)
        return near

    @property
    def stick_ratio(self) -> float:
        """Share of the area that clings to the indenter which sticks."""
        if self.sliding:
            return 0.0
        return 1.0 if self.stick is None else self.stick**2

    @property
    def touching(self) -> bool:
        """Whether it is pressed deep enough to count."""
        return self.depth > TOUCH_DEPTH_PX


def reached(press: Press, x: Floats32, y: Floats32) -> Floats32:
    """Depth of the indenter below the untouched surface at (x, y), px; negative above it."""
    cos, sin = np.float32(np.cos(press.angle)), np.float32(np.sin(press.angle))
    dx, dy = x - np.float32(press.x), y - np.float32(press.y)
    gap = press.shape.gap(dx * cos + dy * sin, dy * cos - dx * sin)
    return np.asarray(np.float32(press.depth) - gap, dtype=np.float32)


def in_contact(presses: Sequence[Press], x: Floats32, y: Floats32) -> NDArray[np.bool_]:
    """Whether an indenter lies below the untouched surface at gel coordinates x, y (float32, px)."""
    mask = np.zeros(x.shape, dtype=np.bool_)
    for press in presses:
        if press.touching:
            mask |= reached(press, x, y) > 0
    return mask


def surface(press: Press, depth: Floats32) -> Floats32:
    """Depth of the gel's surface, px >= 0, from the result of `reached`."""
    sink = np.float32(press.sink * press.depth)
    outside = sink * np.exp(np.float32(press.rim) * (np.minimum(depth, sink) / sink - np.float32(1.0)))
    return np.maximum(depth, outside)


def displacement(presses: Sequence[Press], rest: NDArray[np.float64]) -> NDArray[np.float64]:
    """Displacement (N, 2) float64, px, of gel points with rest positions (N, 2).

    The sum of dilation, shear and twist, each with a Gaussian decay around the contact, after FOTS (Zhao et
    al., RA-L 2024). Shear and twist are constant within the shape's spread; all terms vanish with the depth
    on release. The spread grows with the shear to keep its slope below 1, so that the gel never folds.
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
            spread = max(SHEAR_SPREAD_PX, 1.2 * float(np.hypot(*shear)))
            weight = np.exp(-(beyond**2) / (2.0 * spread**2))
            if press.stick is not None:
                weight = partial_slip(distance / max(press.radius, 1e-6), press.stick)
            turn = weight * press.twist * grip
            # Scaling the angle, not the displacement, preserves areas.
            moved[:, 0] += offset[:, 0] * (np.cos(turn) - 1.0) - offset[:, 1] * np.sin(turn)
            moved[:, 1] += offset[:, 0] * np.sin(turn) + offset[:, 1] * (np.cos(turn) - 1.0)
            moved += weight[:, None] * shear
    return moved


def partial_slip(distance: NDArray[np.float64], stick: float) -> NDArray[np.float64]:
    """Relative displacement of the gel under a dragged ball with partial slip: 1 in the stick region, less
    outside.

    distance : (N,), from the centre, in contact radii. stick : radius of the stick region in contact radii, 0
    to 1.

    References
    ----------
    R. D. Mindlin, "Compliance of elastic bodies in contact", J. Appl. Mech. 16 (1949); K. L. Johnson, Contact
    Mechanics (1985), ch. 7.2: the traction of full slip on the contact minus one of the same form on the
    stick region, with the displacements of Hertz pressures (eq. 3.41, 3.42).

    >>> partial_slip(np.array([0.0, 0.5, 1.0]), 0.0).tolist()
    [1.0, 0.875, 0.5]
    """
    stick = min(stick, _MAX_STICK_RADIUS)
    return np.asarray((_hertz(distance, 1.0) - _hertz(distance, stick)) / (2 * (1 - stick * stick)))


def _hertz(distance: NDArray[np.float64], radius: float) -> NDArray[np.float64]:
    """Unnormalised displacement at distances from the centre of a Hertz traction on a disc."""
    if radius <= 0:
        return np.zeros_like(distance)
    away = np.maximum(distance, radius)
    outside = (2 * radius**2 - away**2) * np.arcsin(radius / away)
    outside += radius * np.sqrt(away**2 - radius**2)
    return np.where(distance <= radius, 2 * radius**2 - distance**2, 2 / np.pi * outside)


def force(presses: Sequence[Press]) -> tuple[float, float, float]:
    """Total force (x, y, z), N, of the indenters on the gel: x right, y down, z into the gel.

    The gel is a bed of springs with independent pressure and shear (Winkler; K. L. Johnson, Contact Mechanics
    (1985), ch. 4.3 and 8.7): in contact, normal pressure is proportional to depth, and traction to
    displacement.

    >>> force(())
    (0.0, 0.0, 0.0)
    """
    total = np.zeros(3)
    area = (_FORCE_STEP_PX * MM_PER_PX) ** 2
    for press in presses:
        if not press.touching:
            continue
        side = np.arange(-press.shape.reach, press.shape.reach + _FORCE_STEP_PX, _FORCE_STEP_PX)
        x, y = (part.astype(np.float32) for part in np.meshgrid(press.x + side, press.y + side))
        depth = reached(press, x, y)
        touched = depth > press.sink * press.depth
        points = np.stack([x[touched], y[touched]], axis=1).astype(np.float64)
        # First-order inverse of the displacement.
        moved = displacement(presses, points - displacement(presses, points))
        total[:2] += _SHEAR_STIFFNESS_N_PER_MM3 * MM_PER_PX * area * moved.sum(axis=0)
        total[2] += _STIFFNESS_N_PER_MM3 * MM_PER_PX * area * float(surface(press, depth)[touched].sum())
    return float(total[0]), float(total[1]), float(total[2])
