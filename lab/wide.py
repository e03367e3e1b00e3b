"""Random scenes far beyond any single sensor, to judge what finds contacts and dots.

Every scene is drawn from its seed alone: the shape of the object and its texture, the gel that it is pressed
into, how the gel answers the light, printed dots, the housing, the camera, and what changes although nothing
touches. Lengths are parts of the picture's longer side.

Contact is where the surface of the object lies below that of the untouched gel, which sinks around it.

References
----------
W. Yuan, S. Dong, E. H. Adelson, "GelSight: high-resolution robot tactile sensors for estimating geometry and
force", Sensors 17 (2017), for the light; Z. Si, W. Yuan, "Taxim: an example-based simulation model for
GelSight tactile sensors", RA-L 7 (2022), for a gel that sinks as a blurred imprint.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from tactflow.vision.arrays import Mask

Plane = NDArray[Any]
"""(H, W) or (H, W, 3) of floats."""

SIDE_RANGE_PX: Final = (160, 320)
"""px: range of the longer side of a picture."""
ASPECT_RATIOS: Final = (1.0, 4 / 3, 4 / 3, 16 / 9)
"""Longer over shorter side, each as likely."""
UNTOUCHED_SHARE: Final = 0.25
"""Share of scenes in which nothing touches the gel."""
MIN_AREA_SHARE: Final = 0.002
"""Part of the picture that a contact covers at least."""


@dataclass(frozen=True, slots=True)
class WideScene:
    """A pair of pictures, without and with contact.

    reference, picture : (H, W, 3) uint8, BGR. reference_dots, dots : (H, W) uint8, 255 where a detector might
    say that dots are, wrongly here and there. contact : (H, W) bool, the truth. origin, position : (N, 2)
    float32, true centres of the dots in both pictures, px. shift : (H, W, 2) float32, how far the gel has
    moved that was at each pixel, x and y, px.
    """

    reference: NDArray[np.uint8]
    picture: NDArray[np.uint8]
    reference_dots: Mask
    dots: Mask
    contact: NDArray[np.bool_]
    origin: Plane
    position: Plane
    shift: Plane


@dataclass(frozen=True, slots=True)
class _Imprint:
    """depth : (H, W), how far the gel is pressed in. contact : (H, W) bool. shift : (H, W, 2), how far the
    gel moved along x and y. All lengths are parts of the longer side."""

    depth: Plane
    contact: NDArray[np.bool_]
    shift: Plane


def wide_scene(seed: int) -> WideScene:
    """Draw the scene of a seed, >= 0.

    >>> scene = wide_scene(3)
    >>> scene.picture.shape == scene.reference.shape, scene.contact.shape == scene.dots.shape
    (True, True)
    """
    rng = np.random.default_rng(seed)
    long = int(rng.integers(*SIDE_RANGE_PX, endpoint=True))
    short = round(long / rng.choice(ASPECT_RATIOS))
    shape = (long, short) if rng.random() < 0.3 else (short, long)
    y, x = (np.indices(shape, np.float32) - np.float32(0.5) * np.reshape(shape, (2, 1, 1))) / np.float32(long)
    rest = _Imprint(np.zeros(shape, np.float32), np.zeros(shape, bool), np.zeros((*shape, 2), np.float32))
    pressed = rest
    if rng.random() >= UNTOUCHED_SHARE:
        while pressed.contact.mean() < MIN_AREA_SHARE:
            pressed = _imprint(rng, x, y)
    return _photographs(rng, x, y, rest, pressed)


# The object and the gel.


def _between(rng: Generator, low: float, high: float) -> float:
    """Log-uniform."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _blurred(plane: Plane, sigma: float) -> Plane:
    """Gaussian blur, sigma in parts of the longer side; wide ones on a smaller picture."""
    pixels = sigma * max(plane.shape[:2])
    if pixels < 0.3:
        return plane
    step = max(1, int(pixels / 3))
    small = (
        cv2.resize(plane, None, fx=1 / step, fy=1 / step, interpolation=cv2.INTER_AREA) if step > 1 else plane
    )
    small = cv2.GaussianBlur(small, (0, 0), pixels / step, borderType=cv2.BORDER_REPLICATE)
    if step > 1:
        small = cv2.resize(small, plane.shape[1::-1], interpolation=cv2.INTER_LINEAR)
    return np.asarray(small, np.float32)


