"""Presses of a ball on the simulated gel, as a calibration has them."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from tactflow.calibration.presses import Press, Session
from tactflow.calibration.scale import centre
from tactflow.sim import Scene
from tactflow.sim.gel import MM_PER_PX
from tactflow.vision.geometry import Preprocessor
from tactflow.vision.types import Scale

RAW_MM: Final = MM_PER_PX
"""Millimetres per raw pixel that the simulated gel is given."""
BALL: Final = 95 * RAW_MM
"""Radius of the ball of the scene `ball`, mm."""


def scale() -> Scale:
    """The true scale of the simulated gel in the default pipeline's processed frame."""
    return Scale(2 * RAW_MM, 2 * RAW_MM, (0.0, 0.0), centre(_preprocessor().mapping.size))


def session_of(scene: Scene) -> Session:
    """Every press of a scene at its deepest, with the true outline and without markers."""
    preprocess = _preprocessor()
    rest = preprocess(scene.clean(0))
    presses = [_press(scene, index, preprocess) for index in deepest(scene)]
    return Session(rest, preprocess.mapping, presses, np.zeros((0, 2)), len(scene))


def deepest(scene: Scene) -> list[int]:
    """The frame of each press in which it has come to its full depth."""
    depths = [max((press.depth for press in scene.presses(i)), default=0.0) for i in range(len(scene))]
    return [i for i in range(1, len(scene) - 1) if depths[i - 1] < depths[i] >= depths[i + 1]]


def _preprocessor() -> Preprocessor:
    return Preprocessor((800, 600), rotate=90, downsample=2)


def _press(scene: Scene, index: int, preprocess: Preprocessor) -> Press:
    truth = scene.truth(index, preprocess)
    mask = np.where(truth.contact_mask, 255, 0).astype(np.uint8)
    radius = float(np.sqrt(np.count_nonzero(mask) / np.pi))
    center = truth.center or (0.0, 0.0)
    image = noisy(preprocess(scene.clean(index)), index)
    return Press(index, image, mask, np.zeros(mask.shape, np.bool_), center, radius)


def noisy(image: NDArray[np.uint8], seed: int) -> NDArray[np.uint8]:
    """The picture with the noise of a camera whose frames were halved: one grey level."""
    noise = np.random.default_rng(seed).normal(0, 1, image.shape)
    return np.clip(np.rint(image + noise), 0, 255).astype(np.uint8)
