"""Ground truth of a simulated frame, in raw or processed coordinates."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.sim.camera import Camera, Points
from tactflow.sim.elastic import force
from tactflow.sim.gel import Press, displacement, in_contact, reached, surface

FLOW_POINTS = 1500
"""Points around a contact at which the displacement is computed, with interpolation in between. With
FLOW_FINE, the mean over a contact is accurate to 0.01 px (five scenes, against four times the points)."""
FLOW_FINE = 0.5
"""Spacing of the points tested for contact, processed px."""

NO_DIRECTION = 0.02
"""Anisotropy (difference over sum of the principal second moments) below which a region has no direction.
Chosen by hand: an axis ratio of 1.02."""


@dataclass(frozen=True)
class View:
    """Pixel coordinates of a truth.

    mapping : `PixelMapping` to the processed frame; None for raw pixels.
    """

    camera: Camera
    mapping: Any

    @property
    def size(self) -> tuple[int, int]:
        """(width, height), px."""
        size: tuple[int, int] = self.camera.size if self.mapping is None else self.mapping.size
        return size

    def to_raw(self, points: Points) -> Points:
        """Raw pixels of points (N, 2)."""
        return points if self.mapping is None else np.asarray(self.mapping.to_raw(points), np.float64)

    def from_raw(self, raw: Points) -> Points:
        """Points (N, 2) of raw pixels."""
        return raw if self.mapping is None else np.asarray(self.mapping.to_processed(raw), np.float64)

    @property
    def grid(self) -> Points:
        """(H * W, 2): x and y of every pixel, line by line."""
        width, height = self.size
        x, y = np.meshgrid(np.arange(width), np.arange(height))
        return np.stack([x, y], axis=-1).reshape(-1, 2).astype(np.float64)


@dataclass(frozen=True, eq=False)
class Truth:
    """Ground truth of one frame. Coordinates as in `tactflow.vision.types`.

    touching : whether the contact covers at least one pixel of the frame.
    contact_mask : (H, W) bool, true where the gel is in contact at the pixel's centre.
    center : (x, y) centroid of the contact region, px; None without a contact.
    angle : principal direction of the region, degrees in (-90, 90]; None for a disc and without a contact.
    hull : (N, 2) float64, vertices of the convex hull of the region's pixel centres, in order; (0, 2)
        without a contact.
    area : of that hull, px^2.
    depth : of the deepest indenter, raw px, 0 without a contact.
    stick_ratio : share of the contact's area that sticks to the indenter, minimum over indenters; None
        without a contact. slipping : whether an indenter slides over the gel.
    origin, position : (N, 2) float64, printed markers on the untouched gel and now.
    visible : (N,) bool, whether a marker is visible: centre inside the frame, lit, not vanished.
    inside : (N,) bool, whether a marker is visible and its centre lies in the contact.
    mean_flow : (dx, dy), mean displacement of the markers inside, px; None if there are none.

    Expensive values are computed on first access.
    """

    touching: bool
    contact_mask: NDArray[np.bool_]
    center: tuple[float, float] | None
    angle: float | None
    hull: Points
    area: float
    origin: Points
    position: Points
    visible: NDArray[np.bool_]
    inside: NDArray[np.bool_]
    mean_flow: tuple[float, float] | None
    depth: float
    stick_ratio: float | None
    slipping: bool
    _pressed: Sequence[Press] = field(repr=False)
    _view: View = field(repr=False)
    _process: Any = field(repr=False)
    _clean: Callable[[], NDArray[np.uint8]] = field(repr=False)

    def displacement(self, points: Points) -> Points:
        """Displacement (N, 2) float64, px, of the gel that rests at points (N, 2)."""
        camera = self._view.camera
        rest = camera.to_gel(self._view.to_raw(points))
        return self._view.from_raw(camera.to_raw(rest + displacement(self._pressed, rest))) - points

    @cached_property
    def contact_flow(self) -> tuple[float, float] | None:
        """Area-weighted mean displacement (dx, dy), px, of the gel in contact; None without contact.

        Unlike `mean_flow`, it does not depend on the positions of markers.
        """
        if not self.touching:
            return None
        rows, columns = np.nonzero(self.contact_mask)
        markers = self.position - self.origin
        # Bounding box of the rest positions of the gel in contact.
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

    def _touched(self, points: Points) -> NDArray[np.bool_]:
        """(rows, columns) bool: whether points (rows, columns, 2) are in contact and inside the frame."""
        raw = self._view.to_raw(points.reshape(-1, 2))
        gel = self._view.camera.to_gel(raw).astype(np.float32).reshape(points.shape)
        visible_pixels = self._view.camera.sees(raw).reshape(points.shape[:2])
        return visible_pixels & in_contact(self._pressed, gel[..., 0], gel[..., 1])

    @cached_property
    def unmarked(self) -> NDArray[np.uint8]:
        """(H, W, 3) uint8 BGR: the frame without markers, dirt and noise."""
        image = self._clean()
        if self._process is None:
            return image
        if callable(self._process):
            return np.array(self._process(image), dtype=np.uint8)
        return _resampled(image, self._process)

    @cached_property
    def sunk(self) -> NDArray[np.float32]:
        """(H, W) float32: depth of the gel's surface, raw px, maximum over presses."""
        gel_x, gel_y, visible_pixels = _pixel_centres(self._view)
        lowest = np.zeros(gel_x.shape, np.float32)
        for press in self._pressed:
            if press.touching:
                np.maximum(lowest, surface(press, reached(press, gel_x, gel_y)), out=lowest)
        return np.where(visible_pixels, lowest, np.float32(0))

    @cached_property
    def force(self) -> tuple[float, float, float]:
        """(x, y, z), N, on the gel: x right and y down in the picture, z presses (`tactflow.sim.elastic`).

        x and y along the axes of the picture where the first indenter presses.
        """
        x, y, z = force(self._pressed)
        if not self._pressed or not (x or y):
            return x, y, z
        here = np.array([[self._pressed[0].x, self._pressed[0].y]])
        raw = self._view.camera.to_raw(np.concatenate([here, here + np.array([x, y]) / np.hypot(x, y)]))
        start, end = self._view.from_raw(raw)
        along = (end - start) * (np.hypot(x, y) / np.hypot(*(end - start)))
        return float(along[0]), float(along[1]), z