def _field(rng: Generator, shape: tuple[int, ...], size: float) -> Plane:
    """Smooth random field of unit deviation; size : of its features."""
    cells = [max(2, round(side / (size * max(shape[:2])))) + 2 for side in shape[:2]]
    coarse = rng.standard_normal((*cells, *shape[2:])).astype(np.float32)
    return np.asarray(cv2.resize(coarse, shape[1::-1], interpolation=cv2.INTER_CUBIC), np.float32)


def _imprint(rng: Generator, x: Plane, y: Plane) -> _Imprint:
    count = 1 if rng.random() < 0.8 else int(rng.integers(2, 5))
    reach = np.maximum.reduce([_object(rng, x, y, largest=0.3 if count > 1 else 0.9) for _ in range(count)])
    depth = float(reach.max())
    sunk, contact = _sunk(reach, _between(rng, 0.003, 0.07))
    surface: Plane = np.where(contact, reach + _relief(rng, x, y, contact, depth), sunk).astype(np.float32)
    far = _between(rng, 0.03, 0.2)
    surface -= np.float32(rng.uniform(0, 0.3)) * np.where(contact, 0, _blurred(sunk, far))
    surface = _blurred(surface, _between(rng, 0.0008, 0.006))
    if rng.random() < 0.25 and contact.any():
        surface = surface + _wrinkles(rng, contact, x, y, depth)
    if rng.random() < 0.4:
        surface = surface + np.float32(_between(rng, 0.0002, 0.004)) * _field(
            rng, x.shape, _between(rng, 0.2, 0.6)
        )
    return _Imprint(surface, reach > 0, _shift(rng, x, y, contact, sunk, far))


def _sunk(reach: Plane, length: float) -> tuple[Plane, NDArray[np.bool_]]:
    """Surface of a gel below an object, and where they touch.

    The gel is an elastic layer whose surface decays with `length`: u - length^2 laplace(u) = 0 where it is
    free, u >= reach everywhere (an obstacle problem). Solved by smoothing and lifting in turns, from coarse
    to fine.
    """
    surface = np.maximum(reach, 0)
    free = surface
    sigma = length
    while sigma > 1.5 / max(reach.shape):
        leak = np.float32(1 / (1 + (sigma / length) ** 2 / 2))
        for _ in range(3):
            free = leak * _blurred(surface, sigma)
            surface = np.maximum(reach, free)
        sigma /= 2
    return np.asarray(surface, np.float32), np.asarray((reach > free) & (reach > 0))


def _object(rng: Generator, x: Plane, y: Plane, largest: float) -> Plane:
    """How far an object reaches below the gel's free surface; negative where it does not."""
    angle = rng.uniform(0, 2 * np.pi)
    half_x, half_y = np.ptp(x) / 2, np.ptp(y) / 2
    spread = 1.0 if rng.random() < 0.85 else 1.3
    cx, cy = spread * rng.uniform(-half_x, half_x), spread * rng.uniform(-half_y, half_y)
    cos, sin = np.float32(np.cos(angle)), np.float32(np.sin(angle))
    u, v = (x - cx) * cos + (y - cy) * sin, (y - cy) * cos - (x - cx) * sin
    kind = rng.choice(
        ["ball", "dome", "bar", "wedge", "ring", "polygon"], p=[0.25, 0.35, 0.13, 0.08, 0.04, 0.15]
    )
    size = _between(rng, 0.03, 0.25)
    power = np.float32(rng.choice([1.5, 2, 2, 3, 6]))
    if kind == "ball":
        reach = _cap(u / size, v / size, rng.uniform(0, 1))
    elif kind == "dome":
        size = _between(rng, 0.05, largest / 2) if rng.random() < 0.6 else rng.uniform(0.1, largest / 2)
        corner = np.float32(rng.choice([2, 2, 2.5, 4, 8]))
        long = size * rng.uniform(1, 2.5)
        radius = (np.abs(u / size) ** corner + np.abs(v / long) ** corner) ** (1 / corner)
        reach = 1 - radius**power
    elif kind == "bar":
        size = thin = _between(rng, 0.012, 0.08)
        long = _between(rng, 0.1, 2.0)
        u = u + np.float32(rng.normal(0, 0.6)) * v * v
        reach = 1 - np.abs(u / thin) ** power - np.maximum(np.abs(v) - long, 0) / thin
    elif kind == "wedge":
        left, right = _between(rng, 0.012, 0.1), _between(rng, 0.012, 0.4)
        size = min(left, right)
        reach = (
            1 - np.maximum(-u / left, u / right) - np.maximum(np.abs(v) - _between(rng, 0.05, 1.0), 0) / left
        )
    elif kind == "ring":
        thin = _between(rng, 0.01, 0.05)
        reach = 1 - np.abs((np.hypot(u, v) - size) / thin) ** power
        size = thin
    else:
        size = _between(rng, 0.05, largest / 2)
        reach = _polygon(rng, u, v, size)
    tilt = rng.normal(0, 0.3) / max(size, 0.05)
    reach = np.maximum(reach, -3) * np.clip(1 + np.float32(tilt) * (u * cos + v * sin), 0.2, 2)
    return np.asarray(np.float32(min(size * _between(rng, 0.06, 1.0), 0.1)) * reach, np.float32)


