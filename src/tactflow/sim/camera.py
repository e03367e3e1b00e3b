"""The simulated camera: where a point of the gel lands on the sensor, and what the electronics add.

The gel plane and the raw frame share one unit (raw pixels); without perspective and distortion they are
the same plane. Everything is closed-form or solved to machine precision, so that truth can be mapped too.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float64]

NOISE_UNIT = 4096.0
"""Integer steps of the noise bank per standard deviation."""
_APERTURE_EDGE = 3.0
"""Width of the unsharp rim of the aperture, px. Chosen by hand."""
_BANK_SPAN = 1 << 22
_BANK_STEP = 2592173
"""Offsets into the noise bank, elements, and the step from one frame's to the next. An odd step near span /
golden ratio visits all 2**22 offsets before it repeats one, and keeps any two of the first n at least
span / (2.7 n) apart."""


class Camera:
    """Perspective followed by radial lens distortion, seen through a round aperture.

    Parameters
    ----------
    size : (width, height) of the raw frame, px.
    perspective : in [0, 0.4]; each lower corner of the gel moves inwards by this fraction of half the width
        and the whole gel shrinks a little, so that it appears as the trapezoid of a tilted camera. 0: none.
    distortion : in [-0.2, 0.4]; k of undistorted = distorted * (1 + k rho^2), rho = distance from the centre
        in half diagonals. Positive is a barrel (wide lens), negative a pincushion. 0: none.
    aperture : radius of the round picture in a black frame, in half heights of the frame. 0: none.
    """

    def __init__(
        self,
        size: tuple[int, int],
        perspective: float = 0.0,
        distortion: float = 0.0,
        aperture: float = 0.0,
    ) -> None:
        self.size = size
        self._key = (size, perspective, distortion, aperture)
        width, height = size
        self._radius = aperture * height / 2.0 if aperture else np.inf
        self.identity = perspective == 0.0 and distortion == 0.0
        self._k = distortion
        self._center = np.array([(width - 1) / 2.0, (height - 1) / 2.0])
        self._half_diagonal = float(np.hypot(width, height)) / 2.0
        self._homography = np.eye(3)
        if perspective:
            left, top, right, bottom = -0.5, -0.5, width - 0.5, height - 0.5
            inset_x, inset_y = 0.1 * perspective * width, 0.15 * perspective * height
            squeeze = perspective * width / 2.0
            gel = np.array([[left, top], [right, top], [left, bottom], [right, bottom]])
            raw = np.array(
                [
                    [left + inset_x, top + inset_y],
                    [right - inset_x, top + inset_y],
                    [left + inset_x + squeeze, bottom - inset_y],
                    [right - inset_x - squeeze, bottom - inset_y],
                ]
            )
            self._homography = homography(gel, raw)
        self._inverse = np.linalg.inv(self._homography).astype(np.float64)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Camera) and other._key == self._key

    def __hash__(self) -> int:
        return hash(self._key)

    def to_gel(self, raw: Points) -> Points:
        """Gel coordinates (N, 2) float64 of raw pixel positions (N, 2)."""
        if self.identity:
            return np.array(raw, dtype=np.float64)
        offset = self._relative(raw)
        offset *= 1.0 + self._k * np.sum(offset * offset, axis=-1, keepdims=True)
        return project(self._inverse, self._absolute(offset))

    def to_raw(self, gel: Points) -> Points:
        """Raw pixel positions (N, 2) float64 of gel coordinates (N, 2)."""
        if self.identity:
            return np.array(gel, dtype=np.float64)
        offset = self._relative(project(self._homography, np.asarray(gel, dtype=np.float64)))
        if self._k:
            radius = np.sqrt(np.sum(offset * offset, axis=-1))
            solved = radius.copy()
            for _ in range(12):  # Newton; quadratic, so a dozen steps reach machine precision
                solved -= (solved * (1.0 + self._k * solved**2) - radius) / (1.0 + 3.0 * self._k * solved**2)
            shrink = np.divide(solved, radius, out=np.ones_like(radius), where=radius > 0)
            offset *= shrink[..., None]
        return self._absolute(offset)

    def aperture(self, raw: Points) -> NDArray[np.float64]:
        """Share of the light, (N,) in [0, 1], that reaches raw pixel positions (N, 2): 0 in a black frame."""
        inside = self._radius - np.hypot(raw[..., 0] - self._center[0], raw[..., 1] - self._center[1])
        return np.asarray(0.5 + 0.5 * np.tanh(inside / _APERTURE_EDGE), dtype=np.float64)

    def _relative(self, pixels: Points) -> Points:
        return np.asarray((pixels - self._center) / self._half_diagonal, dtype=np.float64)

    def _absolute(self, offset: Points) -> Points:
        return np.asarray(offset * self._half_diagonal + self._center, dtype=np.float64)

    def local_inverse(self, gel: Points) -> NDArray[np.float64]:
        """(N, 2, 2) derivative d gel / d raw at gel points (N, 2): how a small dot is deformed."""
        step = 0.01
        raw = self.to_raw(gel)
        columns = []
        for axis in (0, 1):
            shift = np.zeros(2)
            shift[axis] = step
            columns.append((self.to_gel(raw + shift) - self.to_gel(raw - shift)) / (2 * step))
        return np.stack(columns, axis=-1)


def homography(source: Points, target: Points) -> NDArray[np.float64]:
    """The 3 x 3 projective map that takes four points (4, 2) to four points (4, 2), float64."""
    rows = []
    for (x, y), (u, v) in zip(source, target, strict=True):
        rows.append([x, y, 1, 0, 0, 0, -u * x, -u * y])
        rows.append([0, 0, 0, x, y, 1, -v * x, -v * y])
    solved = np.linalg.solve(np.array(rows, dtype=np.float64), np.asarray(target, dtype=np.float64).ravel())
    return np.append(solved, 1.0).reshape(3, 3)


def project(matrix: NDArray[np.float64], points: Points) -> Points:
    """Apply a 3 x 3 projective map to points (..., 2)."""
    mapped = points @ matrix[:, :2].T + matrix[:, 2]
    return np.asarray(mapped[..., :2] / mapped[..., 2:], dtype=np.float64)


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

    Drawing 1.4 million normals costs 12 ms; a window of a fixed bank costs nothing. Window `index` starts at
    an offset that no other of 2**22 frames uses, so that at each pixel every frame sees a draw of its own;
    two frames share draws only at positions apart from each other.
    """
    count = shape[0] * shape[1] * shape[2]
    start = (index * _BANK_STEP + seed * 7919) % _BANK_SPAN
    return _noise_bank(seed, count)[start : start + count].reshape(shape)


def compressed(image: NDArray[np.uint8], quality: int) -> NDArray[np.uint8]:
    """The image (H, W, 3) uint8 after a JPEG round trip at `quality` in 1..100."""
    _, encoded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(encoded, cv2.IMREAD_COLOR), dtype=np.uint8)


def delivered_frames(count: int, dropped: float, repeated: float, seed: int) -> Sequence[int]:
    """(count,): which moment of the scene the camera delivers as frame i.

    dropped, repeated : fractions in [0, 0.9]. A dropped moment is never delivered (the next frame comes in
    its place); a repeated one is delivered twice, bit for bit.
    """
    if not dropped and not repeated:
        return range(count)
    draw = np.random.default_rng([seed, 0x6472]).random((count, 2))
    steps = np.ones(count, dtype=np.int64)
    steps[draw[:, 0] < dropped] = 2
    steps[draw[:, 1] < repeated] = 0
    steps[0] = 0
    return [int(moment) for moment in np.cumsum(steps)]
