"""Ground truth of a simulated frame, in raw or processed coordinates."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property, lru_cache
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.sim.camera import Camera
from tactflow.sim.gel import MM_PER_PX, Press, displacement, force, in_contact, reached, surface
from tactflow.vision.arrays import Points
from tactflow.vision.geometry import PixelMapping

FLOW_POINTS: Final = 1500
"""Points around a contact between which the displacement is interpolated. With FLOW_SPACING_PX, the mean
over a contact is accurate to 0.01 px (five scenes, against four times the points)."""
FLOW_SPACING_PX: Final = 0.5
"""Spacing of the points tested for contact, processed px."""
MIN_ANISOTROPY: Final = 0.02
"""Anisotropy (difference over sum of the principal second moments) below which a region has no direction:
an axis ratio of 1.02. Chosen by hand."""


class Truth:
    """Ground truth of one frame. Coordinates as in `tactflow.vision.types`.

    Attributes
    ----------
    touching : whether the contact covers at least one pixel of the frame.
    contact_mask : (H, W) bool, true where an indenter lies below the untouched gel at the pixel's centre.
    center : (x, y) centroid of the contact region, px; None without a contact.
    angle : principal direction of the region, degrees in (-90, 90]; None for a disc and without a contact.
    hull : (N, 2) float64, vertices of the convex hull of the region's pixel centres, in order; (0, 2)
        without a contact.
    area : of that hull, px^2.
    depth : of the deepest indenter, raw px, 0 without a contact.
    stick_ratio : share of the contact's area that sticks to the indenter, minimum over indenters; None
        without a contact.
    slipping : whether an indenter slides over the gel.
    origin, position : (N, 2) float64, printed markers on the untouched gel and now.
    visible : (N,) bool, whether a marker is visible: centre inside the frame, lit, not vanished.
    """

    def __init__(
        self,
        presses: Sequence[Press],
        camera: Camera,
        mapping: PixelMapping,
        rest: Points,
        shown: NDArray[np.bool_],
    ) -> None:
        """rest : (N, 2), the markers as printed, gel px. shown : (N,), false where a marker has vanished."""
        self._presses, self._camera, self._mapping = presses, camera, mapping
        gel_x, gel_y, lit = _pixel_centres(camera, mapping)
        self.contact_mask = in_contact(presses, gel_x, gel_y) & lit
        rows, columns = np.nonzero(self.contact_mask)
        self.touching = len(rows) > 0
        self.center: tuple[float, float] | None = None
        self.angle: float | None = None
        self.hull, self.area, self.depth = np.empty((0, 2)), 0.0, 0.0
        self.stick_ratio: float | None = None
        self.slipping = False
        if self.touching:
            hull = cv2.convexHull(np.stack([columns, rows], axis=1).astype(np.int32))
            self.hull, self.area = hull.reshape(-1, 2).astype(np.float64), float(cv2.contourArea(hull))
            self.center = float(columns.mean()), float(rows.mean())
            self.angle = _principal_angle(columns, rows)
            self.depth = max(press.depth for press in presses)
            self.stick_ratio = min(press.stick_ratio for press in presses)
            self.slipping = any(press.sliding for press in presses)
        raw = camera.to_raw(rest + displacement(presses, rest))
        self.origin, self.position = mapping.to_processed(camera.to_raw(rest)), mapping.to_processed(raw)
        pixel = np.rint(self.position)
        in_frame = np.all((pixel >= 0) & (pixel < mapping.size), axis=1)
        self.visible = shown & (camera.aperture(raw) >= 0.5) & in_frame

    def displacement(self, points: Points) -> Points:
        """Displacement (N, 2) float64, px, of the gel that rests at points (N, 2)."""
        rest = self._camera.to_gel(self._mapping.to_raw(points))
        now = self._camera.to_raw(rest + displacement(self._presses, rest))
        return self._mapping.to_processed(now) - points

    @cached_property
    def contact_flow(self) -> tuple[float, float] | None:
        """Area-weighted mean displacement (dx, dy), px, of the gel in contact; None without contact."""
        if not self.touching:
            return None
        rows, columns = np.nonzero(self.contact_mask)
        markers = self.position - self.origin
        # Bounding box of the rest positions of the gel in contact.
        low = np.array([columns.min(), rows.min()]) - markers.max(axis=0, initial=0)
        high = np.array([columns.max(), rows.max()]) - markers.min(axis=0, initial=0)
        step = max(2.0, float(np.sqrt(np.prod(high - low) / FLOW_POINTS)))
        x, y = (np.arange(low[axis] - 2 * step, high[axis] + 2 * step, step) for axis in (0, 1))
        rest = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        coarse = self.displacement(rest)
        raw = self._mapping.to_raw(rest + coarse)
        gel = self._camera.to_gel(raw)
        parts = round(step / FLOW_SPACING_PX)
        fine = (len(x) * parts, len(y) * parts)
        moved, raw, gel = (
            np.asarray(cv2.resize(grid.reshape(len(y), len(x), 2), fine), np.float64)
            for grid in (coarse, raw, gel)
        )
        gel_x, gel_y = np.moveaxis(gel.astype(np.float32), -1, 0)
        inside = self._camera.sees(raw) & in_contact(self._presses, gel_x, gel_y)
        if not inside.any():
            return None
        dx, dy = moved[inside].mean(axis=0)
        return float(dx), float(dy)

    @cached_property
    def sunk(self) -> NDArray[np.float32]:
        """(H, W) float32: depth of the gel's surface, raw px, maximum over presses."""
        gel_x, gel_y, lit = _pixel_centres(self._camera, self._mapping)
        lowest = np.zeros(gel_x.shape, np.float32)
        for press in self._presses:
            if press.touching:
                np.maximum(lowest, surface(press, reached(press, gel_x, gel_y)), out=lowest)
        return np.where(lit, lowest, np.float32(0))

    @cached_property
    def pose(self) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
        """Rotation (3, 3) and position (3,), mm, of the first indenter's centre; None without contact.

        Axes as in `Scale`, from the centre of the processed frame and the untouched surface. Relative to an
        earlier frame of the same contact, it is how the object has moved.
        """
        if not self.touching:
            return None
        press = self._presses[0]
        here = np.array([press.x, press.y]) + np.array([[0, 0], [1, 0], [0, 1]])
        center, *ends = self._mapping.to_processed(self._camera.to_raw(here))
        axes = np.eye(3)
        axes[:2, :2] = (np.array(ends) - center).T
        scale = float(np.sqrt(np.linalg.det(axes)))
        axes[:2, :2] /= scale
        turn, _ = cv2.Rodrigues(np.array([0.0, 0.0, press.angle]))
        tilt, _ = cv2.Rodrigues(np.array(press.tilt))
        across = (center - (np.array(self._mapping.size) - 1) / 2) * MM_PER_PX / scale
        return axes @ turn @ tilt @ axes.T, np.array(
            [*across, (press.shape.center - press.depth) * MM_PER_PX]
        )

    @cached_property
    def force(self) -> tuple[float, float, float]:
        """(x, y, z), N, on the gel: x right and y down in the picture, z presses.

        x and y along the axes of the picture where the first indenter presses.
        """
        x, y, z = force(self._presses)
        if not (x or y):
            return x, y, z
        here = np.array([[self._presses[0].x, self._presses[0].y]])
        raw = self._camera.to_raw(np.concatenate([here, here + np.array([x, y]) / np.hypot(x, y)]))
        start, end = self._mapping.to_processed(raw)
        along = (end - start) * (np.hypot(x, y) / np.hypot(*(end - start)))
        return float(along[0]), float(along[1]), z


def _principal_angle(columns: NDArray[np.int64], rows: NDArray[np.int64]) -> float | None:
    """Principal direction of pixels x, y (n,) by second moments, degrees in (-90, 90]; None if isotropic."""
    x, y = columns - columns.mean(), rows - rows.mean()
    xx, yy, xy = float(np.mean(x * x)), float(np.mean(y * y)), float(np.mean(x * y))
    if np.hypot(xx - yy, 2 * xy) <= MIN_ANISOTROPY * (xx + yy):
        return None
    # Negative because y points down and angles are counter-clockwise on the screen.
    angle = -0.5 * float(np.degrees(np.arctan2(2 * xy, xx - yy)))
    return 90.0 if angle <= -90.0 else angle


@lru_cache(maxsize=8)
def _pixel_centres(
    camera: Camera, mapping: PixelMapping
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
    """Gel coordinates x and y (H, W) of pixel centres, and whether the raw frame shows the gel there."""
    width, height = mapping.size
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 2)
    raw = mapping.to_raw(pixels)
    mapped = camera.to_gel(raw).astype(np.float32).reshape(height, width, 2)
    x, y = (np.ascontiguousarray(mapped[..., axis]) for axis in (0, 1))
    return x, y, camera.sees(raw).reshape(height, width)
