"""How the gel is lit: the untouched gel, and how its light changes where the surface tilts.

Three coloured lights graze the gel from three sides, so that each colour channel answers to the slope of
the surface in one direction: photometric stereo as in GelSight (Yuan, Dong and Adelson, "GelSight:
High-Resolution Robot Tactile Sensors for Estimating Geometry and Force", Sensors 2017). With the elevation e
of a light and the horizontal direction t towards it, a Lambertian surface of height z and slope g = grad z
answers (1 - cot(e) g . t) / sqrt(1 + |g|^2), which is 1 at rest. Seen from inside, where the camera sits,
a pressed place is a hill.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.sim.gel import Press
from tactflow.sim.shapes import Array


@dataclass(frozen=True)
class Light:
    """A named sensor.

    azimuth : of the blue, green and red light, degrees, counter-clockwise as seen on the screen.
    level : grey level of the untouched gel at the centre, blue, green, red.
    falloff : how much brighter the gel is near a light than far from it, 0 for even light.
    slope_gain : cotangent of the lights' elevation, one for all or one each; more makes a tilted surface more
        colourful.
    ambient : share of the light that comes from everywhere, in [0, 1].
    brightening : grey levels by which all channels rise in a contact of full depth; negative: fall.
    onset : depth beyond the contact's edge over which they do, as a share of the full depth.
    halo : grey levels by which the gel is brighter just outside a contact of full depth.
    """

    azimuth: tuple[float, float, float]
    level: tuple[float, float, float]
    falloff: float
    slope_gain: float | tuple[float, float, float]
    ambient: float
    brightening: float
    onset: float = 0.05
    halo: float = 0.0

    def tilt(self) -> NDArray[np.float32]:
        """(3, 2) float32: change of a channel's relative light per unit slope in x and y."""
        angle = np.radians(np.asarray(self.azimuth))
        toward = np.stack([np.cos(angle), -np.sin(angle)], axis=1)
        return np.asarray(-toward * np.reshape(self.slope_gain, (-1, 1)), dtype=np.float32)


LIGHTS = {
    # Three coloured lights; a contact answers with colour.
    "photometric": Light((325.0, 80.0, 205.0), (122.0, 136.0, 118.0), 0.4, 1.9, 0.25, 0.0),
    # White light; a contact brightens in all channels.
    "bright": Light((325.0, 80.0, 205.0), (98.0, 104.0, 100.0), 0.12, 0.10, 0.5, 58.0),
    # Coloured lights, and a contact brightens too.
    "mixed": Light((325.0, 80.0, 205.0), (106.0, 114.0, 104.0), 0.35, 0.7, 0.35, 46.0),
    # Three coloured lights; the red one grazes the gel, which is nearly dark in it until it is touched.
    "dark_channel": Light((325.0, 80.0, 205.0), (115.0, 132.0, 12.0), 0.4, (0.5, 1.9, 9.0), 0.25, 0.0),
    # White light through a black coating; a contact darkens, with a bright halo around it.
    "darkening": Light((325.0, 80.0, 205.0), (150.0, 152.0, 154.0), 0.12, 0.10, 0.5, -75.0, 0.2, 26.0),
}  # fmt: skip


def untouched_gel(
    light: Light,
    x: Array,
    y: Array,
    center: tuple[float, float],
    half_diagonal: float,
    dim: float = 1.0,
) -> NDArray[np.float32]:
    """(H, W, 3) float32 grey levels, BGR, of the gel at rest, at gel coordinates x, y (H, W), px."""
    angle = np.radians(np.asarray(light.azimuth))
    image = np.empty((*x.shape, 3), np.float32)
    for channel in range(3):
        along = (x - center[0]) * np.cos(angle[channel]) - (y - center[1]) * np.sin(angle[channel])
        distance = (1.8 - along / half_diagonal) / 1.8
        image[..., channel] = light.level[channel] * dim * distance ** (-light.falloff * 1.4)
    return image


def texture(shape: tuple[int, int], strength: float, seed: int) -> NDArray[np.float32]:
    """(H, W, 1) float32: the grain of the gel's coating, relative, standard deviation `strength` / 100."""
    return _grain(shape, seed) * np.float32(strength / 100.0) + np.float32(1.0)


@lru_cache(maxsize=2)
def _grain(shape: tuple[int, int], seed: int) -> NDArray[np.float32]:
    draw = np.random.default_rng([seed, 0x7465]).standard_normal(shape, dtype=np.float32)
    grain = np.asarray(cv2.GaussianBlur(draw, (0, 0), 1.6), dtype=np.float32)
    grain += 2.0 * np.asarray(cv2.GaussianBlur(draw, (0, 0), 9.0), dtype=np.float32)
    grain /= float(grain.std())
    grain.setflags(write=False)
    return grain[..., None]


