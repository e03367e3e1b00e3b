"""Gels with dots for tests of detection and tracking: drawn at exactly known places, and real ones."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


def grid(
    rows: int, columns: int, pitch: float, *, corner: tuple[float, float], jitter: float = 0.0
) -> FloatArray:
    """(N, 2) centres by rows; `jitter` is the standard deviation of each coordinate, px (fixed seed)."""
    x, y = np.meshgrid(corner[0] + pitch * np.arange(columns), corner[1] + pitch * np.arange(rows))
    centers = np.column_stack([x.ravel(), y.ravel()])
    return centers + np.clip(np.random.default_rng(5).normal(0, 1, centers.shape), -2, 2) * jitter


def render(
    size: tuple[int, int],
    centers: FloatArray,
    radius: float,
    *,
    shape: str = "round",
    bright: bool = False,
    contrast: FloatArray | float = 0.8,
    noise: float = 0.0,
    seed: int = 0,
    blur: float = 0.7,
    light: float = 150.0,
) -> NDArray[np.uint8]:
    """(H, W, 3) uint8: dots of soft edge (logistic, standard deviation `blur` px) on a gel lit from one side.

    size : (width, height). contrast : share of the light a dot takes (or adds), one for all or one each.
    """
    width, height = size
    y, x = np.mgrid[0:height, 0:width].astype(np.float64)
    cover = np.zeros((height, width))
    reach = int(np.ceil(2.2 * radius + 6 * blur))
    strengths = np.broadcast_to(contrast, (len(centers),))
    for (cx, cy), strength in zip(centers, strengths, strict=True):
        rows = slice(max(0, int(cy) - reach), max(0, int(cy) + reach + 2))
        columns = slice(max(0, int(cx) - reach), max(0, int(cx) + reach + 2))
        dx, dy = x[rows, columns] - cx, y[rows, columns] - cy
        if shape == "square":
            inside = _edge(radius - np.abs(dx), blur) * _edge(radius - np.abs(dy), blur)
        elif shape == "doubled":
            left = _edge(0.7 * radius - np.hypot(dx + 0.9 * radius, dy), blur)
            right = _edge(0.7 * radius - np.hypot(dx - 0.9 * radius, dy), blur)
            inside = 1 - (1 - left) * (1 - right)
        else:
            inside = _edge(radius - np.hypot(dx, dy), blur)
        cover[rows, columns] = 1 - (1 - cover[rows, columns]) * (1 - strength * inside)
    ground = light * (0.85 + 0.3 * x / width)[..., None] * np.array([0.9, 1.0, 1.05])
    if bright:
        ground = 0.45 * ground
        picture = ground + (235 - ground) * cover[..., None]
    else:
        picture = ground * (1 - cover[..., None])
    picture = picture + np.random.default_rng(seed).normal(0, noise, picture.shape) if noise else picture
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)


def _edge(inside: FloatArray, blur: float) -> FloatArray:
    return 0.5 + 0.5 * np.tanh(inside * (0.9069 / blur))


def match(found: FloatArray, truth: FloatArray) -> tuple[NDArray[np.int64], FloatArray]:
    """For each found point the nearest true one, and their distance, px."""
    distance = np.linalg.norm(found[:, None] - truth[None], axis=2)
    return distance.argmin(axis=1), distance.min(axis=1)


CORNERS = np.array([[33, 58], [208, 61], [56, 250], [185, 244]], np.float32)
TARGET = np.array([[0, 0], [240, 0], [0, 320], [240, 320]], np.float32)


def rectified(path: Path) -> NDArray[np.uint8]:
    """A picture of the real wedge, its gel mapped to 240 x 320 px."""
    image = cv2.imread(str(path))
    assert image is not None
    return np.asarray(
        cv2.warpPerspective(image, cv2.getPerspectiveTransform(CORNERS, TARGET), (240, 320)), np.uint8
    )