def _cap(u: Plane, v: Plane, part: float) -> Plane:
    """A spherical cap over the unit disc, 1 in its middle. part : squared ratio of the disc's radius to the
    sphere's, 0 (flat) to 1 (a hemisphere)."""
    part = min(max(part, 0.01), 0.99)
    squared = u * u + v * v
    height = np.sqrt(np.maximum(1 - part * squared, 0)) - np.float32(np.sqrt(1 - part))
    return np.asarray(
        np.where(squared < 1, height / np.float32(1 - np.sqrt(1 - part)), 1 - squared), np.float32
    )


def _polygon(rng: Generator, u: Plane, v: Plane, size: float) -> Plane:
    """A flat face with straight sides, convex or not, and rounded edges."""
    corners = int(rng.integers(3, 9))
    angles = np.sort(rng.uniform(0, 2 * np.pi, corners))
    radii = size * rng.uniform(0.4 if rng.random() < 0.5 else 0.8, 1.0, corners)
    px, py = radii * np.cos(angles), radii * np.sin(angles)
    reach = np.full(u.shape, np.inf, np.float32)
    inside = np.zeros(u.shape, bool)
    for i in range(corners):
        ax, ay, bx, by = px[i - 1], py[i - 1], px[i], py[i]
        along = np.clip(
            ((u - ax) * (bx - ax) + (v - ay) * (by - ay)) / ((bx - ax) ** 2 + (by - ay) ** 2), 0, 1
        )
        reach = np.minimum(reach, np.hypot(u - ax - along * (bx - ax), v - ay - along * (by - ay)))
        crosses = (ay > v) != (by > v)
        inside ^= crosses & (u < (bx - ax) * (v - ay) / (by - ay if by != ay else 1e-9) + ax)
    edge = np.float32(_between(rng, 0.004, size / 2))
    rounded = np.minimum(reach / edge, 1) ** np.float32(rng.choice([0.5, 1.0]))
    return np.asarray(np.where(inside, np.maximum(rounded, 0.02), -reach / edge), np.float32)


def _relief(rng: Generator, x: Plane, y: Plane, contact: NDArray[np.bool_], depth: float) -> Plane:
    """Texture of the object: ridges, a weave, dimples, grain, or none."""
    kind = rng.choice(["none", "ridges", "weave", "dimples", "grain"], p=[0.35, 0.2, 0.15, 0.12, 0.18])
    if kind == "none":
        return np.zeros_like(x)
    period, angle = _between(rng, 0.012, 0.1), rng.uniform(0, np.pi)
    warp = np.float32(rng.choice([0, 0, 0.3, 1.5]) * period) * _field(rng, x.shape, 4 * period)
    u = (x * np.cos(angle) + y * np.sin(angle) + warp) * np.float32(2 * np.pi / period)
    v = (y * np.cos(angle) - x * np.sin(angle) + warp) * np.float32(2 * np.pi / period)
    if kind == "ridges":
        pattern = np.cos(u)
    elif kind == "weave":
        pattern = np.cos(u) * np.cos(v)
    elif kind == "dimples":
        pattern = np.cos(u) + np.cos(u / 2 + 0.866 * v) + np.cos(u / 2 - 0.866 * v)
    else:
        pattern = _field(rng, x.shape, period)
    height = min(depth, period) * _between(rng, 0.02, 0.5)
    return np.asarray(np.float32(height) * np.where(contact, pattern, 0), np.float32)


def _wrinkles(rng: Generator, contact: NDArray[np.bool_], x: Plane, y: Plane, depth: float) -> Plane:
    """Waves of the skin next to a contact that drags it along."""
    away = cv2.distanceTransform((~contact).astype(np.uint8), cv2.DIST_L2, 5) / np.float32(max(contact.shape))
    rows, columns = np.nonzero(contact)
    middle = x[0, int(columns.mean())], y[int(rows.mean()), 0]
    angle = rng.uniform(0, 2 * np.pi)
    toward = np.cos(np.arctan2(y - middle[1], x - middle[0]) - angle)
    offset, width = rng.uniform(0, 0.15), _between(rng, 0.02, 0.1)
    band = np.exp(-(((away - offset) / width) ** 2)) * np.clip(toward - rng.uniform(-0.5, 0.7), 0, 1)
    waves = np.cos(away * np.float32(2 * np.pi / _between(rng, 0.02, 0.05)))
    return np.asarray(np.float32(_between(rng, 0.02, 0.15) * depth) * band * waves * ~contact, np.float32)


