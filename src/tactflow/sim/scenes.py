"""The named scenes of the simulated sensor: images on one side, the truth about them on the other."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.sim import camera as optics
from tactflow.sim import gel, light, markers, motion, shapes
from tactflow.sim.settings import Settings, parse_query, suggestion
from tactflow.sim.truth import Truth, measure

SIZE = (800, 600)
"""Width and height of every scene's frames, px."""
FPS = 60.0
"""Frames a second of every scene."""
_STEP = 2
"""The gel's surface is computed at every second pixel of the raw frame; the light on it is smooth. Chosen
by hand."""


_LARGEST_STROKE = 110.0
"""Contacts move the gel in proportion to the markers' pitch, up to this pitch, px. Chosen by hand."""


@dataclass(frozen=True)
class _Recipe:
    description: str
    programme: motion.Programme | None
    settings: Mapping[str, Any] = field(default_factory=dict[str, Any])


def _sphere(_bend: float) -> tuple[shapes.Shape, ...]:
    return (shapes.sphere(),)


def _cable(bend: float) -> tuple[shapes.Shape, ...]:
    return (shapes.cable(bend=bend),)


def _one(make: Any, **sizes: Any) -> Any:
    return partial(_made, make, tuple(sizes.items()))


def _made(make: Any, sizes: tuple[tuple[str, Any], ...], _bend: float) -> tuple[shapes.Shape, ...]:
    return (make(**dict(sizes)),)


def _pair(_bend: float) -> tuple[shapes.Shape, ...]:
    return (shapes.sphere(radius=70.0, depth=22.0), shapes.box(half_width=48.0, half_height=36.0, depth=11.0))