def shading(light: Light, depth: Array, step: float) -> NDArray[np.float32]:
    """(h, w, 3) float32: light of a deformed surface relative to the surface at rest, >= 0.

    depth : (h, w) float32, how far the surface has sunk, px, sampled every `step` px.
    """
    slope_x = cv2.Sobel(depth, cv2.CV_32F, 1, 0, ksize=1, scale=0.5 / step, borderType=cv2.BORDER_REPLICATE)
    slope_y = cv2.Sobel(depth, cv2.CV_32F, 0, 1, ksize=1, scale=0.5 / step, borderType=cv2.BORDER_REPLICATE)
    upright = (1.0 - light.ambient) / np.sqrt(slope_x * slope_x + slope_y * slope_y + np.float32(1.0))
    channels = []
    for gain_x, gain_y in light.tilt():
        lit = slope_x * gain_x + slope_y * gain_y + np.float32(1.0)
        np.maximum(lit, 0, out=lit)
        lit *= upright
        lit += np.float32(light.ambient)
        channels.append(lit)
    return np.asarray(cv2.merge(channels), dtype=np.float32)


def brightness(light: Light, press: Press, depth: Array) -> Array:
    """Grey levels (h, w) that a contact adds to all channels; `depth` (h, w) px, as `reached` gives it."""
    share = press.depth / press.shape.depth
    grown, set_in = 0.45 + 0.55 * share, min(1.0, share / 0.1)
    beyond = (depth - np.float32(press.sink * press.depth)) * np.float32(
        1.0 / (light.onset * press.shape.depth)
    )
    inside = np.tanh(beyond * np.float32(0.5))
    added = np.float32(0.5 * (light.brightening * grown * set_in)) * (np.float32(1.0) + inside)
    if light.halo:
        fading = np.exp(np.minimum(beyond, 0) * np.float32(0.15))
        added += np.float32(0.5 * light.halo * grown * set_in) * (np.float32(1.0) - inside) * fading
    return np.asarray(added, np.float32)


def settling(moment: int, frames: int) -> NDArray[np.float64]:
    """(3,) gains, BGR, of a camera that begins too bright and too blue and is right after so many frames.

    The way is that of a control loop: fast at first, without a step at its end. In the first frame the
    brighter parts of the gel are clipped.
    """
    left = max(1.0 - moment / frames, 0.0) ** 2 if frames else 0.0
    return np.asarray(1.0 + left * np.array([0.9, 0.7, 0.5]))


def lamp(size: tuple[int, int], strength: float) -> NDArray[np.float32]:
    """(H, W, 3) float32: the gel's light after a lamp was switched on at its right, relative to before.

    size : (width, height) px. strength : of the lamp in the middle, relative.
    """
    side = np.linspace(0.65, 1.35, size[0], dtype=np.float32) * np.float32(strength)
    row = 1.0 + side[:, None] * np.array([0.8, 1.0, 1.2], np.float32)
    return np.ascontiguousarray(np.broadcast_to(row, (size[1], size[0], 3)), dtype=np.float32)


def add_mirror_spots(image: NDArray[np.float32], x: Array, y: Array, strength: float, seed: int) -> None:
    """Add mirror images of lamps to the untouched gel (H, W, 3), grey levels; x, y : (H, W) coordinates."""
    rng = np.random.default_rng([seed, 0x7370])
    height, width = x.shape
    for _ in range(4):
        center_x, center_y, spread = rng.uniform(0, width), rng.uniform(0, height), rng.uniform(5, 16)
        spot = np.exp(-((x - center_x) ** 2 + (y - center_y) ** 2) / np.float32(2 * spread**2))
        image += np.float32(110.0 * strength) * spot[..., None]


@lru_cache(maxsize=2)
def blotches(size: tuple[int, int], contrast: float, seed: int) -> Array:
    """(H, W) float32: the light that a random pattern of blotches some 15 px wide lets through."""
    draw = np.random.default_rng([seed, 0x626C]).standard_normal((size[1], size[0]), dtype=np.float32)
    smooth = np.asarray(cv2.GaussianBlur(draw, (0, 0), 5.0), dtype=np.float32)
    pattern = 0.5 + 0.5 * np.tanh(2.0 * smooth / float(smooth.std()))
    shade = np.asarray(1.0 - contrast * pattern, dtype=np.float32)
    shade.setflags(write=False)
    return shade


def highlight(depth: Array, step: float, strength: float) -> Array:
    """(h, w) float32 grey levels: the mirror image of a lamp on the slope that faces it."""
    slope_x = cv2.Sobel(depth, cv2.CV_32F, 1, 0, ksize=1, scale=0.5 / step, borderType=cv2.BORDER_REPLICATE)
    slope_y = cv2.Sobel(depth, cv2.CV_32F, 0, 1, ksize=1, scale=0.5 / step, borderType=cv2.BORDER_REPLICATE)
    off = (slope_x - np.float32(0.13)) ** 2 + (slope_y - np.float32(0.16)) ** 2
    return np.asarray(
        np.exp(off * np.float32(-1.0 / (2 * 0.035**2))) * np.float32(150.0 * strength), np.float32
    )