def _shift(rng: Generator, x: Plane, y: Plane, contact: NDArray[np.bool_], sunk: Plane, far: float) -> Plane:
    """The gel below the contact is dragged and turned with the object; around it less and less."""
    away = cv2.distanceTransform((~contact).astype(np.uint8), cv2.DIST_L2, 5) / np.float32(max(contact.shape))
    hold = np.exp(-away / np.float32(_between(rng, 0.03, 0.3)))
    drag = rng.normal(0, 0.015 if rng.random() < 0.6 else 0.002, 2)
    turn = rng.normal(0, 0.1) if rng.random() < 0.3 else 0.0
    wide = _blurred(sunk, far)
    spread = np.float32(rng.uniform(0, 0.3) * far * max(contact.shape))
    shift_x = drag[0] * hold - spread * cv2.Sobel(wide, cv2.CV_32F, 1, 0, scale=1 / 8)
    shift_y = drag[1] * hold - spread * cv2.Sobel(wide, cv2.CV_32F, 0, 1, scale=1 / 8)
    if contact.any():
        rows, columns = np.nonzero(contact)
        middle = x[0, int(columns.mean())], y[int(rows.mean()), 0]
        shift_x, shift_y = shift_x - turn * hold * (y - middle[1]), shift_y + turn * hold * (x - middle[0])
    stiff = _between(rng, 0.002, 0.1)
    return np.stack([_blurred(shift.astype(np.float32), stiff) for shift in (shift_x, shift_y)], axis=-1)


# Light, dots, housing, camera.


@dataclass(frozen=True, slots=True)
class _Lamp:
    """azimuth, elevation : of its light, rad. colour : (3,). falloff : (H, W). shadow : 0..1."""

    azimuth: float
    elevation: float
    colour: Plane
    falloff: Plane
    shadow: float


@dataclass(frozen=True, slots=True)
class _Gel:
    """How a gel answers the light.

    lamps : that light it. ambient : (H, W, 3), light that does not depend on slope. response : how much of
    the change of light is seen. steepness : factor of the slopes. darkening : (3,), logarithm of light lost
    or won over the greatest depth. adhesion : part of the light won or lost below the contact. halo,
    halo_size : part of the change that spreads.
    """

    lamps: list[_Lamp]
    ambient: Plane
    response: float
    steepness: float
    darkening: Plane
    adhesion: Plane
    halo: float
    halo_size: float


def _gel(rng: Generator, x: Plane, y: Plane) -> _Gel:
    count = int(rng.integers(1, 5))
    first, shadows = rng.uniform(0, 2 * np.pi), rng.random() < 0.3
    saturation = rng.uniform(0, 1) if rng.random() < 0.85 else 0.0
    elevation = rng.uniform(0.1, 0.7)
    lamps = []
    for index in range(count):
        azimuth = first + 2 * np.pi * index / count + rng.normal(0, 0.2)
        hue = rng.dirichlet([0.4, 0.4, 0.4]).astype(np.float32)
        colour = (1 - saturation) / 3 + saturation * hue
        toward = x * np.cos(azimuth) + y * np.sin(azimuth)
        falloff = np.exp(np.float32(rng.uniform(0, 3.0)) * (toward - 0.5) * rng.choice([1, 1, -0.5]))
        lamps.append(
            _Lamp(
                azimuth,
                float(np.clip(elevation + rng.normal(0, 0.1), 0.08, 1.2)),
                np.asarray(colour * rng.uniform(0.5, 1.5), np.float32),
                np.asarray(falloff * (1 + 0.15 * _field(rng, x.shape, 0.4)), np.float32),
                rng.uniform(0.2, 0.9) if shadows else 0.0,
            )
        )
    ambient = rng.uniform(0, 0.3) * (1 + 0.3 * _field(rng, (*x.shape, 3), 0.5))
    dark = rng.normal(0, 0.8, 3) * (rng.random() < 0.2) + rng.normal(0, 0.6) * (rng.random() < 0.25)
    stick = rng.normal(0, 0.1, 3) * (rng.random() < 0.2) + rng.normal(0, 0.15) * (rng.random() < 0.2)
    return _Gel(
        lamps,
        np.asarray(ambient, np.float32),
        1.0 if rng.random() < 0.6 else _between(rng, 0.1, 1.0),
        _between(rng, 0.6, 3.0),
        np.asarray(dark, np.float32),
        np.asarray(stick, np.float32),
        rng.normal(0, 0.4) if rng.random() < 0.3 else 0.0,
        _between(rng, 0.02, 0.3),
    )


