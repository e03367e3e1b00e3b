"""The simulated camera: projection of the gel to the raw frame, noise and compression.

The gel plane and the raw frame share one unit (raw pixels); without perspective and distortion they coincide.
Everything is closed-form or solved to machine precision, so that the truth can be mapped, too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.arrays import Points
from tactflow.vision.geometry.mapping import find_homography, project

SIZE = (800, 600)
"""Width and height of every scene's frames, px."""
FPS = 60.0
"""Frames per second of every scene."""
CENTER = ((SIZE[0] - 1) / 2.0, (SIZE[1] - 1) / 2.0)
HALF_DIAGONAL = math.hypot(*SIZE) / 2.0
"""Centre of a frame, (x, y), and distance of its corners from it, px."""
NOISE_UNIT = 4096.0
"""Integer steps of the noise bank per standard deviation."""
_APERTURE_EDGE_PX = 3.0
"""Width of the blurred edge of the aperture, px. Chosen by hand."""
_NEWTON_STEPS = 12
"""Newton steps to invert the distortion, enough for machine precision."""
_BANK_SPAN, _BANK_STEP = 1 << 22, 2592173
"""Number of offsets into the noise bank, and the step between consecutive frames. An odd step near span /
golden ratio visits all offsets before repeating, and keeps any two of the first n at least span / (2.7 n)
apart."""


@dataclass(frozen=True)
class Camera:
    """Perspective followed by radial lens distortion, seen through a round aperture.

    Attributes
    ----------
    perspective : 0 to 0.4; fraction of half the width by which the lower corners of the gel move inwards,
        so that it appears as the trapezoid of a tilted camera; the whole gel shrinks a little.
    distortion : -0.2 to 0.4; k of undistorted = distorted * (1 + k rho^2), rho = distance from the centre
        in half diagonals; positive is a barrel (wide lens).
    aperture_radius : radius of the round picture in a black frame, in half heights of the frame. 0: none,
        each.
    """

    perspective: float = 0.0
    distortion: float = 0.0
    aperture_radius: float = 0.0

    @property
    def identity(self) -> bool:
        """Whether the raw frame is the gel plane."""
        return self.perspective == 0.0 and self.distortion == 0.0

    @cached_property
    def _homography(self) -> NDArray[np.float64]:
        """From the gel plane to the undistorted frame, 3 x 3."""
        if not self.perspective:
            return np.eye(3)
        width, height = SIZE
        left, top, right, bottom = -0.5, -0.5, width - 0.5, height - 0.5
        inset_x, inset_y = 0.1 * self.perspective * width, 0.15 * self.perspective * height
        squeeze = self.perspective * width / 2.0
        gel = [[left, top], [right, top], [left, bottom], [right, bottom]]
        raw = [
            [left + inset_x, top + inset_y],
            [right - inset_x, top + inset_y],
            [left + inset_x + squeeze, bottom - inset_y],
            [right - inset_x - squeeze, bottom - inset_y],
        ]
        return find_homography(gel, raw)

    @cached_property
    def _inverse(self) -> NDArray[np.float64]:
        return np.linalg.inv(self._homography).astype(np.float64)

    def to_gel(self, raw: Points) -> Points:
        """Gel coordinates (N, 2) float64 of raw pixel positions (N, 2)."""
        if self.identity:
            return np.array(raw, dtype=np.float64)
        offset = (raw - CENTER) / HALF_DIAGONAL
        offset *= 1.0 + self.distortion * np.sum(offset * offset, axis=-1, keepdims=True)
        return project(self._inverse, offset * HALF_DIAGONAL + CENTER)

    def to_raw(self, gel: Points) -> Points:
        """Raw pixel positions (N, 2) float64 of gel coordinates (N, 2)."""
        if self.identity:
            return np.array(gel, dtype=np.float64)
        offset = (project(self._homography, gel) - CENTER) / HALF_DIAGONAL
        k = self.distortion
        if k:
            radius = np.sqrt(np.sum(offset * offset, axis=-1))
            solved = radius.copy()
            for _ in range(_NEWTON_STEPS):
                solved -= (solved * (1.0 + k * solved**2) - radius) / (1.0 + 3.0 * k * solved**2)
            offset *= np.divide(solved, radius, out=np.ones_like(radius), where=radius > 0)[..., None]
        return np.asarray(offset * HALF_DIAGONAL + CENTER, dtype=np.float64)

    def aperture(self, raw: Points) -> NDArray[np.float64]:
        """Fraction of light (N,), 0 to 1, at raw pixel positions (N, 2): 0 in the black frame."""
        radius = self.aperture_radius * SIZE[1] / 2.0 if self.aperture_radius else np.inf
        inside = radius - np.hypot(raw[..., 0] - CENTER[0], raw[..., 1] - CENTER[1])
        return np.asarray(0.5 + 0.5 * np.tanh(inside / _APERTURE_EDGE_PX), dtype=np.float64)

    def sees(self, raw: Points) -> NDArray[np.bool_]:
        """(...) bool: whether raw positions (..., 2) lie in the frame and are lit."""
        inside = np.all((raw >= -0.5) & (raw <= np.array(SIZE) - 0.5), axis=-1)
        return np.asarray(inside & (self.aperture(raw) >= 0.5))

    def local_inverse(self, gel: Points) -> NDArray[np.float64]:
        """(N, 2, 2) derivative d gel / d raw at gel points (N, 2), the deformation of a small dot."""
        step = 0.01
        raw = self.to_raw(gel)
        columns = []
        for axis in (0, 1):
            shift = np.zeros(2)
            shift[axis] = step
            columns.append((self.to_gel(raw + shift) - self.to_gel(raw - shift)) / (2 * step))
        return np.stack(columns, axis=-1)


@lru_cache(maxsize=2)
def _noise_bank(seed: int, count: int) -> NDArray[np.int16]:
    drawn = np.random.default_rng([seed, 0x4E6F]).standard_normal(count + _BANK_SPAN, dtype=np.float32)
    drawn *= NOISE_UNIT
    np.clip(drawn, -32767, 32767, out=drawn)
    bank = np.rint(drawn, out=drawn).astype(np.int16)
    bank.setflags(write=False)
    return bank


def sensor_noise(seed: int, index: int, shape: tuple[int, int, int]) -> NDArray[np.int16]:
    """Standard normal noise of one frame as a read-only view, in units of 1 / `NOISE_UNIT`.

    It is a window of a fixed bank, since drawing 1.4 million normals takes 12 ms. Each of 2**22 frames has a
    unique offset, so that frames share values only at different positions.
    """
    count = shape[0] * shape[1] * shape[2]
    start = (index * _BANK_STEP + seed * 7919) % _BANK_SPAN
    return _noise_bank(seed, count)[start : start + count].reshape(shape)


def compressed(image: NDArray[np.uint8], quality: int) -> NDArray[np.uint8]:
    """An image (H, W, 3) uint8 after a JPEG round trip; quality 1 to 100."""
    _, encoded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(encoded, cv2.IMREAD_COLOR), dtype=np.uint8)
