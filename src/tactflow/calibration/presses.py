"""Find presses of a ball in the results of a pipeline."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tactflow.engine.errors import ConfigError
from tactflow.message.result import Result
from tactflow.system.spelling import distinct
from tactflow.vision.geometry import PixelMapping

logger = logging.getLogger("tactflow")

Picture = NDArray[np.uint8]

NEEDED: Final = {"image": "preprocess", "contact": "hull"}
"""Ports that a pipeline must have -> the stage that gives them."""
MAX_REST_DIFFERENCE: Final = 0.03
"""Largest RMS difference of the untouched gel within a session, relative to its brightness. Chosen by hand,
between the scatter within a session (0.01) and the limit for using a calibration (0.1)."""
MOVED_ON_RADII: Final = 0.5
"""Distance from the current press, in its radii, beyond which a contact is a new press. Chosen by hand."""
MOVED_ALONE_RADII: Final = 0.1
"""The same for pictures that were taken one by one, and for the change of the radius. Chosen by hand."""


@dataclass(frozen=True, eq=False, slots=True)
class Press:
    """One press of the ball, at the moment when its contact was largest.

    Attributes
    ----------
    seq : of the frame.
    image : (H, W, 3) uint8, without markers.
    mask : (H, W) uint8, 255 in contact.
    hidden : (H, W) bool, where a marker was.
    center : (x, y) of the contact, px.
    radius : of a disc of its area, px.
    core_radius : of a disc of the area of its core, px; NaN where that is not known.
    """

    seq: int
    image: Picture
    mask: Picture
    hidden: NDArray[np.bool_]
    center: tuple[float, float]
    radius: float
    core_radius: float = math.nan


@dataclass(frozen=True, eq=False, slots=True)
class Session:
    """What a recording shows that a calibration needs.

    Attributes
    ----------
    untouched : (H, W, 3) uint8, mean of the latest reference frames, without markers.
    mapping : from raw to processed pixels.
    presses : in order.
    dots : (N, 2) float64, markers of the untouched gel, px; empty without markers.
    frames : how many there were.
    """

    untouched: Picture
    mapping: PixelMapping
    presses: list[Press]
    dots: NDArray[np.float64]
    frames: int


class PressFinder:
    """Finds the presses in results, which are added one after the other.

    A press lasts as long as something touches about the same place; the frame with its largest contact is
    kept.

    Parameters
    ----------
    pictures : frames were taken one by one, so each contact that moves or changes its size is a new press.

    Attributes
    ----------
    presses : so far.
    frames : number of results that were added.
    lasts : whether the last press goes on.
    """

    def __init__(self, pictures: bool = False) -> None:
        self.pictures = pictures
        self.presses: list[Press] = []
        self.frames = 0
        self.lasts = False
        self._reference: list[Picture] = []
        self._before: Picture | None = None
        self._epoch = 0
        self._mapping: PixelMapping | None = None
        self._dots = np.zeros((0, 2))

    def add(self, result: Result) -> None:
        """Look at a result that holds its pictures (`images=True` of `tactflow.stream`)."""
        frame, image = result.frame, result.image
        if image is None:
            return
        unmarked: Picture = result.get("unmarked", image)
        self.frames += frame.seq >= 0
        if not self._reference or frame.reference:
            if self._reference and frame.epoch != self._epoch:
                self._before, self._reference = self.untouched, []
            self._epoch = frame.epoch
            self._reference.append(unmarked.copy())
            self._mapping = result.get("mapping")
        elif self._before is not None:
            self._drop_presses_of_another_look(self._before)
            self._before = None
        if result.markers is not None:
            self._dots = result.markers.origin
        if result.contact is None or result.contact_mask is None or frame.reference:
            self.lasts = False
            return
        mask = result.contact_mask
        hidden: Picture = result.get("marker_mask", np.zeros_like(mask))
        radius = float(np.sqrt(np.count_nonzero(mask) / np.pi))
        core_radius = math.sqrt((result.contact.core_area or math.nan) / math.pi)
        self._add(Press(frame.seq, unmarked, mask, hidden > 0, result.contact.center, radius, core_radius))

    def _drop_presses_of_another_look(self, before: Picture) -> None:
        """Drop the presses so far if the gel looked different `before` the new reference."""
        differs = difference(self.untouched, before)
        if differs > MAX_REST_DIFFERENCE:
            logger.warning(
                "calibrate: the new reference differs by %s %% of its brightness from the one before "
                "(%s %% at most); the presses before it, %d, are left out: press there again",
                *distinct(100 * differs, 100 * MAX_REST_DIFFERENCE),
                len(self.presses),
            )
            self.presses.clear()

    def _add(self, press: Press) -> None:
        """Start a new press, or extend the last one."""
        if self.lasts:
            last = self.presses[-1]
            moved = float(np.hypot(*np.subtract(press.center, last.center))) / last.radius
            changed = abs(press.radius / last.radius - 1)
            if max(moved, changed) < MOVED_ALONE_RADII if self.pictures else moved < MOVED_ON_RADII:
                if press.radius > last.radius:
                    self.presses[-1] = press
                return
        self.lasts = True
        self.presses.append(press)

    @property
    def untouched(self) -> Picture:
        """(H, W, 3) uint8: mean of the reference frames. Raises ConfigError if there were no frames."""
        if not self._reference:
            raise ConfigError("calibrate: the source has no frames")
        return np.asarray(np.rint(np.mean(self._reference, axis=0)), np.uint8)

    def session(self) -> Session:
        """What was found. Raises ConfigError if there were no frames."""
        height, width = self.untouched.shape[:2]
        mapping = self._mapping or PixelMapping.identity((width, height))
        return Session(self.untouched, mapping, self.presses, self._dots, self.frames)


def difference(untouched: Picture, before: Picture) -> float:
    """RMS difference of two pictures (H, W, 3) uint8 of a gel, relative to the brightness of the second.

    >>> difference(np.full((2, 2, 3), 120, np.uint8), np.full((2, 2, 3), 100, np.uint8))
    0.2
    """
    return float(np.sqrt(np.mean((untouched.astype(float) - before) ** 2)) / max(before.mean(), 1))


def usual_radius(presses: Sequence[Press]) -> float:
    """Median radius of the contacts, px; 0 without any."""
    return float(np.median([press.radius for press in presses])) if presses else 0.0