def _lit(gel: _Gel, imprint: _Imprint, gains: NDArray[np.float64]) -> Plane:
    """Light (H, W, 3) that the camera sees; gains : of each lamp."""
    long = max(imprint.depth.shape)
    scale = gel.steepness * long / 8
    slope_x = cv2.Sobel(imprint.depth, cv2.CV_32F, 1, 0, scale=scale)
    slope_y = cv2.Sobel(imprint.depth, cv2.CV_32F, 0, 1, scale=scale)
    touched = bool(imprint.depth.any())
    steep = 1 / np.sqrt(1 + slope_x**2 + slope_y**2)
    seen = gel.ambient.copy()
    for lamp, gain in zip(gel.lamps, gains, strict=True):
        flat = np.sin(lamp.elevation)
        toward = slope_x * np.float32(np.cos(lamp.azimuth)) + slope_y * np.float32(np.sin(lamp.azimuth))
        shade = np.maximum(np.float32(np.cos(lamp.elevation)) * toward + np.float32(flat), 0) * steep
        if touched and lamp.shadow:
            shade = shade * (1 - np.float32(lamp.shadow) * _shadow(imprint.depth, lamp))
        light = (
            lamp.falloff * (1 + np.float32(gel.response) * (shade / np.float32(flat) - 1)) * np.float32(gain)
        )
        seen += light[..., None] * lamp.colour
    if touched:
        deepest = max(float(imprint.depth.max()), 1e-6)
        seen *= np.exp(imprint.depth[..., None] / np.float32(deepest) * gel.darkening)
        seen *= 1 + _blurred(imprint.contact.astype(np.float32), 0.004)[..., None] * gel.adhesion
    return np.asarray(seen, np.float32)


def _shadow(depth: Plane, lamp: _Lamp) -> Plane:
    """Where the imprint stands between the lamp and the gel: 0..1. Light runs inside the gel, nearly flat."""
    long, steps = max(depth.shape), 8
    stride = 0.2 * long / steps
    hidden = np.zeros_like(depth)
    for step in range(1, steps + 1):
        across, down = -step * stride * np.cos(lamp.azimuth), -step * stride * np.sin(lamp.azimuth)
        move = np.array([[1, 0, across], [0, 1, down]], np.float32)
        between = cv2.warpAffine(depth, move, depth.shape[::-1], borderMode=cv2.BORDER_REPLICATE)
        rise = np.float32(step * stride / long * 0.15)
        hidden = np.maximum(hidden, between - depth - rise)
    strongest = float(hidden.max())
    return _blurred(np.clip(hidden / max(0.3 * strongest, 1e-4), 0, 1).astype(np.float32), 0.005)


@dataclass(frozen=True, slots=True)
class _Dots:
    """origin : (N, 2), parts of the longer side. radius : (N,). squareness : exponent of the outline.
    stretch : of x. contrast : (3,), part of the light that a dot takes away; negative where it shines."""

    origin: Plane
    radius: Plane
    squareness: float
    stretch: float
    contrast: Plane


def _dots(rng: Generator, x: Plane, y: Plane) -> _Dots | None:
    if rng.random() < 0.4:
        return None
    pitch, turn = _between(rng, 0.035, 0.16), rng.normal(0, 0.1)
    steps = np.arange(-int(0.8 / pitch), int(0.8 / pitch) + 1) * pitch
    grid_x, grid_y = np.meshgrid(steps, steps * rng.uniform(0.8, 1.25))
    if rng.random() < 0.2:
        grid_x = grid_x + (np.arange(len(steps)) % 2)[:, None] * pitch / 2
    points = np.stack([grid_x.ravel(), grid_y.ravel()], axis=1)
    points += rng.normal(0, rng.choice([0.0, 0.02, 0.15]) * pitch, points.shape)
    points = points @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    points *= 1 + rng.normal(0, 0.2) * (points**2).sum(axis=1, keepdims=True)
    points = points[(np.abs(points[:, 0]) < np.ptp(x) / 2) & (np.abs(points[:, 1]) < np.ptp(y) / 2)]
    radius = pitch * rng.uniform(0.1, 0.28) * np.exp(rng.normal(0, rng.choice([0.02, 0.25]), len(points)))
    shade = rng.uniform(0.25, 1.0) * rng.uniform(0.8, 1.0, 3)
    if rng.random() < 0.15:
        shade = -2 * shade
    return _Dots(
        points.astype(np.float32),
        radius.astype(np.float32),
        float(rng.choice([2, 2, 6])),
        float(rng.choice([1, 1, 1, 1.8])),
        shade.astype(np.float32),
    )


