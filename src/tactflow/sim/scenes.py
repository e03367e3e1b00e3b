"""The named scenes of the simulated sensor: images on one side, the truth about them on the other."""

from __future__ import annotations

from functools import cached_property, partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.sim import camera as optics
from tactflow.sim import gel, light, markers, motion
from tactflow.sim.recipes import SCENES
from tactflow.sim.settings import Settings, parse_query
from tactflow.sim.truth import Truth, measure
from tactflow.system.spelling import did_you_mean

SIZE = (800, 600)
"""Width and height of every scene's frames, px."""
FPS = 60.0
"""Frames a second of every scene."""
_STEP = 2
"""The gel's surface is computed at every second pixel of the raw frame; the light on it is smooth. Chosen
by hand."""
_SPECKLE_STEP = 20
"""How far blotches are carried along is computed at every so many pixels; the gel stretches smoothly. Chosen
by hand."""
_INVERSIONS = 4
"""Steps of the fixed-point iteration that finds where a point of the gel came from. Chosen by hand: the
pattern need not be exact, only carried along."""
_LAMP_AT = 0.475
"""Part of a recording after which the lamp is on: between two contacts that share its length."""
_LARGEST_STROKE = 110.0
"""Contacts move the gel in proportion to the markers' pitch, up to this pitch, px. Chosen by hand."""


def scene_descriptions() -> dict[str, str]:
    """Scene -> what it shows, in one line."""
    return {name: recipe.description for name, recipe in SCENES.items()}


def scene_names() -> tuple[str, ...]:
    """The names that `open_scene` knows."""
    return tuple(SCENES)


def open_scene(spec: str) -> Scene:
    """Open a scene of the simulated sensor.

    spec : NAME or NAME?key=value&key=value, as in `press?frames=300&seed=7&noise=2`. `tactflow sim --list`
        shows the names; `tactflow.sim.KEYS` describes the keys.

    Raises
    ------
    ValueError : an unknown name or key, or a value that makes no sense, with what was expected.

    Examples
    --------
    >>> import tactflow
    >>> scene = tactflow.open_scene("press?frames=60&seed=7")
    >>> len(scene), scene.frame(0).shape
    (60, (600, 800, 3))
    """
    name, _, query = spec.partition("?")
    if name not in SCENES:
        raise ValueError(f"simulated sensor: unknown scene {name!r}{did_you_mean(name, sorted(SCENES))}")
    recipe = SCENES[name]
    return Scene(name, recipe.programme, parse_query(query, recipe.settings))


