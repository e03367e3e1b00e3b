"""Indenters: the gap between an indenter's surface and the plane through its lowest point.

Coordinates are local to the shape, in raw pixels; the gap is 0 at the lowest point(s). Pressed by d, the
indenter reaches `d - gap` below the untouched surface of the gel.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.arrays import Floats32

_Relief = Callable[[Floats32, Floats32, Floats32], Floats32]
_FIXED_POINT_ITERATIONS = 4
"""Fixed-point steps to the surface of a rotated shape: to 0.01 px."""
_BUMPS_PER_CIRCUMFERENCE = 25.0
"""Waves of the bumps of a ball per circumference."""


@dataclass(frozen=True)
class Shape:
    """An indenter.

    Attributes
    ----------
    gap : (x, y) float32 arrays, px -> height of the surface above the lowest point, px, >= 0.
    reach : distance from the origin beyond which it does not visibly affect the gel, px.
    depth : full depth, px.
    sources : (K, 2) float64, px, points from which a press dilates the gel.
    spread : standard deviation of the dilation, px.
    center : height above the lowest point of the point about which it is tilted or rolls, px.
    tilted : makes the shape after a rotation (3, 3) about that point; None: see `tilt_surface`.
    """

    gap: Callable[[Floats32, Floats32], Floats32]
    reach: float
    depth: float
    sources: NDArray[np.float64]
    spread: float
    center: float = 0.0
    tilted: Callable[[NDArray[np.float64]], Shape] | None = None

    def rotated(self, rotation: NDArray[np.float64]) -> Shape:
        """The shape after a rotation (3, 3) about its centre; x right, y down, z towards the object."""
        return tilt_surface(self, rotation) if self.tilted is None else self.tilted(rotation)

    @cached_property
    def _largest_push(self) -> float:
        """Largest displacement before scaling, px."""
        line = np.linspace(-self.reach, self.reach, 41)
        grid = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
        return max(float(np.sqrt(np.max(np.sum(self._push(grid) ** 2, axis=1)))), 1e-12)

    def _push(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        away = points[:, None, :] - self.sources[None, :, :]
        weight = np.exp(-np.sum(away * away, axis=-1) / (2.0 * self.spread**2))
        return np.asarray(np.einsum("nkc,nk->nc", away, weight), dtype=np.float64)

    def push(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Dilation of the gel at points (N, 2), scaled so that its largest value is 1.

        The sum over sources C of (M - C) exp(-|M - C|^2 / 2 spread^2) is the dilation of FOTS (Zhao et al.,
        "FOTS: A Fast Optical Tactile Simulator for Sim2Real Learning of Tactile-Motor Robot Manipulation
        Skills", RA-L 2024).
        """
        return self._push(points) * (1.0 / self._largest_push)