def measure(
    pressed: Sequence[Press],
    camera: Camera,
    origin: Points,
    position: Points,
    shown: NDArray[np.bool_],
    process: Any,
    clean: Callable[[], NDArray[np.uint8]],
) -> Truth:
    """Compute the truth of a frame.

    origin, position : (N, 2) float64 raw pixels. shown : (N,) bool, false where a marker has vanished.
    process : the `mapping` of `Scene.truth`. clean : renders the raw frame without markers and noise.
    """
    view = View(camera, getattr(process, "mapping", process))
    mask, columns, rows = _contact(pressed, view)
    touching = len(rows) > 0
    hull = np.empty((0, 2))
    if touching:
        points = np.stack([columns, rows], axis=1).astype(np.int32)
        hull = cv2.convexHull(points).reshape(-1, 2).astype(np.float64)
    raw = position
    origin, position = view.from_raw(origin), view.from_raw(position)
    nearest = np.rint(position).astype(np.int64)
    lit = camera.aperture(raw) >= 0.5
    visible = shown & lit & np.all((nearest >= 0) & (nearest < mask.shape[::-1]), axis=1)
    gel = camera.to_gel(raw).astype(np.float32)
    inside = visible & in_contact(pressed, gel[:, 0], gel[:, 1])
    dx, dy = (position - origin)[inside].mean(axis=0) if inside.any() else (0.0, 0.0)
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
        mean_flow=(float(dx), float(dy)) if inside.any() else None,
        depth=max((press.depth for press in pressed), default=0.0) if touching else 0.0,
        stick_ratio=min((press.stick_ratio for press in pressed), default=None) if touching else None,
        slipping=touching and any(press.sliding for press in pressed),
        _pressed=pressed,
        _view=view,
        _process=process,
        _clean=clean,
    )


def principal_angle(columns: NDArray[np.int64], rows: NDArray[np.int64]) -> float | None:
    """Principal direction of a region by its second moments, degrees in (-90, 90]; None if isotropic.

    columns, rows : (n,) int, x and y of the region's pixels.
    """
    x, y = columns - columns.mean(), rows - rows.mean()
    xx, yy, xy = float(np.mean(x * x)), float(np.mean(y * y)), float(np.mean(x * y))
    if np.hypot(xx - yy, 2 * xy) <= NO_DIRECTION * (xx + yy):
        return None
    # Negative because y points down and angles are counter-clockwise on the screen.
    angle = -0.5 * float(np.degrees(np.arctan2(2 * xy, xx - yy)))
    return 90.0 if angle <= -90.0 else angle


@lru_cache(maxsize=8)
def _pixel_centres(view: View) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
    """Gel coordinates x and y (H, W) of pixel centres, and whether the raw frame covers them."""
    width, height = view.size
    raw = view.to_raw(view.grid)
    mapped = view.camera.to_gel(raw).astype(np.float32).reshape(height, width, 2)
    x, y = (np.ascontiguousarray(mapped[..., axis]) for axis in (0, 1))
    return x, y, view.camera.sees(raw).reshape(height, width)


def _contact(
    pressed: Sequence[Press], view: View
) -> tuple[NDArray[np.bool_], NDArray[np.int64], NDArray[np.int64]]:
    """The contact mask (H, W), and x and y (n,) of its pixels, line by line."""
    gel_x, gel_y, visible_pixels = _pixel_centres(view)
    near = np.zeros(gel_x.shape, dtype=np.bool_)
    for press in pressed:
        if press.touching:
            reach = press.shape.reach
            near |= (np.abs(gel_x - np.float32(press.x)) < reach) & (
                np.abs(gel_y - np.float32(press.y)) < reach
            )
    left, top, width, height = cv2.boundingRect(near.astype(np.uint8))
    part = slice(top, top + height), slice(left, left + width)
    mask = np.zeros(gel_x.shape, dtype=np.bool_)
    mask[part] = in_contact(pressed, gel_x[part], gel_y[part]) & visible_pixels[part]
    rows, columns = np.nonzero(mask)
    return mask, columns, rows


def _resampled(image: NDArray[np.uint8], mapping: Any) -> NDArray[np.uint8]:
    """Resample an image to processed pixels: the mean of 2 x 2 bilinear samples each."""
    width, height = mapping.size
    total = np.zeros((height, width, 3), np.float32)
    for x, y in _sample_points(mapping):
        total += cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.rint(total / 4.0).astype(np.uint8)


@lru_cache(maxsize=8)
def _sample_points(mapping: Any) -> list[tuple[NDArray[np.float32], NDArray[np.float32]]]:
    """Raw coordinates (H, W) of the four samples of each processed pixel."""
    width, height = mapping.size
    grid = View(Camera(), mapping).grid
    samples = []
    for shift in ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)):
        raw = np.asarray(mapping.to_raw(grid + shift), dtype=np.float32).reshape(height, width, 2)
        samples.append((np.ascontiguousarray(raw[..., 0]), np.ascontiguousarray(raw[..., 1])))
    return samples