class Scene:
    """A simulated recording, frame by frame, in any order; the same spec gives the same bits.

    Attributes
    ----------
    name : of the scene. settings : all of its settings. size : (width, height), px. fps : frames a second.
    camera : where a point of the gel lands in the raw frame.
    layout : the markers as printed.
    """

    fps = FPS
    size = SIZE

    def __init__(self, name: str, programme: motion.Programme | None, settings: Settings) -> None:
        self.name = name
        self.settings = settings
        self.camera = optics.Camera(SIZE, settings.perspective, settings.distortion, settings.aperture)
        self.layout = markers.layout(
            *settings.markers,
            SIZE,
            pitch=settings.pitch,
            radius=settings.dot,
            jitter=settings.jitter,
            missing=settings.missing,
            worn=settings.worn,
            sizes=settings.sizes,
            seed=settings.seed,
        )
        self._programme = programme
        self._shapes = programme.build(settings.bend) if programme else ()
        self._light = light.LIGHTS[settings.light]
        self._delivered = optics.delivered_frames(
            settings.frames, settings.dropped, settings.repeated, settings.seed
        )
        self._moments = int(self._delivered[-1]) + 1
        if settings.stale:
            kept = max(range(min(len(self), 300)), key=self._depth)
            self._delivered = [kept] * settings.stale + list(self._delivered[settings.stale :])
        largest = self.layout.radius * (1.0 + settings.sizes)
        widened = 1.0 if self.camera.identity else 1.6 if settings.perspective else 1.2
        self._half = markers.half_patch(largest, settings.shape, widened)
        self._vanishing = np.random.default_rng([settings.seed, 0x7661]).random(len(self.layout.rest))

    def __len__(self) -> int:
        return self.settings.frames

    def __repr__(self) -> str:
        return f"<Scene {self.name}, {len(self)} frames>"

    def moment(self, index: int) -> int:
        """Which moment of the scene frame `index` shows; another where frames are dropped or repeated."""
        return int(self._delivered[self._checked(index)])

    def _depth(self, index: int) -> float:
        return max((press.depth for press in self.presses(index)), default=0.0)

    def presses(self, index: int) -> tuple[gel.Press, ...]:
        """The indenters at frame `index`."""
        return self._contact(self.moment(index))[0]

    def frame(self, index: int) -> NDArray[np.uint8]:
        """The raw frame `index`: (600, 800, 3) uint8 BGR, fresh."""
        moment = self.moment(index)
        settings = self.settings
        canvas = self._canvas(index, marked=True)
        gain = self._gain(moment)
        scale = gain / markers.FIXED_POINT
        noise = optics.sensor_noise(settings.seed, moment, canvas.shape)
        if settings.shot:
            noisy = np.asarray(canvas, np.float32) * np.float32(scale)
            spread = np.sqrt(settings.noise**2 + settings.shot**2 * np.maximum(noisy, 0) / np.float32(128.0))
            noisy += spread * (noise * np.float32(1.0 / optics.NOISE_UNIT))
            image = cv2.convertScaleAbs(np.maximum(noisy, 0, out=noisy))
        else:
            image = cv2.addWeighted(
                canvas, scale, noise, settings.noise / optics.NOISE_UNIT, 0.0, dtype=cv2.CV_8U
            )
        if settings.hot:
            x, y, value = self._hot_pixels
            image[y, x] = value
        if settings.jpeg:
            image = optics.compressed(np.asarray(image, np.uint8), settings.jpeg)
        return np.asarray(image, dtype=np.uint8)

    def clean(self, index: int) -> NDArray[np.uint8]:
        """The raw frame without markers, dirt, and noise: (600, 800, 3) uint8 BGR, fresh."""
        moment = self.moment(index)
        canvas = self._canvas(index, marked=False)
        scale = self._gain(moment) / markers.FIXED_POINT
        return np.asarray(cv2.addWeighted(canvas, scale, canvas, 0.0, 0.0, dtype=cv2.CV_8U), dtype=np.uint8)

    def truth(self, index: int, mapping: Any = None) -> Truth:
        """What frame `index` really shows.

        mapping : a `PixelMapping` or a `Preprocessor` of `tactflow.vision.geometry`; the truth is then given
            in the coordinates of the processed frame, with the contact evaluated at its pixels' centres, and
            a `Preprocessor` also makes `unmarked` exactly as it makes the frame. None: raw.
        """
        pressed, cycle = self._contact(self.moment(index))
        origin, position = self.markers(index)
        return measure(
            pressed,
            self.camera,
            origin,
            position,
            ~self._hidden(cycle),
            SIZE,
            mapping,
            partial(self.clean, index),
        )

    def markers(self, index: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Origin and position (N, 2) of the markers in frame `index`, raw pixels: a cheap part of `truth`."""
        rest = self.layout.rest
        now = rest + gel.displacement(self.presses(index), rest)
        return self.camera.to_raw(rest), self.camera.to_raw(now)

    def _hidden(self, cycle: int) -> NDArray[np.bool_]:
        """(N,): markers that cannot be seen during contact number `cycle` (-1: no contact)."""
        return (self._vanishing < self.settings.vanish) & (cycle >= 0)

    def _checked(self, index: int) -> int:
        if not 0 <= index < len(self):
            raise IndexError(f"required a frame in [0, {len(self) - 1}], got {index}")
        return index

    def _contact(self, moment: int) -> tuple[tuple[gel.Press, ...], int]:
        if self._programme is None:
            return (), -1
        settings = self.settings
        return motion.presses(
            self._programme,
            self._shapes,
            moment,
            self._moments,
            seed=settings.seed,
            size=SIZE,
            pitch=min(self.layout.pitch, _LARGEST_STROKE),
            depth=settings.depth,
            shear=settings.shear,
            twist=settings.twist,
            sink=settings.sink,
            rim=settings.rim,
        )

    @cached_property
    def _coarse(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Gel coordinates of the centres of blocks of `_STEP` x `_STEP` raw pixels."""
        mapped = self._gel_blocks(_STEP).astype(np.float32)
        return np.ascontiguousarray(mapped[..., 0]), np.ascontiguousarray(mapped[..., 1])

    def _gel_blocks(self, step: int) -> NDArray[np.float64]:
        """Gel coordinates (600 // step, 800 // step, 2) of the centres of blocks of so many raw pixels."""
        width, height = SIZE
        across = np.arange(width // step) * step + (step - 1) / 2.0
        down = np.arange(height // step) * step + (step - 1) / 2.0
        points = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)
        return self.camera.to_gel(points).reshape(height // step, width // step, 2)

    @cached_property
    def _resting(self) -> NDArray[np.int16]:
        """The untouched gel without markers, padded, in fixed point."""
        settings = self.settings
        width, height = SIZE
        raw_x, raw_y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
        center = ((width - 1) / 2.0, (height - 1) / 2.0)
        half_diagonal = float(np.hypot(width, height)) / 2.0
        dim = 0.65 if settings.polarity == "bright" else 1.0
        image = light.untouched_gel(self._light, raw_x, raw_y, center, half_diagonal, dim)
        if settings.texture:
            image *= light.texture((height, width), settings.texture, settings.seed)
        if settings.specular:
            rng = np.random.default_rng([settings.seed, 0x7370])
            for _ in range(4):
                x, y, spread = rng.uniform(0, width), rng.uniform(0, height), rng.uniform(5, 16)
                spot = np.exp(-((raw_x - x) ** 2 + (raw_y - y) ** 2) / np.float32(2 * spread**2))
                image += np.float32(110.0 * settings.specular) * spot[..., None]
        if settings.vignette:
            radius = ((raw_x - center[0]) ** 2 + (raw_y - center[1]) ** 2) / np.float32(half_diagonal**2)
            image *= (np.float32(1.0) - np.float32(settings.vignette) * radius)[..., None]
        if settings.perspective:
            image *= self._gel_window()
        if settings.leds:
            image += np.float32(255.0) * self._leds()[..., None]
        if settings.aperture:
            image *= self._framed[..., None]
        np.clip(image, 0, 500, out=image)
        fixed = np.rint(image * np.float32(markers.FIXED_POINT)).astype(np.int16)
        half = self._half
        return np.asarray(cv2.copyMakeBorder(fixed, half, half, half, half, cv2.BORDER_REPLICATE), np.int16)

    @cached_property
    def _framed(self) -> NDArray[np.float32]:
        """(H, W): the share of the light that the aperture lets through."""
        width, height = SIZE
        raw = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float64)
        return self.camera.aperture(raw).astype(np.float32)

    def _leds(self) -> NDArray[np.float32]:
        """(H, W), 1 in the middle of an LED; every other one at the lower border."""
        width, height = SIZE
        count = self.settings.leds
        total = np.zeros((height, width), np.float32)
        for number in range(count):
            y = height - 16.0 if number % 2 else 16.0
            total += light.spot(SIZE, ((number + 0.5) * width / count, y), (18.0, 13.0))
        return total

    def _gel_window(self) -> NDArray[np.float32]:
        """(H, W, 1): 1 on the gel, nearly dark around it, where a tilted camera sees past its border."""
        mapped = self._gel_blocks(1)
        width, height = SIZE
        inside = np.minimum.reduce(
            [
                mapped[..., 0] + 0.5,
                width - 0.5 - mapped[..., 0],
                mapped[..., 1] + 0.5,
                height - 0.5 - mapped[..., 1],
            ]
        )
        window = 0.06 + 0.94 / (1.0 + np.exp(-np.clip(inside, -40, 40) / 2.0))
        return np.asarray(window[..., None], dtype=np.float32)

    @cached_property
    def _resting_marked(self) -> NDArray[np.int16]:
        canvas = self._resting.copy()
        self._paint(canvas, self.layout.rest, np.ones(len(self.layout.rest)))
        return canvas

    @cached_property
    def _hot_pixels(self) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.uint8]]:
        rng = np.random.default_rng([self.settings.seed, 0x686F])
        count = self.settings.hot
        x, y = rng.integers(0, SIZE[0], count), rng.integers(0, SIZE[1], count)
        return x, y, rng.integers(200, 256, (count, 3)).astype(np.uint8)

    @cached_property
    def _dirt(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Specks on the gel: rest positions (N, 2), strengths (N,), deformations (N, 2, 2)."""
        rng = np.random.default_rng([self.settings.seed, 0x6469])
        count = round(self.settings.dirty * len(self.layout.rest))
        rest = rng.uniform((0, 0), SIZE, (count, 2))
        squeeze = rng.uniform(1.4, 3.2, (count, 2))
        angle = rng.uniform(0, np.pi, count)
        axes = np.stack(
            [np.stack([np.cos(angle), np.sin(angle)], -1), np.stack([-np.sin(angle), np.cos(angle)], -1)], 1
        )
        return rest, rng.uniform(0.2, 0.75, count), axes * squeeze[:, :, None]

    def _canvas(self, index: int, *, marked: bool) -> NDArray[np.int16]:
        """(600, 800, 3) int16 fixed-point image of a frame, before gain and noise; a view or fresh."""
        settings = self.settings
        moment = self.moment(index)
        pressed, cycle = self._contact(moment)
        if not pressed:
            padded = self._resting_marked if marked else self._resting
        else:
            padded = self._resting.copy()
            for press in pressed:
                self._shade(padded, press)
            if marked:
                rest = self.layout.rest
                shown = np.where(self._hidden(cycle), 0.0, 1.0)
                self._paint(padded, rest + gel.displacement(pressed, rest), shown, pressed)
        half = self._half
        canvas = padded[half:-half, half:-half]
        if settings.speckle:
            shade = self._speckle(pressed) if pressed else self._resting_speckle
            canvas = np.asarray(cv2.multiply(canvas, cv2.merge([shade] * 3), dtype=cv2.CV_16S), np.int16)
        if settings.stray:
            canvas = self._with_reflections(canvas, pressed)
        if settings.blur:
            canvas = np.asarray(cv2.GaussianBlur(canvas, (0, 0), settings.blur), dtype=np.int16)
        if settings.gain:
            rows = np.arange(SIZE[1], dtype=np.float32) / SIZE[1]
            wave = np.sin(2 * np.pi * (2.0 * rows - 0.37 * moment)).astype(np.float32)
            banded = canvas * (np.float32(1.0) + np.float32(settings.gain) * wave)[:, None, None]
            canvas = np.rint(banded, out=banded).astype(np.int16)
        if index < settings.settle:
            gains = np.append(light.settling(index, settings.settle), 1.0)
            canvas = np.asarray(cv2.multiply(canvas, gains, dtype=cv2.CV_16S), np.int16)
        if settings.lamp and moment >= _LAMP_AT * self._moments:
            canvas = np.asarray(cv2.multiply(canvas, self._lamp, dtype=cv2.CV_16S), np.int16)
        return canvas

    @cached_property
    def _lamp(self) -> NDArray[np.float32]:
        return light.lamp(SIZE, self.settings.lamp)

    @cached_property
    def _resting_speckle(self) -> NDArray[np.float32]:
        return self._speckle(())

    def _speckle(self, pressed: tuple[gel.Press, ...]) -> NDArray[np.float32]:
        """(H, W): the share of the light that the blotches let through."""
        blocks = self._gel_blocks(_SPECKLE_STEP).reshape(-1, 2)
        origin = blocks
        for _ in range(_INVERSIONS if pressed else 0):
            origin = blocks - gel.displacement(pressed, origin)
        width, height = SIZE
        moved = (blocks - origin).reshape(height // _SPECKLE_STEP, width // _SPECKLE_STEP, 2)
        place = self._gel_blocks(1) - cv2.resize(moved, SIZE, interpolation=cv2.INTER_LINEAR)
        pattern = light.blotches(SIZE, self.settings.speckle, self.settings.seed)
        x, y = place[..., 0].astype(np.float32), place[..., 1].astype(np.float32)
        shade = cv2.remap(pattern, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        return np.asarray(shade, dtype=np.float32)

    def _with_reflections(
        self, canvas: NDArray[np.int16], pressed: tuple[gel.Press, ...]
    ) -> NDArray[np.int16]:
        """Add what each contact throws on the gel: a bright streak opposite to it."""
        center = np.array(SIZE) / 2.0
        for press in pressed:
            away = center - self.camera.to_raw(np.array([press.x, press.y]))
            away /= max(float(np.hypot(*away)), 1.0)
            x, y = center + away * (320.0, 220.0)
            level = 90.0 * self.settings.stray * press.depth / press.shape.depth * markers.FIXED_POINT
            streak = np.float32(level) * light.spot(SIZE, (x, y), (16.0, 48.0))
            canvas = np.asarray(cv2.add(canvas, cv2.merge([streak] * 3), dtype=cv2.CV_16S), np.int16)
        return canvas

    def _paint(
        self,
        canvas: NDArray[np.int16],
        gel_points: NDArray[np.float64],
        shown: NDArray[np.float64],
        pressed: tuple[gel.Press, ...] = (),
    ) -> None:
        settings = self.settings
        if settings.dirty and len(self.layout.rest):
            rest, strength, deform = self._dirt
            at = rest + gel.displacement(pressed, rest)
            # One at a time: nothing keeps two specks apart.
            alone = np.arange(len(rest))
            draw_at = self.camera.to_raw(at)
            radius = np.full(len(rest), self.layout.radius)
            markers.draw(
                canvas,
                draw_at,
                strength,
                alone,
                radius=radius,
                shape="round",
                half=self._half,
                bright=None,
                deform=deform,
            )
        raw = self.camera.to_raw(gel_points)
        markers.draw(
            canvas,
            raw,
            self.layout.contrast * shown * self.camera.aperture(raw),
            self.layout.group,
            radius=self.layout.radius * self.layout.size,
            shape=settings.shape,
            bright=225.0 if settings.polarity == "bright" else None,
            half=self._half,
            deform=None if self.camera.identity else self.camera.local_inverse(gel_points),
        )

    def _shade(self, padded: NDArray[np.int16], press: gel.Press) -> None:
        """Change the light of a padded canvas where a contact deforms the gel, in place."""
        if press.depth <= 0:
            return
        window = self._window(press)
        if window is None:
            return
        top, bottom, left, right = window
        x, y = self._coarse
        depth = gel.reached(press, x[top:bottom, left:right], y[top:bottom, left:right])
        sunk = gel.surface(press, depth)
        relative = light.shading(self._light, sunk, _STEP)
        half = self._half
        region = padded[
            half + _STEP * top : half + _STEP * bottom, half + _STEP * left : half + _STEP * right
        ]
        full = (region.shape[1], region.shape[0])
        fine = cv2.resize(relative, full, interpolation=cv2.INTER_LINEAR)
        lit = cv2.multiply(region, fine, dtype=cv2.CV_32F)
        extra = None
        if self._light.brightening:
            extra = light.brightness(self._light, press, depth)
        if self.settings.specular:
            spots = light.highlight(sunk, _STEP, self.settings.specular)
            extra = spots if extra is None else extra + spots
        if extra is not None:
            wide = cv2.resize(extra, full, interpolation=cv2.INTER_LINEAR) * np.float32(markers.FIXED_POINT)
            if self.settings.aperture:
                wide *= self._framed[_STEP * top : _STEP * bottom, _STEP * left : _STEP * right]
            lit = cv2.add(lit, cv2.merge([wide, wide, wide]))
        np.clip(lit, 0, 32000, out=lit)
        region[...] = np.rint(lit, out=lit)

    def _window(self, press: gel.Press) -> tuple[int, int, int, int] | None:
        """Rows and columns of the coarse grid that a contact reaches, or None."""
        reach = press.shape.reach
        turn = np.linspace(0, 2 * np.pi, 33)
        ring = np.stack([press.x + reach * np.cos(turn), press.y + reach * np.sin(turn)], axis=1)
        if not self.camera.identity:
            ring = self.camera.to_raw(np.clip(ring, (-60.0, -60.0), (SIZE[0] + 60.0, SIZE[1] + 60.0)))
        low = np.floor(ring.min(axis=0) / _STEP).astype(int) - 2
        high = np.ceil(ring.max(axis=0) / _STEP).astype(int) + 3
        left, top = max(int(low[0]), 0), max(int(low[1]), 0)
        right, bottom = min(int(high[0]), SIZE[0] // _STEP), min(int(high[1]), SIZE[1] // _STEP)
        return None if right - left < 3 or bottom - top < 3 else (top, bottom, left, right)

    def _gain(self, moment: int) -> float:
        settings = self.settings
        seconds = moment / FPS
        warm = 1.0 + settings.drift * (1.0 - float(np.exp(-seconds / 5.0)))
        return warm * (1.0 + settings.flicker * float(np.sin(2 * np.pi * 100.0 * seconds)))