def _sampled(values: Floats32, x: Floats32, y: Floats32) -> Floats32:
    """Values of a map (h, w), 0 outside, at x and y from its middle, px, arrays of any shape."""
    if not x.size:  # `remap` takes no empty maps: a gel without markers
        return np.empty(x.shape, np.float32)
    middle_x, middle_y = (np.float32((side - 1) / 2) for side in values.shape[::-1])
    map_x = np.ascontiguousarray(x + middle_x).reshape(len(x), -1)
    map_y = np.ascontiguousarray(y + middle_y).reshape(len(y), -1)
    found = cv2.remap(values, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    return np.asarray(found, dtype=np.float32).reshape(x.shape)


def _segment(half_length: float, count: int) -> NDArray[np.float64]:
    return np.stack([np.linspace(-half_length, half_length, count), np.zeros(count)], axis=1)


def sphere(radius: float = 95.0, depth: float = 26.0) -> Shape:
    """A ball of `radius` px, approximated by a paraboloid as in Hertz's theory."""

    def gap(x: Floats32, y: Floats32) -> Floats32:
        return np.asarray((x * x + y * y) * np.float32(0.5 / radius), dtype=np.float32)

    return _rotation_invariant(gap, radius, depth)


def _rotation_invariant(gap: Callable[[Floats32, Floats32], Floats32], radius: float, depth: float) -> Shape:
    contact = float(np.sqrt(radius * depth))
    plain = Shape(gap, 3.8 * contact, depth, np.zeros((1, 2)), 1.2 * contact, radius)
    return replace(plain, tilted=lambda _: plain)


def ball(radius: float = 95.0, depth: float = 26.0) -> Shape:
    """A ball of `radius` px with its exact shape, for calibration."""

    def gap(x: Floats32, y: Floats32) -> Floats32:
        squared = np.minimum(x * x + y * y, np.float32((0.99 * radius) ** 2))
        round_part = np.float32(radius) - np.sqrt(np.float32(radius**2) - squared)
        return np.asarray(round_part + np.hypot(x, y) - np.sqrt(squared), dtype=np.float32)

    return _rotation_invariant(gap, radius, depth)


def _with_relief(
    smooth: Shape, radius: float, relief: float, raised: _Relief, bends: tuple[float, float] = (1.0, 1.0)
) -> Shape:
    """A round shape with a relief, which may be rotated by any angle.

    smooth : without the relief, its centre `radius` px above its lowest point. raised : height of the relief,
    px, at most `relief`, at points given by x, y, z from the centre in axes that rotate with the shape.
    bends : whether it curves along x and y, as a ball does, 1 or 0.
    """

    def rolled(rotation: NDArray[np.float64]) -> Shape:
        axes = rotation.astype(np.float32)

        def gap(x: Floats32, y: Floats32) -> Floats32:
            squared = np.float32(bends[0]) * x * x + np.float32(bends[1]) * y * y
            below = np.float32(radius) - smooth.gap(x, y)
            inside = squared < np.float32((0.9 * radius) ** 2)
            for _ in range(_FIXED_POINT_ITERATIONS):
                own = [x * axis[0] + y * axis[1] - below * axis[2] for axis in axes.T]
                outer = np.float32(radius) + raised(*own)
                below = np.where(inside, np.sqrt(np.maximum(outer * outer - squared, 1)), below)
            return np.asarray(np.float32(radius + relief) - below, np.float32)

        return replace(smooth, gap=gap, center=radius + relief, tilted=rolled)

    return rolled(np.eye(3))


def bumpy_ball(radius: float = 95.0, depth: float = 26.0, relief: float = 2.5) -> Shape:
    """A ball of `radius` px with bumps of up to `relief` px, 14 degrees apart, all over it."""

    def raised(x: Floats32, y: Floats32, z: Floats32) -> Floats32:
        scale = np.float32(_BUMPS_PER_CIRCUMFERENCE) / np.sqrt(x * x + y * y + z * z)
        return np.asarray(np.float32(relief / 3) * sum(np.sin(part * scale) for part in (x, y, z)))

    return _with_relief(ball(radius, depth), radius, relief, raised)


def medal(radius: float = 1200.0, depth: float = 14.0, relief: float = 4.0) -> Shape:
    """A domed disc of 25 mm with letters `relief` px high; `radius` px is that of its curvature."""
    letters = np.zeros((1000, 1000), np.uint8)
    for row, (text, scale) in enumerate((("TOUCH", 6.4), ("25 mm", 6.0), ("MEDAL", 6.4))):
        (width, _), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, 18)
        place = (500 - width // 2, 335 + 230 * row)
        cv2.putText(letters, text, place, cv2.FONT_HERSHEY_SIMPLEX, scale, (255.0,), 18, cv2.LINE_8)
    cv2.circle(letters, (500, 500), 480, (255.0,), 30, cv2.LINE_8)
    relief_map = np.asarray(cv2.GaussianBlur(letters, (0, 0), 4.0), np.float32) * np.float32(relief / 255)

    def raised(x: Floats32, y: Floats32, _: Floats32) -> Floats32:
        return _sampled(relief_map, x, y)

    return _with_relief(ball(radius, depth), radius, relief, raised)


def rod(radius: float = 80.0, depth: float = 20.0, thread: float = 34.0, ridges: float = 2.4) -> Shape:
    """A threaded rod along x, longer than the gel, that may be rotated about its axis; see `screw`."""

    def around(x: Floats32, y: Floats32) -> Floats32:
        return ball(radius, depth).gap(x * np.float32(0), y)

    def raised(x: Floats32, y: Floats32, z: Floats32) -> Floats32:
        turns = np.arctan2(y, -z) * np.float32(0.5 / np.pi)
        wave = np.cos((x * np.float32(1 / thread) + turns) * np.float32(2 * np.pi))
        return np.asarray(np.float32(ridges) * (wave - 1), np.float32)

    smooth = cable(radius, depth=depth)
    return _with_relief(replace(smooth, gap=around), radius, 0.0, raised, bends=(0.0, 1.0))


def tilt_surface(shape: Shape, rotation: NDArray[np.float64]) -> Shape:
    """A shape after a rotation (3, 3) about its centre by so few degrees that no part hides another."""
    turn = rotation.astype(np.float32)
    center = np.float32(shape.center)

    def gap(x: Floats32, y: Floats32) -> Floats32:
        # Where the point of the untilted surface lies that is now above (x, y); z points out of the gel.
        from_x, from_y = x, y
        for _ in range(_FIXED_POINT_ITERATIONS):
            height = shape.gap(from_x, from_y) - center
            now_x = turn[0, 0] * from_x + turn[0, 1] * from_y + turn[0, 2] * height
            now_y = turn[1, 0] * from_x + turn[1, 1] * from_y + turn[1, 2] * height
            from_x, from_y = from_x + x - now_x, from_y + y - now_y
        height = shape.gap(from_x, from_y) - center
        now = turn[2, 0] * from_x + turn[2, 1] * from_y + turn[2, 2] * height + center
        return np.asarray(now, np.float32)

    return replace(shape, gap=gap, tilted=lambda more: tilt_surface(shape, more))


def cable(radius: float = 62.0, half_length: float = 520.0, depth: float = 17.0) -> Shape:
    """A cylinder of `radius` px along x with rounded ends."""

    def gap(x: Floats32, y: Floats32) -> Floats32:
        beyond = np.maximum(np.abs(x) - np.float32(half_length), 0)
        return np.asarray((beyond * beyond + y * y) * np.float32(0.5 / radius), dtype=np.float32)

    contact = float(np.sqrt(radius * depth))
    return Shape(gap, half_length + 4 * contact, depth, _segment(half_length, 24), 1.3 * contact)


def edge(half_length: float = 170.0, slope: float = 0.55, depth: float = 14.0, lean: float = 0.0) -> Shape:
    """A rounded knife edge along x whose flanks rise with `slope`.

    lean : in [0, 1); relative difference of the slopes of both flanks from `slope`, for the edge of a box.
    """
    # Lowest point of a leaning edge, where the gap is 0.
    lowest, rise = -3.0 * lean / np.sqrt(1.0 - lean**2), 3.0 * np.sqrt(1.0 - lean**2)

    def gap(x: Floats32, y: Floats32) -> Floats32:
        beyond = np.maximum(np.abs(x) - np.float32(half_length), 0)
        across = y + np.float32(lowest)
        away = np.sqrt(beyond * beyond + across * across + np.float32(9.0)) - np.float32(rise)
        return np.asarray((away + across * np.float32(lean)) * np.float32(slope), dtype=np.float32)

    return Shape(gap, half_length + 150, depth, _segment(half_length, 12), 45.0)


def _flank(outside: Floats32) -> Floats32:
    # A chamfer with a rounded foot avoids a crease in the shading.
    return np.asarray(np.sqrt(outside * outside + np.float32(4.0)) - np.float32(2.0), dtype=np.float32)


def box(
    half_width: float = 85.0, half_height: float = 52.0, corner: float = 8.0, depth: float = 12.0
) -> Shape:
    """A flat punch with rounded corners."""

    def gap(x: Floats32, y: Floats32) -> Floats32:
        dx = np.abs(x) - np.float32(half_width - corner)
        dy = np.abs(y) - np.float32(half_height - corner)
        outside = np.hypot(np.maximum(dx, 0), np.maximum(dy, 0)) - np.float32(corner)
        return _flank(np.maximum(outside, 0))

    sources = _segment(max(half_width - half_height, 0.0), 5)
    return Shape(gap, float(np.hypot(half_width, half_height)) + 70, depth, sources, 1.1 * half_height)


def ring(radius: float = 70.0, tube: float = 45.0, depth: float = 12.0) -> Shape:
    """A torus with centre line `radius` and tube radius `tube`, px."""

    def gap(x: Floats32, y: Floats32) -> Floats32:
        across = np.hypot(x, y) - np.float32(radius)
        return np.asarray(across * across * np.float32(0.5 / tube), dtype=np.float32)

    return Shape(gap, radius + 3.8 * float(np.sqrt(tube * depth)), depth, np.zeros((1, 2)), radius)


def coin(radius: float = 150.0, relief: float = 4.0, depth: float = 12.0) -> Shape:
    """A disc with a raised rim and text, `relief` px high, on a face that also makes contact."""
    font, text, scale, thickness, margin = cv2.FONT_HERSHEY_SIMPLEX, "10c", 3.4, 14, 60
    (width, height), _ = cv2.getTextSize(text, font, scale, thickness)
    letters = np.zeros((height + 2 * margin, width + 2 * margin), np.uint8)
    cv2.putText(letters, text, (margin, margin + height), font, scale, (255.0,), thickness, cv2.LINE_8)
    smooth = np.asarray(cv2.GaussianBlur(letters, (0, 0), 2.5), dtype=np.float32)
    relief_map = smooth / np.float32(255.0)

    def gap(x: Floats32, y: Floats32) -> Floats32:
        from_center = np.hypot(x, y)
        rim = np.exp(-((from_center - np.float32(radius - 10.0)) ** 2) / np.float32(2 * 6.0**2))
        lower = np.float32(relief) * (1 - np.maximum(rim, _sampled(relief_map, x, y)))
        beyond = _flank(np.maximum(from_center - np.float32(radius - 10.0), 0))
        return np.asarray(np.where(from_center > radius - 10.0, 0, lower) + beyond, dtype=np.float32)

    return Shape(gap, radius + 90, depth, np.zeros((1, 2)), 0.8 * radius)


def block(half_width: float = 215.0, half_height: float = 135.0, depth: float = 12.0) -> Shape:
    """A large flat punch with grooves across it, 5 px deep, that also make contact."""
    plain = box(half_width, half_height, 14.0, depth)

    def gap(x: Floats32, y: Floats32) -> Floats32:
        groove = np.float32(0.5) - np.float32(0.5) * np.cos(x * np.float32(2 * np.pi / 43.0))
        return np.asarray(plain.gap(x, y) + np.float32(5.0) * groove**4, dtype=np.float32)

    return Shape(gap, plain.reach, depth, plain.sources, plain.spread)


def screw(
    radius: float = 62.0,
    half_length: float = 190.0,
    thread: float = 34.0,
    depth: float = 16.0,
    ridges: float = 2.4,
) -> Shape:
    """A threaded rod along x, with inclined ridges of amplitude `ridges` px every `thread` px."""
    smooth = cable(radius, half_length, depth)

    def gap(x: Floats32, y: Floats32) -> Floats32:
        ridge = np.cos((x + np.float32(0.16) * y) * np.float32(2 * np.pi / thread))
        return np.asarray(smooth.gap(x, y) + np.float32(ridges) * (1 - ridge), dtype=np.float32)

    return Shape(gap, smooth.reach, depth, _segment(half_length, 12), smooth.spread)


def finger(depth: float = 26.0) -> Shape:
    """A fingertip along x: wide, soft and round, with the fine ridges of its skin."""
    return screw(radius=165.0, half_length=120.0, thread=15.0, depth=depth, ridges=0.35)
