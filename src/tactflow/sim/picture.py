"""Render the frames of a simulated scene."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.sim import camera as optics
from tactflow.sim import gel, light, markers
from tactflow.sim.camera import CENTER, FPS, HALF_DIAGONAL, SIZE, Camera
from tactflow.sim.markers import FIXED_POINT_STEPS
from tactflow.sim.settings import Settings

Canvas = NDArray[np.int16]
"""(H, W, 3) grey levels times `FIXED_POINT_STEPS`."""

_GRID_STEP_PX = 2
"""Grid spacing of the gel's surface, raw px; its shading is smooth. Chosen by hand."""
_LAMP_FRACTION = 0.475
"""Fraction of a recording after which the lamp is on: between the two contacts."""
_BRIGHT_MARKER_GREY = 225.0
"""Grey level of a bright marker; chosen by hand, below saturation."""


class Painter:
    """Draws the camera's view of the gel.

    Parameters
    ----------
    layout : the markers as printed.
    """

    def __init__(self, settings: Settings, camera: Camera, layout: markers.Layout) -> None:
        self._settings = settings
        self._camera = camera
        self._layout = layout
        self._light = light.LIGHTS[settings.light]
        widened = 1.0 if camera.identity else 1.6 if settings.perspective else 1.2
        self._half = markers.half_patch(layout.radius * (1.0 + settings.sizes), settings.shape, widened)

    def frame(
        self, index: int, pressed: Sequence[gel.Press], shown: NDArray[np.bool_] | None
    ) -> NDArray[np.uint8]:
        """Render raw frame `index`, a new (600, 800, 3) uint8 BGR array.

        shown : (N,), false for invisible markers; None for a frame without markers, dirt and noise.
        """
        settings = self._settings
        canvas = self._canvas(index, pressed, shown)
        scale = self._gain(index) / FIXED_POINT_STEPS
        if shown is None:
            return np.asarray(cv2.addWeighted(canvas, scale, canvas, 0.0, 0.0, dtype=cv2.CV_8U), np.uint8)
        # Drawing the noise of a seed takes 0.3 s; without any, the canvas takes its place with weight 0.
        noisy_camera = settings.noise or settings.shot
        noise = optics.sensor_noise(settings.seed, index, canvas.shape) if noisy_camera else canvas
        if settings.shot:
            noisy = np.asarray(canvas, np.float32) * np.float32(scale)
            spread = np.sqrt(settings.noise**2 + settings.shot**2 * np.maximum(noisy, 0) / np.float32(128.0))
            noisy += spread * (noise * np.float32(1.0 / optics.NOISE_UNIT))
            image = cv2.convertScaleAbs(np.maximum(noisy, 0, out=noisy))
        else:
            level = settings.noise / optics.NOISE_UNIT
            image = cv2.addWeighted(canvas, scale, noise, level, 0.0, dtype=cv2.CV_8U)
        if settings.hot:
            rng = np.random.default_rng([settings.seed, 0x686F])
            x, y = rng.integers(0, SIZE[0], settings.hot), rng.integers(0, SIZE[1], settings.hot)
            image[y, x] = rng.integers(200, 256, (settings.hot, 3)).astype(np.uint8)
        if settings.jpeg:
            image = optics.compressed(np.asarray(image, np.uint8), settings.jpeg)
        return np.asarray(image, dtype=np.uint8)

    def _gain(self, index: int) -> float:
        settings = self._settings
        seconds = index / FPS
        warm = 1.0 + settings.drift * (1.0 - float(np.exp(-seconds / 5.0)))
        return warm * (1.0 + settings.flicker * float(np.sin(2 * np.pi * 100.0 * seconds)))

    def _canvas(self, index: int, pressed: Sequence[gel.Press], shown: NDArray[np.bool_] | None) -> Canvas:
        """A frame before gain and noise, possibly a view. shown : None to omit markers and dirt."""
        settings = self._settings
        if not pressed:
            padded = self._resting if shown is None else self._resting_marked
        else:
            padded = self._resting.copy()
            for press in pressed:
                self._shade(padded, press)
            if shown is not None:
                self._mark(padded, pressed, shown)
        half = self._half
        canvas = padded[half:-half, half:-half]
        if settings.stray:
            canvas = self._with_reflections(canvas, pressed)
        if settings.blur:
            canvas = np.asarray(cv2.GaussianBlur(canvas, (0, 0), settings.blur), dtype=np.int16)
        if settings.gain:
            rows = np.arange(SIZE[1], dtype=np.float32) / SIZE[1]
            wave = np.sin(2 * np.pi * (2.0 * rows - 0.37 * index)).astype(np.float32)
            banded = canvas * (np.float32(1.0) + np.float32(settings.gain) * wave)[:, None, None]
            canvas = np.rint(banded, out=banded).astype(np.int16)
        if settings.lamp and index >= _LAMP_FRACTION * settings.frames:
            lamp = light.lamp(SIZE, settings.lamp)
            canvas = np.asarray(cv2.multiply(canvas, lamp, dtype=cv2.CV_16S), np.int16)
        return canvas

    def _gel_blocks(self, step: int) -> NDArray[np.float64]:
        """(600 // step, 800 // step, 2): gel coordinates of the centres of blocks of step x step raw px."""
        width, height = SIZE
        across = np.arange(width // step) * step + (step - 1) / 2.0
        down = np.arange(height // step) * step + (step - 1) / 2.0
        points = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)
        return self._camera.to_gel(points).reshape(height // step, width // step, 2)

    @cached_property
    def _coarse(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Gel coordinates x and y of the centres of blocks of `_GRID_STEP_PX` raw pixels a side."""
        mapped = self._gel_blocks(_GRID_STEP_PX).astype(np.float32)
        return np.ascontiguousarray(mapped[..., 0]), np.ascontiguousarray(mapped[..., 1])

    @cached_property
    def _resting(self) -> Canvas:
        """The untouched gel without markers, padded."""
        settings = self._settings
        width, height = SIZE
        raw_x, raw_y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
        dim = 0.65 if settings.polarity == "bright" else 1.0
        image = light.untouched_gel(self._light, raw_x, raw_y, dim)
        if settings.texture:
            image *= light.texture((height, width), settings.texture, settings.seed)
        if settings.vignette:
            radius = ((raw_x - CENTER[0]) ** 2 + (raw_y - CENTER[1]) ** 2) / np.float32(HALF_DIAGONAL**2)
            image *= (np.float32(1.0) - np.float32(settings.vignette) * radius)[..., None]
        if settings.perspective:
            image *= self._gel_window()
        if settings.aperture:
            image *= self._aperture[..., None]
        np.clip(image, 0, 500, out=image)
        fixed = np.rint(image * np.float32(FIXED_POINT_STEPS)).astype(np.int16)
        half = self._half
        return np.asarray(cv2.copyMakeBorder(fixed, half, half, half, half, cv2.BORDER_REPLICATE), np.int16)

    @cached_property
    def _aperture(self) -> NDArray[np.float32]:
        """(H, W): fraction of light transmitted by the aperture."""
        width, height = SIZE
        raw = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float64)
        return self._camera.aperture(raw).astype(np.float32)

    def _gel_window(self) -> NDArray[np.float32]:
        """(H, W, 1): 1 on the gel, nearly 0 outside, where a tilted camera sees past its edge."""
        x, y = np.moveaxis(self._gel_blocks(1), -1, 0)
        width, height = SIZE
        inside = np.minimum.reduce([x + 0.5, width - 0.5 - x, y + 0.5, height - 0.5 - y])
        window = 0.06 + 0.94 / (1.0 + np.exp(-np.clip(inside, -40, 40) / 2.0))
        return np.asarray(window[..., None], dtype=np.float32)

    @cached_property
    def _resting_marked(self) -> Canvas:
        canvas = self._resting.copy()
        self._mark(canvas, (), np.ones(len(self._layout.rest), np.bool_))
        return canvas

    def _mark(self, canvas: Canvas, pressed: Sequence[gel.Press], shown: NDArray[np.bool_]) -> None:
        """Paint dirt and markers onto a padded canvas, in place."""
        layout, camera, settings = self._layout, self._camera, self._settings
        if settings.dirty and len(layout.rest):
            rest, strength, deform = self._dirt
            centers = camera.to_raw(rest + gel.displacement(pressed, rest))
            # Specks may overlap, so each is drawn separately.
            groups = np.arange(len(rest))
            radii = np.full(len(rest), layout.radius)
            markers.draw(canvas, centers, strength, groups, radii, half=self._half, deform=deform)
        now = layout.rest + gel.displacement(pressed, layout.rest)
        raw = camera.to_raw(now)
        markers.draw(
            canvas,
            raw,
            layout.contrast * shown * camera.aperture(raw),
            layout.group,
            layout.radii,
            shape=settings.shape,
            bright=_BRIGHT_MARKER_GREY if settings.polarity == "bright" else None,
            half=self._half,
            deform=None if camera.identity else camera.local_inverse(now),
        )

    @cached_property
    def _dirt(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Specks on the gel: rest positions (N, 2), strengths (N,), deformations (N, 2, 2)."""
        rng = np.random.default_rng([self._settings.seed, 0x6469])
        count = round(self._settings.dirty * len(self._layout.rest))
        rest = rng.uniform((0, 0), SIZE, (count, 2))
        squeeze = rng.uniform(1.4, 3.2, (count, 2))
        angle = rng.uniform(0, np.pi, count)
        cos, sin = np.cos(angle), np.sin(angle)
        axes = np.stack([np.stack([cos, sin], -1), np.stack([-sin, cos], -1)], 1)
        return rest, rng.uniform(0.2, 0.75, count), axes * squeeze[:, :, None]

    def _with_reflections(self, canvas: Canvas, pressed: Sequence[gel.Press]) -> Canvas:
        """Add the stray reflection of each contact, a bright streak on the opposite side of the frame."""
        center = np.array(SIZE) / 2.0
        for press in pressed:
            away = center - self._camera.to_raw(np.array([[press.x, press.y]]))[0]
            away /= max(float(np.hypot(*away)), 1.0)
            x, y = center + away * (320.0, 220.0)
            level = 90.0 * self._settings.stray * press.depth / press.shape.depth * FIXED_POINT_STEPS
            streak = np.float32(level) * light.spot(SIZE, (x, y), (16.0, 48.0))
            canvas = np.asarray(cv2.add(canvas, cv2.merge([streak] * 3), dtype=cv2.CV_16S), np.int16)
        return canvas

    def _shade(self, padded: Canvas, press: gel.Press) -> None:
        """Shade the part of a padded canvas that a contact deforms, in place."""
        window = self._window(press) if press.depth > 0 else None
        if window is None:
            return
        rows, columns = window
        x, y = self._coarse
        depth = gel.reached(press, x[window], y[window])
        sunk = gel.surface(press, depth)
        fine = tuple(slice(_GRID_STEP_PX * part.start, _GRID_STEP_PX * part.stop) for part in (rows, columns))
        half = self._half
        region = padded[half:-half, half:-half][fine]
        full = (region.shape[1], region.shape[0])
        shading = cv2.resize(
            light.shading(self._light, sunk, _GRID_STEP_PX), full, interpolation=cv2.INTER_LINEAR
        )
        lit = cv2.multiply(region, shading, dtype=cv2.CV_32F)
        if self._light.brightening:
            added = light.brightness(self._light, press, depth)
            wide = cv2.resize(added, full, interpolation=cv2.INTER_LINEAR) * np.float32(FIXED_POINT_STEPS)
            if self._settings.aperture:
                wide *= self._aperture[fine]
            lit = cv2.add(lit, cv2.merge([wide, wide, wide]))
        np.clip(lit, 0, 32000, out=lit)
        region[...] = np.rint(lit, out=lit)

    def _window(self, press: gel.Press) -> tuple[slice, slice] | None:
        """Rows and columns of the coarse grid that a contact deforms, or None."""
        reach = press.shape.reach
        turn = np.linspace(0, 2 * np.pi, 33)
        ring = np.stack([press.x + reach * np.cos(turn), press.y + reach * np.sin(turn)], axis=1)
        if not self._camera.identity:
            ring = self._camera.to_raw(np.clip(ring, (-60.0, -60.0), (SIZE[0] + 60.0, SIZE[1] + 60.0)))
        low = np.floor(ring.min(axis=0) / _GRID_STEP_PX).astype(int) - 2
        high = np.ceil(ring.max(axis=0) / _GRID_STEP_PX).astype(int) + 3
        left, top = max(int(low[0]), 0), max(int(low[1]), 0)
        right, bottom = (
            min(int(high[0]), SIZE[0] // _GRID_STEP_PX),
            min(int(high[1]), SIZE[1] // _GRID_STEP_PX),
        )
        return None if right - left < 3 or bottom - top < 3 else (slice(top, bottom), slice(left, right))
