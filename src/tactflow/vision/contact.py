"""Where something touches the gel: comparison with frames of the untouched gel.

The default method is a test against the sensor's own noise, at a stated rate of false alarms, followed by a
region that does not depend on the noise:

1. Frames are compared as means over cells of 4 x 4 px, lightly smoothed.
2. A change of the light that is smooth over the whole frame (gain, offset and plane per channel) is
   estimated robustly, so that a contact is an outlier of the fit, and taken out.
3. What is left, divided by the noise, is chi-square distributed with three degrees of freedom where nothing
   touches: one threshold says whether anything does.
4. Around every such place the region ends where the change has fallen to a fixed fraction of its local
   maximum, and is filled. A gel lit from the side answers with the *slope* of its surface, so that the rim of
   a contact changes most and its middle may not change at all.

References
----------
R. Otsu-free change detection: T. Aach, A. Kaup, R. Mester, "Statistical model-based change detection in
moving video", Signal Processing 31 (1993).
P. J. Huber, "Robust Statistics", 1981, chapter 7.8 (modified residuals).
M. K. Johnson, E. H. Adelson, "Retrographic sensing for the measurement of surface texture and shape", CVPR
2009 (why the answer of the gel goes with its slope).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.seed_contact import seed_contact_mask

ContactMethod = Literal["noise", "colour", "seed"]
Float = NDArray[np.float32]

CELL = 4
BLOCK = 8


@dataclass(frozen=True, slots=True)
class ContactResult:
    """mask : (H, W) uint8, 255 in contact, else 0. touching : True if any pixel is in contact."""

    mask: NDArray[np.uint8]
    touching: bool
    strength: float = 0.0


def chi_square_threshold(probability: float) -> float:
    """Value that a chi-square variable with three degrees of freedom exceeds with this probability."""

    def tail(x: float) -> float:
        return math.erfc(math.sqrt(x / 2)) + math.sqrt(2 * x / math.pi) * math.exp(-x / 2)

    low, high = 0.0, 1000.0
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if tail(middle) > probability else (low, middle)
    return high


def reduce_to_cells(image: NDArray[np.uint8]) -> Float:
    """Means over CELL x CELL px, smoothed by 3 x 3 cells: (rows, columns, 3) float32."""
    height, width = image.shape[:2]
    bottom, right = -height % CELL, -width % CELL
    if bottom or right:
        image = np.asarray(cv2.copyMakeBorder(image, 0, bottom, 0, right, cv2.BORDER_REPLICATE), np.uint8)
    height, width = image.shape[:2]
    half = cv2.resize(image, (width // 2, height // 2), interpolation=cv2.INTER_AREA)
    return np.asarray(
        cv2.resize(half.astype(np.float32), (width // 4, height // 4), interpolation=cv2.INTER_AREA),
        np.float32,
    )


class ContactDetector:
    """Finds where a gel is touched, by comparison with frames of the untouched gel."""

    def __init__(
        self,
        method: ContactMethod = "noise",
        *,
        false_alarms: float = 1e-6,
        edge: float = 0.4,
        repeatability: float = 0.015,
        distance: float = 24.0,
    ) -> None:
        self.method = method
        self.false_alarms = false_alarms
        self.edge = edge
        self.repeatability = repeatability
        self.distance = distance
        self.reset()

    def reset(self) -> None:
        """Forget the reference."""
        self._reference: NDArray[np.uint8] | None = None
        self._count = 0

    @property
    def has_reference(self) -> bool:
        """Whether a frame of the untouched gel is known."""
        return self._reference is not None

    def add_reference(self, image: NDArray[np.uint8]) -> None:
        """Learn from a frame of the untouched gel."""
        self._reference = image.copy()
        if self.method != "noise":
            return
        cells = reduce_to_cells(image)
        smooth = cv2.blur(cells, (3, 3))
        if self._count == 0:
            self._mean = smooth
            self._m2 = np.zeros_like(smooth)
            self._count = 1
            self._sigma0 = self._spatial(cells)
            self._prepare()
        else:
            d, _ = self._change(smooth)
            self._count += 1
            self._mean = self._mean + d / self._count
            self._m2 += d * d * ((self._count - 1) / self._count)
            self._prepare()

    def _spatial(self, cells: Float) -> Float:
        """Noise of smoothed cells, from second differences of one frame, as a function of brightness."""
        out = np.empty_like(cells)
        for c in range(3):
            x = cells[..., c]
            if min(x.shape) < 3:
                out[..., c] = 0.3
                continue
            lap = (x[1:-1, :-2] - 2 * x[1:-1, 1:-1] + x[1:-1, 2:]) / np.float32(6**0.5)
            level = x[1:-1, 1:-1].ravel()
            order = np.argsort(level)
            parts = np.array_split(order, 6)
            centre = [float(level[p].mean()) for p in parts if p.size]
            spread = [1.4826 * float(np.median(np.abs(lap.ravel()[p]))) for p in parts if p.size]
            out[..., c] = np.interp(x, centre, spread)
        return out / 2

    def _prepare(self) -> None:
        mean = self._mean
        h, w = mean.shape[:2]
        n = self._count
        prior = 8
        var = (prior * self._sigma0**2 + self._m2) / (prior + n - 1)
        var = var * (1 + 1 / n) + (self.repeatability * mean) ** 2 + 0.05
        self._inv = (1 / var).astype(np.float32)
        bw, bh = max(2, w // BLOCK), max(2, h // BLOCK)
        self._bsize = (bw, bh)
        y, x = np.mgrid[0:h, 0:w].astype(np.float32)
        x = (x - x.mean()) / max(w, 1)
        y = (y - y.mean()) / max(h, 1)
        ref = mean.transpose(2, 0, 1)
        basis = np.stack(
            [np.broadcast_to(np.stack([np.ones_like(x), x, y]), (3, 3, h, w))[c] for c in range(3)]
        )
        refn = (ref - ref.mean((1, 2), keepdims=True)) / 100
        self._basis = np.concatenate([basis, refn[:, None]], 1).reshape(3, 4, h * w).astype(np.float32)
        small = []
        for c in range(3):
            small.append(
                [
                    cv2.resize(b.reshape(h, w), self._bsize, interpolation=cv2.INTER_AREA).ravel()
                    for b in self._basis[c]
                ]
            )
        B = np.array(small)  # 3,4,n
        self._bb = B
        ridge = np.eye(4) * 1e-3 * B.shape[2]
        self._pinv = np.linalg.solve(B @ B.transpose(0, 2, 1) + ridge, B)  # 3,4,n
        self._bref = cv2.resize(mean, self._bsize, interpolation=cv2.INTER_AREA).reshape(-1, 3).T
        bvar = cv2.resize(var.astype(np.float32), self._bsize, interpolation=cv2.INTER_AREA).reshape(-1, 3).T
        self._bs = np.sqrt(bvar)

    def _light(self, smooth: Float) -> NDArray[np.float64]:
        y = cv2.resize(smooth, self._bsize, interpolation=cv2.INTER_AREA).reshape(-1, 3).T - self._bref
        beta = np.zeros((3, 4))
        beta[:, 0] = np.median(y, 1)
        k = 2.0 * self._bs
        for _ in range(10):
            r = y - np.einsum("ck,ckn->cn", beta, self._bb)
            step = np.einsum("ckn,cn->ck", self._pinv, np.clip(r, -k, k))
            beta += step
            if np.abs(step).max() < 0.02:
                break
        return beta

    def _change(self, smooth: Float) -> tuple[Float, NDArray[np.float64]]:
        beta = self._light(smooth)
        h, w = smooth.shape[:2]
        light = np.matmul(beta[:, None, :].astype(np.float32), self._basis).reshape(3, h, w)
        return smooth - self._mean - light.transpose(1, 2, 0), beta

    def detect(self, image: NDArray[np.uint8]) -> ContactResult:
        """Compare a frame with the untouched gel."""
        if self._reference is None:
            raise ValueError("required a reference frame first: call add_reference")
        if self.method == "seed":
            mask = seed_contact_mask(image, self._reference)
            return ContactResult(mask, bool(mask.any()))
        if self.method == "colour":
            change = cv2.blur(cv2.absdiff(image, self._reference), (5, 5)).astype(np.float32)
            squared = np.einsum("ijk,ijk->ij", change, change)
            mask = np.where(squared > self.distance**2, 255, 0).astype(np.uint8)
            mask = np.asarray(cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((7, 7), np.uint8)), np.uint8)
            return ContactResult(mask, bool(mask.any()))
        smooth = cv2.blur(reduce_to_cells(image), (3, 3))
        d, _ = self._change(smooth)
        d2 = d * d
        z = (d2 * self._inv).sum(2)
        high = chi_square_threshold(self.false_alarms / z.size)
        peak = float(z.max())
        h, w = image.shape[:2]
        if peak < high:
            return ContactResult(np.zeros((h, w), np.uint8), False, peak**0.5)
        s = np.sqrt(d2.sum(2))
        mask = self._region(s, z, high)
        mask = mask[:h, :w].copy()
        return ContactResult(mask, bool(mask.any()), peak**0.5)

    def _region(self, s: Float, z: Float, high: float) -> NDArray[np.uint8]:
        low = high / 4
        support = (z > low).astype(np.uint8)
        n, labels, _, _ = cv2.connectedComponentsWithStats(support, connectivity=8)
        u = np.zeros_like(s)
        for i in range(1, n):
            inside = labels == i
            if z[inside].max() < high:
                continue
            v = np.sort(s[inside])
            top = v[-max(1, min(15, v.size // 8))]
            u = np.where(inside, s / (self.edge * top), u)
        m = np.pad((u > 1).astype(np.uint8), 1)
        flood = m.copy()
        cv2.floodFill(flood, None, (0, 0), 2)
        hole = (flood != 2)[1:-1, 1:-1] & (u <= 1)
        u[hole] = 2
        u = np.minimum(u, 2)
        big = cv2.resize(u, (s.shape[1] * CELL, s.shape[0] * CELL), interpolation=cv2.INTER_LINEAR)
        return (big > 1).astype(np.uint8) * np.uint8(255)
