"""Illumination: the untouched gel, and shading of its deformed surface.

Three coloured lights at grazing angles make each colour channel respond to the slope of the surface in one
direction: photometric stereo as in GelSight (Yuan, Dong and Adelson, "GelSight: High-Resolution Robot Tactile
Sensors for Estimating Geometry and Force", Sensors 2017). With the elevation e of a light and the horizontal
direction t towards it, the shading of a Lambertian surface with slope g = grad z is (1 - cot(e) g . t) /
sqrt(1 + |g|^2), which is 1 at rest. Seen from the camera inside, an indentation is a hill.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.sim.camera import CENTER, HALF_DIAGONAL
from tactflow.sim.gel import Press
from tactflow.vision.arrays import Floats32


@dataclass(frozen=True)
class Light:
    """The illumination of a type of sensor.

    Attributes
    ----------
    azimuth : of the blue, green and red light, degrees, counter-clockwise on the screen.
    level : grey level of the untouched gel at the centre, blue, green, red.
    falloff : decrease of brightness with the distance from a light, 0 for uniform light.
    slope_gain : cotangent of the lights' elevation, common or per light.
    ambient : fraction of diffuse light, 0 to 1.
    brightening : change of all channels in a contact of full depth, grey levels.
    onset : depth range of this change beyond the contact's edge, relative to full depth.
    halo : brightening just outside a contact of full depth, grey levels.
    absorption : part of the light per raw px of depth, for gels that darken with it.
    """

    azimuth: tuple[float, float, float]
    level: tuple[float, float, float]
    falloff: float
    slope_gain: float | tuple[float, float, float]
    ambient: float
    brightening: float
    onset: float = 0.05
    halo: float = 0.0
    absorption: float = 0.0

    def tilt(self) -> NDArray[np.float32]:
        """(3, 2) float32: relative change of each channel per unit slope in x and y."""
        angle = np.radians(np.asarray(self.azimuth))
        toward = np.stack([np.cos(angle), -np.sin(angle)], axis=1)
        return np.asarray(-toward * np.reshape(self.slope_gain, (-1, 1)), dtype=np.float32)


LIGHTS = {
    # Three coloured lights; a contact changes the colour.
    "photometric": Light((325.0, 80.0, 205.0), (122.0, 136.0, 118.0), 0.4, 1.9, 0.25, 0.0),
    # White light; a contact brightens all channels.
    "bright": Light((325.0, 80.0, 205.0), (98.0, 104.0, 100.0), 0.12, 0.10, 0.5, 58.0),
    # Coloured lights; a contact changes colour and brightness.
    "mixed": Light((325.0, 80.0, 205.0), (106.0, 114.0, 104.0), 0.35, 0.7, 0.35, 46.0),
    # Three coloured lights; the red one grazes the gel, which is nearly dark in it until it is touched.
    "dark_channel": Light((325.0, 80.0, 205.0), (115.0, 132.0, 12.0), 0.4, (0.5, 1.9, 9.0), 0.25, 0.0),
    # White light through a black coating; a contact darkens, with a bright halo around it.
    "darkening": Light((325.0, 80.0, 205.0), (150.0, 152.0, 154.0), 0.12, 0.10, 0.5, -75.0, 0.2, 26.0),
    # White light that a dark layer below a translucent one absorbs, the more the thinner the latter.
    "absorbing": Light((325.0, 80.0, 205.0), (150.0, 152.0, 154.0), 0.12, 0.0, 0.5, 0.0, absorption=0.02),
}  # fmt: skip


def untouched_gel(light: Light, x: Floats32, y: Floats32, dim: float = 1.0) -> NDArray[np.float32]:
    """Grey levels (H, W, 3) float32, BGR, of the gel at rest, at gel coordinates x, y (H, W), px."""
    angle = np.radians(np.asarray(light.azimuth))
    image = np.empty((*x.shape, 3), np.float32)
    for channel in range(3):
        along = (x - CENTER[0]) * np.cos(angle[channel]) - (y - CENTER[1]) * np.sin(angle[channel])
        distance = (1.8 - along / HALF_DIAGONAL) / 1.8
        image[..., channel] = light.level[channel] * dim * distance ** (-light.falloff * 1.4)
    return image


def texture(shape: tuple[int, int], strength: float, seed: int) -> NDArray[np.float32]:
    """(H, W, 1) float32: factor for the grain of the coating, with standard deviation `strength` / 100."""
    return _grain(shape, seed) * np.float32(strength / 100.0) + np.float32(1.0)


@lru_cache(maxsize=2)
def _grain(shape: tuple[int, int], seed: int) -> NDArray[np.float32]:
    draw = np.random.default_rng([seed, 0x7465]).standard_normal(shape, dtype=np.float32)
    grain = np.asarray(cv2.GaussianBlur(draw, (0, 0), 1.6), dtype=np.float32)
    grain += 2.0 * np.asarray(cv2.GaussianBlur(draw, (0, 0), 9.0), dtype=np.float32)
    grain /= float(grain.std())
    grain.setflags(write=False)
    return grain[..., None]


def shading(light: Light, depth: Floats32, step: float) -> NDArray[np.float32]:
    """(h, w, 3) float32: shading of a deformed surface relative to rest, >= 0.

    depth : (h, w) float32, depth of the surface, px, sampled every `step` px.
    """
    if light.absorption:
        passing = np.exp(depth * np.float32(-light.absorption))
        return np.asarray(cv2.merge([passing, passing, passing]), dtype=np.float32)
    slope_x, slope_y = (
        cv2.Sobel(depth, cv2.CV_32F, dx, 1 - dx, ksize=1, scale=0.5 / step, borderType=cv2.BORDER_REPLICATE)
        for dx in (1, 0)
    )
    upright = (1.0 - light.ambient) / np.sqrt(slope_x * slope_x + slope_y * slope_y + np.float32(1.0))
    channels = []
    for gain_x, gain_y in light.tilt():
        lit = slope_x * gain_x + slope_y * gain_y + np.float32(1.0)
        np.maximum(lit, 0, out=lit)
        lit *= upright
        lit += np.float32(light.ambient)
        channels.append(lit)
    return np.asarray(cv2.merge(channels), dtype=np.float32)


def brightness(light: Light, press: Press, depth: Floats32) -> Floats32:
    """Grey levels (h, w) that a contact adds to all channels. depth : (h, w), px, from `reached`."""
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


def lamp(size: tuple[int, int], strength: float) -> NDArray[np.float32]:
    """(H, W, 3) float32: factor on the light after a lamp on the right is switched on.

    size : (width, height), px. strength : relative light of the lamp at the centre.
    """
    side = np.linspace(0.65, 1.35, size[0], dtype=np.float32) * np.float32(strength)
    row = 1.0 + side[:, None] * np.array([0.8, 1.0, 1.2], np.float32)
    return np.ascontiguousarray(np.broadcast_to(row, (size[1], size[0], 3)), dtype=np.float32)


def spot(size: tuple[int, int], center: tuple[float, float], spread: tuple[float, float]) -> Floats32:
    """(H, W) float32: a Gaussian, 1 at `center` (x, y), with standard deviations `spread` (x, y), px."""
    across, down = (
        np.exp(-0.5 * ((np.arange(length) - middle) / deviation) ** 2).astype(np.float32)
        for length, middle, deviation in zip(size, center, spread, strict=True)
    )
    return np.outer(down, across)
