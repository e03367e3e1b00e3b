"""Where something touches the gel, as a network sees it that was trained on random simulated gels.

1. `change` compares a frame with the untouched gel on a grid of cells.
2. If anything has changed beyond the noise, `network` says how likely each cell is in contact.
3. The outline is drawn at the probability that makes the expected overlap with the true region largest: 0.5
   for a sharp contact, less for a faint one.
4. A connected region within is a contact if the network is certain of it anywhere, or if it continues the
   contact of the previous frame.

References
----------
Z. C. Lipton, C. Elkan, B. Naryanaswamy, "Optimal thresholding of classifiers to maximize F1 measure", ECML
2014, for the outline.
"""

from __future__ import annotations

import math
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from tactflow.vision.arrays import Flags, Floats32, Mask, check_color_image, check_mask
from tactflow.vision.contact.change import CLEAR, Change, Untouched
from tactflow.vision.contact.detector import FORGET, ContactResult
from tactflow.vision.contact.network import ContactNetwork
from tactflow.vision.types import Markers

LEVELS: Final = 200
"""Steps of probability in which that of the outline is sought."""
OUTSIDE: Final = -10.0
"""Log odds of contact where no gel is."""


class LearnedDetector:
    """Finds where a gel is touched, by the network of `tactflow.vision.contact.network`.

    Parameters
    ----------
    certainty : probability from which a region is a contact, in [0.5, 1). Higher misses lighter contacts,
        lower finds some where only the light has changed.
    relaxation : part of the largest recent change that a gel may still show after it was released, in
        [0, 1): soft gels creep back within a second or so. Higher ends a contact earlier while it is lifted.

    Raises
    ------
    ValueError : a parameter out of its range.

    Examples
    --------
    >>> from tactflow.sim import open_scene
    >>> scene = open_scene("unmarked")
    >>> detector = LearnedDetector()
    >>> detector.add_reference(scene.frame(0))
    >>> detector.detect(scene.frame(1)).touching, detector.detect(scene.frame(60)).touching
    (False, True)
    """

    def __init__(self, *, certainty: float = 0.9, relaxation: float = 0.2) -> None:
        if not 0.5 <= certainty < 1:
            raise ValueError(f"certainty: required in [0.5, 1), got {certainty}")
        if not 0 <= relaxation < 1:
            raise ValueError(f"relaxation: required in [0, 1), got {relaxation}")
        self._certain = math.log(certainty / (1 - certainty))
        self._relaxation = relaxation
        self._network = ContactNetwork()
        self.reset()

    def reset(self) -> None:
        """Forget the reference."""
        self._untouched: Untouched | None = None
        self._before: Flags | None = None
        self._largest = 0.0

    @property
    def has_reference(self) -> bool:
        """Whether a frame of the untouched gel is known."""
        return self._untouched is not None

    def add_reference(self, image: NDArray[np.uint8], valid: Mask | None = None) -> None:
        """Learn from a frame of the untouched gel; the mean of several has less noise.

        image : (H, W, 3) uint8, BGR grey levels, without markers.
        valid : (H, W) uint8, 0 where the picture shows no gel, and so no contact either; that of the first
            frame holds. None: gel is everywhere.
        Raises ValueError if they are not of that kind, or not of the size of the frames before.
        """
        self._check(image)
        if self._untouched is not None:
            self._untouched.add(image)
            return
        if valid is not None:
            check_mask(valid, image.shape[:2])
        self._untouched = Untouched(image, valid)

    def detect(
        self, image: NDArray[np.uint8], hidden: Mask | None = None, markers: Markers | None = None
    ) -> ContactResult:
        """Compare a frame with the untouched gel.

        image : (H, W, 3) uint8, BGR grey levels, without markers, of the reference's size.
        hidden : (H, W) uint8, not 0 where a marker was removed. markers : those of this frame, which the
            network looks at, too; None: unknown.
        Raises ValueError if they are not of that kind, or without a reference.
        """
        if self._untouched is None:
            raise ValueError("required a reference frame first: call add_reference")
        self._check(image)
        if hidden is not None:
            check_mask(hidden, image.shape[:2])
        change = self._untouched.change(image, hidden, markers)
        before, self._before = self._before, None
        self._largest *= FORGET
        if change.strength >= CLEAR:
            odds = self._network(change)
            odds[~self._untouched.gel] = OUTSIDE
            level = outline_level(np.asarray(expit(odds), np.float32))
            contact = self._contacts(odds, level, change, before)
            if contact.any():
                self._before, self._largest = contact, max(self._largest, change.largest)
                mask = _outlined(odds - np.float32(level), contact, image.shape[:2])
                return ContactResult(mask, True, change.strength)
        return ContactResult(np.zeros(image.shape[:2], np.uint8), False, change.strength)

    def _check(self, image: NDArray[np.uint8]) -> None:
        check_color_image(image)
        if self._untouched is not None and image.shape != self._untouched.shape:
            raise ValueError(f"required the reference's shape {self._untouched.shape}, got {image.shape}")

    def _contacts(self, odds: Floats32, level: float, change: Change, before: Flags | None) -> Flags:
        """(h, w) bool: the regions of likely cells that are contacts.

        level : log odds from which a cell may belong to one. before : the same of the previous frame; None if
        nothing touched the gel.
        """
        if before is None and change.largest < self._relaxation * self._largest:
            return np.zeros(odds.shape, np.bool_)
        count, labels = cv2.connectedComponents((odds > level).view(np.uint8), connectivity=4)
        seeds = odds >= self._certain
        if before is not None:
            seeds |= before & (odds > 0)
        taken = np.zeros(count, np.bool_)
        taken[labels[seeds]] = True
        return np.asarray(taken[labels] & (odds > level), np.bool_)


def outline_level(probability: Floats32) -> float:
    """Log odds from which a cell belongs to the region that is expected to overlap most with the true one.

    probability : of each cell, of any shape. The overlap is that of Dice, 2 |A and B| / (|A| + |B|); the
    threshold is half of the largest that can be expected (Lipton et al.).

    >>> outline_level(np.array([0.0, 1.0], np.float32)), outline_level(np.array([0.4], np.float32)) < 0
    (0.0, True)
    """
    steps = (probability.ravel() * LEVELS).astype(np.int64)
    counts = np.bincount(steps, minlength=LEVELS + 1)[::-1]
    sums = np.bincount(steps, probability.ravel(), LEVELS + 1)[::-1]
    expected = 2 * np.cumsum(sums) / np.maximum(np.cumsum(counts) + sums.sum(), 1e-9)
    threshold = min(max(float(expected.max()) / 2, 1 / LEVELS), 0.5)
    return math.log(threshold / (1 - threshold))


def _outlined(odds: Floats32, contact: Flags, shape: tuple[int, int]) -> Mask:
    """(H, W) uint8: 255 where the interpolated values (h, w) of the contacts are positive."""
    kept = np.where(contact | (odds <= 0), odds, np.float32(-1))
    smooth = cv2.resize(kept, shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.where(smooth > 0, 255, 0).astype(np.uint8)