_PRESS = motion.Programme(_sphere)
_CABLE = motion.Programme(_cable, wander=(60.0, 60.0), angles=(-75.0, 75.0), dilation=0.25)
"""Programmes that several scenes share; lengths in px of the raw frame, angles in degrees."""
_SCENES: dict[str, _Recipe] = {
    "press": _Recipe("a ball is pressed in several places, at several depths", _PRESS),
    "cable": _Recipe("a straight cable is pressed at several angles", _CABLE),
    "bent_cable": _Recipe("a cable that bends by 70 degrees", _CABLE, {"bend": 70.0}),
    "slide": _Recipe(
        "a ball drags the gel along until it slips, and slides over it",
        motion.Programme(
            _sphere, wander=(210.0, 130.0), travel=260.0, hold=50, period=90, depths=(1.0, 0.6, 0.85)
        ),
        {"shear": 0.9},
    ),
    "roll": _Recipe(
        "a ball rolls over the gel without dragging it",
        motion.Programme(
            _sphere, wander=(210.0, 130.0), travel=320.0, hold=60, period=100, depths=(1.0, 0.7)
        ),
        {"shear": 0.0},
    ),
    "idle": _Recipe("nothing touches the gel", None),
    "twist": _Recipe(
        "a flat punch is pressed and turned by 20 degrees to either side",
        motion.Programme(
            _one(shapes.box), wander=(120.0, 80.0), angles=(-40.0, 40.0), hold=50, period=90,
            depths=(1.0, 0.6, 0.8), dilation=0.12,
        ),
        {"twist": 20.0, "shear": 0.0},
    ),
    "edge": _Recipe(
        "a knife edge at several angles",
        motion.Programme(_one(shapes.edge), wander=(120.0, 90.0), angles=(-90.0, 90.0), dilation=0.2),
    ),
    "box": _Recipe(
        "a flat rectangular punch at several angles",
        motion.Programme(_one(shapes.box), wander=(170.0, 110.0), angles=(-90.0, 90.0), dilation=0.15),
    ),
    "ring": _Recipe(
        "a ring: a contact with a hole, and without a direction",
        motion.Programme(_one(shapes.ring), wander=(150.0, 90.0), dilation=0.15),
    ),
    "text": _Recipe(
        "raised letters",
        motion.Programme(_one(shapes.text), wander=(60.0, 110.0), angles=(-20.0, 20.0), dilation=0.1),
    ),
    "screw": _Recipe(
        "a threaded rod: a contact in many pieces",
        motion.Programme(_one(shapes.screw), wander=(120.0, 90.0), angles=(-90.0, 90.0), dilation=0.25),
    ),
    "two": _Recipe(
        "a ball and a small flat punch at once",
        motion.Programme(_pair, offsets=((-150.0, -40.0), (150.0, 50.0)), wander=(90.0, 90.0), dilation=0.2),
    ),
    "border": _Recipe(
        "a contact that the border of the frame cuts",
        motion.Programme(_sphere, place=(0.965, 0.5), wander=(25.0, 180.0)),
    ),
    "tap": _Recipe(
        "contacts of a single frame",
        motion.Programme(_sphere, period=30, rise=0, hold=1, depths=(1.0, 0.6)),
    ),
    "spike": _Recipe(
        "contacts that come and go within five frames", motion.Programme(_sphere, period=24, rise=1, hold=3)
    ),
    "creep": _Recipe(
        "one long contact that drags the gel by 0.02 px a frame",
        motion.Programme(_sphere, single=True, period=300, rise=15, hold=225, depths=(0.9,), creep=0.02),
    ),
    "hold": _Recipe(
        "one long contact that does not move",
        motion.Programme(_sphere, single=True, period=300, rise=15, hold=225, depths=(0.9,)),
        {"shear": 0.0},
    ),
    "drift": _Recipe("presses while the lights warm up", _PRESS, {"drift": 0.18}),
    "flicker": _Recipe("presses under flickering light", _PRESS, {"flicker": 0.06, "gain": 0.03}),
    "jumps": _Recipe(
        "a contact that drags the markers by up to 0.9 pitch between two frames",
        motion.Programme(
            _one(shapes.box), wander=(120.0, 80.0), jumps=True, hold=36, period=72, dilation=0.1
        ),
    ),
    "worn": _Recipe(
        "faded, missing and vanishing markers, and dirt",
        _PRESS,
        {"worn": 0.3, "missing": 0.08, "dirty": 0.3, "vanish": 0.15, "shear": 0.4},
    ),
    "dense": _Recipe("520 small markers", _PRESS, {"markers": (26, 20), "shear": 0.6}),
    "sparse": _Recipe("25 markers", _PRESS, {"markers": (5, 5), "dot": 12.0}),
    "bright_dots": _Recipe("bright markers on a darker gel", _PRESS, {"polarity": "bright"}),
    "square_dots": _Recipe("square markers", _PRESS, {"shape": "square"}),
    "doubled_dots": _Recipe("each marker is a pair of dots", _PRESS, {"shape": "doubled"}),
    "irregular": _Recipe("markers in no regular grid", _PRESS, {"jitter": 0.14}),
    "unmarked": _Recipe("a gel without markers", _PRESS, {"markers": (0, 0)}),
    "bright": _Recipe("a gel whose pressed area brightens in all channels", _PRESS, {"light": "bright"}),
    "bright_cable": _Recipe("a cable on a gel that brightens", _CABLE, {"light": "bright"}),
    "mixed": _Recipe("a gel that answers with colour and brightness", _PRESS, {"light": "mixed"}),
    "glossy": _Recipe("a gel with mirror-like highlights", _PRESS, {"specular": 0.8}),
    "tilted": _Recipe("a tilted camera with a wide lens", _PRESS, {"perspective": 0.22, "distortion": 0.12}),
    "noisy": _Recipe(
        "a poor camera: noise, shot noise, hot pixels, JPEG, blur",
        _PRESS,
        {"noise": 6.0, "shot": 3.0, "hot": 40, "jpeg": 70, "blur": 1.0},
    ),
    "soft_rim": _Recipe(
        "a deep gel, whose surface shows no crease at the edge of a contact",
        _PRESS,
        {"sink": 0.5, "rim": 1.0},
    ),
    "stutter": _Recipe("a camera that drops and repeats frames", _PRESS, {"dropped": 0.1, "repeated": 0.1}),
    "strong_shear": _Recipe(
        "a ball that moves markers by up to 1.5 pitches",
        motion.Programme(
            _sphere, wander=(120.0, 80.0), hold=50, period=90, depths=(1.0, 0.8), dilation=0.2
        ),
        {"shear": 1.3},
    ),
}  # fmt: skip


def scene_descriptions() -> dict[str, str]:
    """Scene -> what it shows, in one line."""
    return {name: recipe.description for name, recipe in _SCENES.items()}


