"""What a simulated frame really shows, in raw or in processed coordinates."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache, partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.sim.camera import Camera
from tactflow.sim.elastic import force
from tactflow.sim.gel import Press, displacement, in_contact, reached, surface

FLOW_POINTS = 1500
"""Points of the gel around a contact at which its displacement is computed; in between it is interpolated.
With FLOW_FINE, the mean over a contact is right to 0.01 px (five scenes, against four times the points)."""
FLOW_FINE = 0.5
"""Distance of the points at which it is asked whether they are in contact, processed px."""

NO_DIRECTION = 0.02
"""Anisotropy (difference over sum of the principal second moments) below which a region has no direction.
Chosen by hand: an axis ratio of 1.02."""


@dataclass(frozen=True, eq=False)
class Truth:
    """The truth about one frame. Coordinates as in `tactflow.vision.types`.

    touching : whether the contact covers at least one pixel of the frame.
    contact_mask : (H, W) bool, true where the gel is in contact at the pixel's centre.
    center : (x, y) centroid of the contact region, px; None without a contact.
    angle : principal direction of the region, degrees in (-90, 90]; None for a disc and without a contact.
    hull : (N, 2) float64, vertices of the convex hull of the region's pixel centres, in order; (0, 2)
        without a contact.
    area : of that hull, px^2.
    depth : of the deepest indenter, raw px, 0 without a contact: how faint the contact is.
    stick_ratio : share of the contact's area on which the gel sticks to the indenter, the least of several;
        None without a contact. slipping : whether one slides over the gel.
    origin : (N, 2) float64, markers on the untouched gel. position : (N, 2) float64, now. Markers that were
        never printed are not listed.
    visible : (N,) bool, whether a marker can be seen in this frame: its centre inside, lit, not vanished.
    inside : (N,) bool, whether a marker is visible and its centre lies in the contact.
    mean_flow : (dx, dy), mean displacement of the markers inside, px; None where there are none.
    """

    touching: bool
    contact_mask: NDArray[np.bool_]
    center: tuple[float, float] | None
    angle: float | None
    hull: NDArray[np.float64]
    area: float
    origin: NDArray[np.float64]
    position: NDArray[np.float64]
    visible: NDArray[np.bool_]
    inside: NDArray[np.bool_]
    mean_flow: tuple[float, float] | None
    depth: float
    stick_ratio: float | None
    slipping: bool
    _render: Callable[[], NDArray[np.uint8]] = field(repr=False)
    _lower: Callable[[], NDArray[np.float32]] = field(repr=False)
    _move: Callable[[NDArray[np.float64]], NDArray[np.float64]] = field(repr=False)
    _touched: Callable[[NDArray[np.float64]], NDArray[np.bool_]] = field(repr=False)
    _push: Callable[[], tuple[float, float, float]] = field(repr=False)

    def displacement(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N, 2) float64: how far the gel has moved that rests at points (N, 2), px."""
        return self._move(points) - points

    @cached_property
    def contact_flow(self) -> tuple[float, float] | None:
        """(dx, dy), px: mean displacement of the gel in contact, by its area at rest; None without contact.

        Unlike `mean_flow` it does not depend on which markers happen to lie inside.
        """
        if not self.touching:
            return None
        rows, columns = np.nonzero(self.contact_mask)
        markers = self.position - self.origin
        # Gel in contact was at rest where the contact is, less how far gel has moved.
        low = np.array([columns.min(), rows.min()]) - markers.max(axis=0, initial=0)
        high = np.array([columns.max(), rows.max()]) - markers.min(axis=0, initial=0)
        step = max(2.0, float(np.sqrt(np.prod(high - low) / FLOW_POINTS)))
        x, y = (np.arange(low[axis] - 2 * step, high[axis] + 2 * step, step) for axis in (0, 1))
        rest = np.stack(np.meshgrid(x, y), axis=-1)
        coarse = self.displacement(rest.reshape(-1, 2)).reshape(rest.shape)
        parts = round(step / FLOW_FINE)
        fine = (len(x) * parts, len(y) * parts)
        moved = np.asarray(cv2.resize(coarse, fine), np.float64)
        inside = self._touched(cv2.resize(rest, fine) + moved)
        if not inside.any():
            return None
        dx, dy = moved[inside].mean(axis=0)
        return float(dx), float(dy)

    @cached_property
    def unmarked(self) -> NDArray[np.uint8]:
        """(H, W, 3) uint8 BGR: the frame without markers, dirt and noise. Rendered when first asked for."""
        return self._render()

    @cached_property
    def sunk(self) -> NDArray[np.float32]:
        """(H, W) float32, raw px: how far the gel's surface has sunk. Computed when first asked for."""
        return self._lower()

    @cached_property
    def force(self) -> tuple[float, float, float]:
        """(x, y, z), N, on the gel: x right and y down in the picture, z presses (`tactflow.sim.elastic`)."""
        return self._push()