def _covered(
    dots: _Dots, centers: Plane, shape: tuple[int, int], margin: float, among: NDArray[np.bool_]
) -> Plane:
    """How much of each pixel dots cover, 0..1. centers : (N, 2), px. margin : px by which they are larger."""
    long = max(shape)
    plane = np.zeros(shape, np.float32)
    for (cx, cy), radius in zip(centers[among], dots.radius[among] * long + margin, strict=True):
        reach = int(radius * dots.stretch) + 2
        left, top = max(int(cx) - reach, 0), max(int(cy) - reach, 0)
        window = plane[top : int(cy) + reach + 1, left : int(cx) + reach + 1]
        if not window.size:
            continue
        down, across = np.indices(window.shape, np.float32)
        u, v = np.abs((across + left - cx) / dots.stretch), np.abs(down + top - cy)
        away = (u**dots.squareness + v**dots.squareness) ** np.float32(1 / dots.squareness)
        np.maximum(window, np.clip(radius - away + 0.5, 0, 1), out=window)
    return plane


def _look_up(plane: Plane, points: Plane) -> Plane:
    """Values (N, ...) of the pixels at points (N, 2), px."""
    columns = np.clip(np.rint(points[:, 0]).astype(int), 0, plane.shape[1] - 1)
    rows = np.clip(np.rint(points[:, 1]).astype(int), 0, plane.shape[0] - 1)
    return np.asarray(plane[rows, columns])


def _photographs(rng: Generator, x: Plane, y: Plane, rest: _Imprint, pressed: _Imprint) -> WideScene:
    shape = x.shape
    long = max(shape)
    gel, dots, camera = _gel(rng, x, y), _dots(rng, x, y), _Camera.drawn(rng)
    grain = 1 + rng.choice([0.0, 0.01, 0.04]) * _field(rng, shape, _between(rng, 0.01, 0.05))
    grain *= _dirt(rng, shape, int(rng.integers(0, 12)) if rng.random() < 0.3 else 0)
    gains = 1 + rng.normal(0, rng.choice([0.003, 0.02, 0.08]), len(gel.lamps))
    plain = _lit(gel, rest, np.ones(len(gel.lamps)))
    touched = _lit(gel, pressed, gains)
    if gel.halo and pressed.depth.any():
        touched = touched + np.float32(gel.halo) * _blurred(touched - plain, gel.halo_size)
    level = np.float32(rng.uniform(40, 170) / max(float(np.percentile(plain, 60)), 1e-3))
    plain, touched = plain * level, touched * level
    plain *= grain[..., None]
    if rng.random() < 0.7:
        grid = np.stack([x, y], axis=-1) * long + np.array([shape[1] / 2, shape[0] / 2], np.float32)
        across, down = cv2.split(np.asarray(grid - pressed.shift * long, np.float32))
        grain = np.asarray(cv2.remap(grain, across, down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT))
    touched *= grain[..., None]
    origin = position = np.zeros((0, 2), np.float32)
    masks = [np.zeros(shape, np.uint8), np.zeros(shape, np.uint8)]
    if dots is not None:
        origin = dots.origin * long + np.array([shape[1] / 2, shape[0] / 2], np.float32) - np.float32(0.5)
        position = origin + long * _look_up(pressed.shift, origin)
        everywhere = np.ones(len(origin), bool)
        for light, centers in ((plain, origin), (touched, position)):
            cover = _covered(dots, centers, shape, 0.0, everywhere)
            light *= 1 - cover[..., None] * dots.contrast
        masks = _masks(rng, dots, origin, position, shape)
    contact = pressed.contact
    housing = _housing(rng, x, y)
    if housing is not None:
        frame = _Frame.drawn(rng, shape)
        plain, touched = frame.around(plain, housing), frame.around(touched, housing)
        contact = contact & housing
    touched = touched * _light_change(rng, x, y)
    for _ in range(rng.choice([0, 1, 2], p=[0.55, 0.25, 0.2])):
        touched = touched + level * _glow(rng, x, y)[..., None] * rng.dirichlet([0.5, 0.5, 0.5]).astype(
            np.float32
        )
    if rng.random() < 0.15 and contact.any():
        touched = touched + _reflection(rng, touched - plain, contact)
    if rng.random() < 0.3:
        move = np.array([[1, 0, rng.normal(0, 0.4)], [0, 1, rng.normal(0, 0.4)]], np.float32)
        touched = cv2.warpAffine(touched, move, shape[::-1], borderMode=cv2.BORDER_REPLICATE)
    if rng.random() < 0.1:
        touched = touched * _dirt(rng, shape, 1 + int(rng.integers(0, 3)))[..., None]
    return WideScene(
        camera.picture(rng, plain, averaged=rng.random() < 0.4),
        camera.picture(rng, touched, averaged=False),
        masks[0],
        masks[1],
        contact,
        origin,
        np.asarray(position, np.float32),
        np.asarray(long * pressed.shift, np.float32),
    )