def scene_names() -> tuple[str, ...]:
    """The names that `open_scene` knows."""
    return tuple(_SCENES)


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
    if name not in _SCENES:
        raise ValueError(f"simulated sensor: unknown scene {name!r}{suggestion(name, _SCENES)}")
    recipe = _SCENES[name]
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
        self.camera = optics.Camera(SIZE, settings.perspective, settings.distortion)
        self.layout = markers.layout(
            *settings.markers,
            SIZE,
            pitch=settings.pitch,
            radius=settings.dot,
            jitter=settings.jitter,
            missing=settings.missing,
            worn=settings.worn,
            seed=settings.seed,
        )
        self._programme = programme
        self._shapes = programme.build(settings.bend) if programme else ()
        self._light = light.LIGHTS[settings.light]
        self._delivered = optics.delivered_frames(
            settings.frames, settings.dropped, settings.repeated, settings.seed
        )
        self._half = markers.half_patch(
            self.layout.radius, settings.shape, 1.6 if settings.perspective else 1.2
        )
        if self.camera.identity:
            self._half = markers.half_patch(self.layout.radius, settings.shape)
        self._vanishing = np.random.default_rng([settings.seed, 0x7661]).random(len(self.layout.rest))

    def __len__(self) -> int:
        return self.settings.frames

    def __repr__(self) -> str:
        return f"<Scene {self.name}, {len(self)} frames>"

    def moment(self, index: int) -> int:
        """Which moment of the scene frame `index` shows; another where frames are dropped or repeated."""
        return int(self._delivered[self._checked(index)])

    def presses(self, index: int) -> tuple[gel.Press, ...]:
        """The indenters at frame `index`."""
        return self._contact(self.moment(index))[0]

    def frame(self, index: int) -> NDArray[np.uint8]:
        """The raw frame `index`: (600, 800, 3) uint8 BGR, fresh."""
        moment = self.moment(index)
        settings = self.settings
        canvas = self._canvas(moment, marked=True)
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
        canvas = self._canvas(moment, marked=False)
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
            int(self._delivered[-1]) + 1,
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
        width, height = SIZE
        across = np.arange(width // _STEP) * _STEP + (_STEP - 1) / 2.0
        down = np.arange(height // _STEP) * _STEP + (_STEP - 1) / 2.0
        points = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)
        mapped = self.camera.to_gel(points).astype(np.float32).reshape(height // _STEP, width // _STEP, 2)
        return np.ascontiguousarray(mapped[..., 0]), np.ascontiguousarray(mapped[..., 1])

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
            image *= self._gel_window(raw_x, raw_y)
        np.clip(image, 0, 500, out=image)
        fixed = np.rint(image * np.float32(markers.FIXED_POINT)).astype(np.int16)
        half = self._half
        return np.asarray(cv2.copyMakeBorder(fixed, half, half, half, half, cv2.BORDER_REPLICATE), np.int16)

    def _gel_window(self, raw_x: NDArray[np.float32], raw_y: NDArray[np.float32]) -> NDArray[np.float32]:
        """(H, W, 1): 1 on the gel, nearly dark around it, where a tilted camera sees past its border."""
        points = np.stack([raw_x, raw_y], axis=-1).reshape(-1, 2).astype(np.float64)
        mapped = self.camera.to_gel(points).reshape(*raw_x.shape, 2)
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

    def _canvas(self, moment: int, *, marked: bool) -> NDArray[np.int16]:
        """(600, 800, 3) int16 fixed-point image of a moment, before gain and noise; a view or fresh."""
        settings = self.settings
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
        if settings.blur:
            canvas = np.asarray(cv2.GaussianBlur(canvas, (0, 0), settings.blur), dtype=np.int16)
        if settings.gain:
            rows = np.arange(SIZE[1], dtype=np.float32) / SIZE[1]
            wave = np.sin(2 * np.pi * (2.0 * rows - 0.37 * moment)).astype(np.float32)
            banded = canvas * (np.float32(1.0) + np.float32(settings.gain) * wave)[:, None, None]
            canvas = np.rint(banded, out=banded).astype(np.int16)
        return canvas

    def _paint(
        self,
        canvas: NDArray[np.int16],
        gel_points: NDArray[np.float64],
        shown: NDArray[np.float64],
        pressed: tuple[gel.Press, ...] = (),
    ) -> None:
        settings = self.settings
        common: dict[str, Any] = {
            "radius": self.layout.radius,
            "half": self._half,
        }
        if settings.dirty and len(self.layout.rest):
            rest, strength, deform = self._dirt
            at = rest + gel.displacement(pressed, rest)
            # One at a time: nothing keeps two specks apart.
            alone = np.arange(len(rest))
            draw_at = self.camera.to_raw(at)
            markers.draw(
                canvas, draw_at, strength, alone, shape="round", bright=None, deform=deform, **common
            )
        markers.draw(
            canvas,
            self.camera.to_raw(gel_points),
            self.layout.contrast * shown,
            self.layout.group,
            shape=settings.shape,
            bright=225.0 if settings.polarity == "bright" else None,
            deform=None if self.camera.identity else self.camera.local_inverse(gel_points),
            **common,
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
            share = press.depth / press.shape.depth
            amount = self._light.brightening * (0.45 + 0.55 * share) * min(1.0, share / 0.1)
            edge = (depth - np.float32(press.sink * press.depth)) * np.float32(
                1.0 / (0.05 * press.shape.depth)
            )
            extra = np.float32(0.5 * amount) * (np.float32(1.0) + np.tanh(edge * np.float32(0.5)))
        if self.settings.specular:
            spots = light.highlight(sunk, _STEP, self.settings.specular)
            extra = spots if extra is None else extra + spots
        if extra is not None:
            wide = cv2.resize(extra, full, interpolation=cv2.INTER_LINEAR) * np.float32(markers.FIXED_POINT)
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