def pixel_mapping(mapping: Any) -> Any:
    """The coordinate mapping itself, from a mapping or from a preprocessor that has one."""
    return getattr(mapping, "mapping", mapping)


def principal_angle(columns: NDArray[np.int64], rows: NDArray[np.int64]) -> float | None:
    """Direction of the larger second moment of a region, degrees in (-90, 90]; None where it has none.

    columns, rows : (n,) int, x and y of the region's pixels.
    """
    x, y = columns - columns.mean(), rows - rows.mean()
    xx, yy, xy = float(np.mean(x * x)), float(np.mean(y * y)), float(np.mean(x * y))
    if np.hypot(xx - yy, 2 * xy) <= NO_DIRECTION * (xx + yy):
        return None
    # The sign turns the angle of image coordinates (y down) into one that is counter-clockwise on the screen.
    angle = -0.5 * float(np.degrees(np.arctan2(2 * xy, xx - yy)))
    return 90.0 if angle <= -90.0 else angle


def _pixels(width: int, height: int) -> NDArray[np.float64]:
    """(H * W, 2): x and y of every pixel, line by line."""
    return (
        np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 2).astype(np.float64)
    )


@lru_cache(maxsize=8)
def _pixel_centres(
    camera: Camera, size: tuple[int, int], mapping: Any
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
    """Gel coordinates (H, W) of each pixel's centre, and whether the raw frame covers it."""
    width, height = size if mapping is None else mapping.size
    grid = _pixels(width, height)
    raw = grid if mapping is None else np.asarray(mapping.to_raw(grid), dtype=np.float64)
    seen = np.all((raw >= -0.5) & (raw <= np.array(size) - 0.5), axis=1) & _lit(camera, raw)
    mapped = camera.to_gel(raw).astype(np.float32).reshape(height, width, 2)
    return (
        np.ascontiguousarray(mapped[..., 0]),
        np.ascontiguousarray(mapped[..., 1]),
        seen.reshape(height, width),
    )


def _lit(camera: Camera, raw: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(N,): which raw pixel positions (N, 2) are not in the black frame around the picture."""
    return camera.aperture(raw) >= 0.5


def _window(
    pressed: Sequence[Press], gel_x: NDArray[np.float32], gel_y: NDArray[np.float32]
) -> tuple[int, int, int, int]:
    """Rows and columns that hold every pixel within the reach of an indenter; empty where there is none."""
    near = np.zeros(gel_x.shape, dtype=np.bool_)
    for press in pressed:
        if press.touching:
            reach = press.shape.reach
            near |= (np.abs(gel_x - np.float32(press.x)) < reach) & (
                np.abs(gel_y - np.float32(press.y)) < reach
            )
    rows, columns = np.flatnonzero(near.any(axis=1)), np.flatnonzero(near.any(axis=0))
    if not len(rows):
        return 0, 0, 0, 0
    return int(rows[0]), int(rows[-1]) + 1, int(columns[0]), int(columns[-1]) + 1


def measure(
    pressed: Sequence[Press],
    camera: Camera,
    origin: NDArray[np.float64],
    position: NDArray[np.float64],
    shown: NDArray[np.bool_],
    size: tuple[int, int],
    mapping: Any,
    clean: Callable[[], NDArray[np.uint8]],
) -> Truth:
    """Put the truth together.

    origin, position : (N, 2) float64 raw pixels. shown : (N,) bool, false where a marker has vanished.
    mapping : see `Scene.truth`. clean : renders the raw frame without markers and noise.
    """
    to = pixel_mapping(mapping)
    mask, columns, rows = _contact(pressed, camera, size, to)
    touching = len(rows) > 0
    hull = np.empty((0, 2))
    if touching:
        points = np.stack([columns, rows], axis=1).astype(np.int32)
        hull = cv2.convexHull(points).reshape(-1, 2).astype(np.float64)
    raw = position
    if to is not None:
        origin = np.asarray(to.to_processed(origin), dtype=np.float64)
        position = np.asarray(to.to_processed(position), dtype=np.float64)
    nearest = np.rint(position).astype(np.int64)
    height, width = mask.shape
    visible = shown & _lit(camera, raw) & np.all((nearest >= 0) & (nearest < (width, height)), axis=1)
    gel = camera.to_gel(raw).astype(np.float32)
    inside = visible & in_contact(pressed, gel[:, 0], gel[:, 1])
    mean_flow = None
    if inside.any():
        moved = (position - origin)[inside].mean(axis=0)
        mean_flow = (float(moved[0]), float(moved[1]))
    return Truth(
        touching=touching,
        contact_mask=mask,
        center=(float(columns.mean()), float(rows.mean())) if touching else None,
        angle=principal_angle(columns, rows) if touching else None,
        hull=hull,
        area=float(cv2.contourArea(hull.astype(np.float32))) if touching else 0.0,
        origin=origin,
        position=position,
        visible=visible,
        inside=inside,
        mean_flow=mean_flow,
        depth=max((press.depth for press in pressed), default=0.0) if touching else 0.0,
        stick_ratio=min((press.stick_ratio for press in pressed), default=None) if touching else None,
        slipping=touching and any(press.sliding for press in pressed),
        _render=partial(_processed, clean, mapping),
        _lower=partial(_sunk, pressed, camera, size, to),
        _move=partial(_moved, pressed, camera, to),
        _touched=partial(_touched, pressed, camera, to, size),
        _push=partial(_pushed, pressed, camera, to),
    )


def _moved(
    pressed: Sequence[Press], camera: Camera, to: Any, points: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(N, 2): where the gel is now that rests at points (N, 2), in the truth's coordinates."""
    rest = camera.to_gel(points if to is None else np.asarray(to.to_raw(points), np.float64))
    now = camera.to_raw(rest + displacement(pressed, rest))
    return now if to is None else np.asarray(to.to_processed(now), np.float64)


def _pushed(pressed: Sequence[Press], camera: Camera, to: Any) -> tuple[float, float, float]:
    """The force, with x and y along the axes of the truth's coordinates where the first indenter presses."""
    x, y, z = force(pressed)
    if not pressed or not (x or y):
        return x, y, z
    here = np.array([[pressed[0].x, pressed[0].y]])
    raw = camera.to_raw(np.concatenate([here, here + np.array([x, y]) / np.hypot(x, y)]))
    start, end = raw if to is None else np.asarray(to.to_processed(raw), np.float64)
    along = (end - start) * (np.hypot(x, y) / np.hypot(*(end - start)))
    return float(along[0]), float(along[1]), z


def _touched(
    pressed: Sequence[Press], camera: Camera, to: Any, size: tuple[int, int], points: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """(rows, columns): which points (rows, columns, 2) show gel in contact; none outside of the picture."""
    flat = points.reshape(-1, 2)
    raw = flat if to is None else np.asarray(to.to_raw(flat), np.float64)
    gel = camera.to_gel(raw).astype(np.float32).reshape(points.shape)
    seen = np.all((raw >= -0.5) & (raw <= np.array(size) - 0.5), axis=1) & _lit(camera, raw)
    return np.asarray(seen.reshape(points.shape[:2]) & in_contact(pressed, gel[..., 0], gel[..., 1]))


def _sunk(pressed: Sequence[Press], camera: Camera, size: tuple[int, int], to: Any) -> NDArray[np.float32]:
    """How far the surface has sunk at each pixel's centre, (H, W) raw px: the deepest of all presses."""
    gel_x, gel_y, seen = _pixel_centres(camera, size, to)
    lowest = np.zeros(gel_x.shape, np.float32)
    for press in pressed:
        if press.touching:
            np.maximum(lowest, surface(press, reached(press, gel_x, gel_y)), out=lowest)
    return np.where(seen, lowest, np.float32(0))


def _contact(
    pressed: Sequence[Press], camera: Camera, size: tuple[int, int], to: Any
) -> tuple[NDArray[np.bool_], NDArray[np.int64], NDArray[np.int64]]:
    """The contact mask (H, W), and x and y (n,) of its pixels, line by line."""
    gel_x, gel_y, seen = _pixel_centres(camera, size, to)
    mask = np.zeros(gel_x.shape, dtype=np.bool_)
    top, bottom, left, right = _window(pressed, gel_x, gel_y)
    part = in_contact(pressed, gel_x[top:bottom, left:right], gel_y[top:bottom, left:right])
    part &= seen[top:bottom, left:right]
    mask[top:bottom, left:right] = part
    rows, columns = np.nonzero(part)
    return mask, columns + left, rows + top


def _processed(clean: Callable[[], NDArray[np.uint8]], mapping: Any) -> NDArray[np.uint8]:
    """The frame that `clean` renders, in processed pixels."""
    image = clean()
    if mapping is None:
        return image
    if callable(mapping):
        return np.array(mapping(image), dtype=np.uint8)
    return _resampled(image, mapping)


def _resampled(image: NDArray[np.uint8], mapping: Any) -> NDArray[np.uint8]:
    """The image in processed pixels: the mean of 2 x 2 bilinear samples of each processed pixel."""
    width, height = mapping.size
    total = np.zeros((height, width, 3), np.float32)
    for x, y in _sample_places(mapping):
        total += cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.rint(total / 4.0).astype(np.uint8)


@lru_cache(maxsize=8)
def _sample_places(mapping: Any) -> list[tuple[NDArray[np.float32], NDArray[np.float32]]]:
    """Raw coordinates (H, W) of the four samples of each processed pixel."""
    width, height = mapping.size
    grid = _pixels(width, height)
    places = []
    for shift in ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)):
        raw = np.asarray(mapping.to_raw(grid + shift), dtype=np.float32).reshape(height, width, 2)
        places.append((np.ascontiguousarray(raw[..., 0]), np.ascontiguousarray(raw[..., 1])))
    return places