def _masks(rng: Generator, dots: _Dots, origin: Plane, position: Plane, shape: tuple[int, int]) -> list[Mask]:
    """What a detector would call dots: a little too large, and some are missed."""
    margin = rng.uniform(0, 2.5)
    missed = rng.choice([0.0, 0.02, 0.1, 1.0], p=[0.6, 0.2, 0.12, 0.08])
    masks = []
    for centers in (origin, position):
        found = rng.random(len(origin)) >= missed
        wrong = rng.normal(0, 0.3, centers.shape)
        covered = _covered(dots, np.asarray(centers + wrong, np.float32), shape, margin, found)
        masks.append(np.asarray(np.where(covered > 0.5, 255, 0), np.uint8))
    return masks


def _dirt(rng: Generator, shape: tuple[int, ...], count: int) -> Plane:
    """Specks and blots that take light away: factor (H, W)."""
    plane = np.ones(shape[:2], np.float32)
    for _ in range(count):
        center = int(rng.integers(shape[1])), int(rng.integers(shape[0]))
        axes = (
            max(1, int(_between(rng, 0.003, 0.03) * shape[1])),
            max(1, int(_between(rng, 0.003, 0.03) * shape[1])),
        )
        cv2.ellipse(plane, center, axes, rng.uniform(0, 180), 0, 360, rng.uniform(0.4, 1.3), -1)
    return _blurred(plane, _between(rng, 0.001, 0.01))


def _housing(rng: Generator, x: Plane, y: Plane) -> NDArray[np.bool_] | None:
    """Mask (H, W) of the visible gel if it does not fill the picture: an ellipse or a trapezoid."""
    if rng.random() < 0.65:
        return None
    half_x, half_y = np.ptp(x) / 2 * rng.uniform(0.6, 1.0), np.ptp(y) / 2 * rng.uniform(0.6, 1.0)
    u, v = x - rng.normal(0, 0.05), y - rng.normal(0, 0.05)
    if rng.random() < 0.3:
        return np.asarray((u / half_x) ** 2 + (v / half_y) ** 2 < 1)
    narrowing = np.float32(rng.normal(0, 0.4))
    if rng.random() < 0.5:
        u, v, half_x, half_y = v, u, half_y, half_x
    return np.asarray((np.abs(u) < half_x * (1 + narrowing * v)) & (np.abs(v) < half_y))


@dataclass(frozen=True, slots=True)
class _Frame:
    """What surrounds the gel. wall : (H, W, 3), its light. mirror : axis along which it mirrors the gel, or
    None. shine : how well. rim : light of the gel's border."""

    wall: Plane
    mirror: int | None
    shine: float
    rim: Plane

    @classmethod
    def drawn(cls, rng: Generator, shape: tuple[int, int]) -> _Frame:
        wall = np.abs(rng.uniform(0, 40) * (1 + 0.5 * _field(rng, (*shape, 3), 0.2))).astype(np.float32)
        mirror = int(rng.integers(2)) if rng.random() < 0.4 else None
        return cls(wall, mirror, rng.uniform(0.2, 0.9), rng.uniform(0, 200, 3).astype(np.float32))

    def around(self, light: Plane, gel: NDArray[np.bool_]) -> Plane:
        """The gel's light with the wall around it."""
        wall = self.wall
        if self.mirror is not None:
            half = light.shape[self.mirror] // 2
            wall = wall + np.float32(self.shine) * np.roll(np.flip(light, self.mirror), half, self.mirror)
        inside = _blurred(gel.astype(np.float32), 0.003)[..., None]
        return np.asarray(
            inside * light + (1 - inside) * wall + 2 * inside * (1 - inside) * self.rim, np.float32
        )


def _light_change(rng: Generator, x: Plane, y: Plane) -> Plane:
    """Factor (H, W, 3) of exposure, white balance, smooth bowls, bands and shadows that come and go."""
    exposure = 1 + rng.normal(0, rng.choice([0.002, 0.02, 0.1]))
    factor = np.full((*x.shape, 3), exposure, np.float32) * (
        1 + rng.normal(0, rng.choice([0, 0.01, 0.04]), 3)
    )
    if rng.random() < 0.5:
        bowl = sum(rng.normal(0, 1) * x**i * y**j for i, j in ((1, 0), (0, 1), (2, 0), (1, 1), (0, 2)))
        factor = factor * (1 + np.float32(_between(rng, 0.005, 0.2)) * np.asarray(bowl)[..., None])
    if rng.random() < 0.3:
        smooth = _field(rng, (*x.shape, 3 if rng.random() < 0.5 else 1), _between(rng, 0.3, 1.0))
        factor = factor * (1 + np.float32(_between(rng, 0.003, 0.04)) * smooth.reshape(*x.shape, -1))
    if rng.random() < 0.08:
        bands = np.sin(y * np.float32(2 * np.pi * rng.uniform(1, 12)) + rng.uniform(0, 6))
        factor = factor * (1 + np.float32(rng.uniform(0.005, 0.03)) * bands[..., None])
    return np.asarray(factor, np.float32)


def _glow(rng: Generator, x: Plane, y: Plane) -> Plane:
    """Light of a lamp that falls differently on the gel's border, bent by a contact elsewhere: (H, W)."""
    angle, far = rng.uniform(0, 2 * np.pi), rng.uniform(0.15, 0.5)
    along, across = x * np.cos(angle) + y * np.sin(angle) - far, y * np.cos(angle) - x * np.sin(angle)
    bend = along + rng.normal(0, 1) * across**2
    shape = (bend / _between(rng, 0.02, 0.12)) ** 2 + (
        (across - rng.normal(0, 0.1)) / _between(rng, 0.05, 0.4)
    ) ** 2
    return np.asarray(rng.choice([-0.4, 1]) * _between(rng, 0.02, 0.6) * np.exp(-shape), np.float32)


def _reflection(rng: Generator, change: Plane, contact: NDArray[np.bool_]) -> Plane:
    """A stray image of what changed, elsewhere."""
    stray = _blurred(np.where(contact[..., None], change, 0).astype(np.float32), _between(rng, 0.002, 0.03))
    move = rng.uniform(-0.5, 0.5, 2) * contact.shape[::-1]
    matrix = np.array([[1, 0, move[0]], [0, 1, move[1]]], np.float32)
    stray = cv2.warpAffine(stray, matrix, contact.shape[::-1])
    return np.asarray(np.float32(rng.uniform(0.05, 0.4)) * np.where(contact[..., None], 0, stray), np.float32)


@dataclass(frozen=True, slots=True)
class _Camera:
    """blur : px. noise, shot : standard deviation, grey levels, and what light adds to it. quality : of JPEG,
    0 for none. gray, gamma : how it renders light."""

    blur: float
    noise: float
    shot: float
    quality: int
    gray: bool
    gamma: float

    @classmethod
    def drawn(cls, rng: Generator) -> _Camera:
        return cls(
            rng.uniform(0, 1.2),
            _between(rng, 0.3, 3.5),
            rng.uniform(0, 0.15),
            int(rng.integers(40, 96)) if rng.random() < 0.5 else 0,
            rng.random() < 0.08,
            rng.uniform(0.7, 1.2) if rng.random() < 0.3 else 1.0,
        )

    def picture(self, rng: Generator, light: Plane, averaged: bool) -> NDArray[np.uint8]:
        """(H, W, 3) uint8; averaged : over several exposures, so with little noise."""
        seen = np.clip(light, 0, None)
        if self.gamma != 1:
            seen = 128 * (seen / 128) ** np.float32(self.gamma)
        if self.blur > 0.3:
            seen = cv2.GaussianBlur(seen, (0, 0), self.blur)
        if self.gray:
            seen = np.repeat(seen.mean(axis=2, keepdims=True), 3, axis=2)
        sigma = np.sqrt(self.noise**2 + self.shot * np.clip(seen, 0, 255)) * (0.3 if averaged else 1.0)
        noise = rng.standard_normal((*seen.shape[:2], 1 if self.gray else 3), np.float32)
        picture = np.asarray(np.clip(seen + sigma * noise, 0, 255).round(), np.uint8)
        if self.quality:
            _, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, self.quality])
            picture = np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)
        return picture
