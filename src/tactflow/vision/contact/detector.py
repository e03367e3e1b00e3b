"""Where something touches the gel: comparison with frames of the untouched gel.

The default method first asks *whether*, by a test against the sensor's own noise at a stated rate of false
alarms, and then *where*, by a rule that does not depend on the noise:

1. Frames are compared as means over cells of 4 x 4 px, lightly smoothed.
2. A change of the light that is smooth over the whole frame is fitted robustly and taken out.
3. What is left, divided by its standard deviation, is chi-square distributed with three degrees of freedom
   where nothing touches. One threshold, corrected for the number of cells, says whether anything does.
4. Beside that, changes of colour alone: lamps flicker and shadows fall in brightness, hardly in colour. A
   fainter change of colour is contact if it is wide, which neither noise nor compressed blocks are.
5. Contact ends at the noise, or at a part of the strongest recent change, since a released gel creeps back;
   but not while it fades faster than by creeping: then it is still being unloaded.
6. Each connected change around such a place is looked at again at half resolution; `imprint` finds its rim.

References
----------
T. Aach, A. Kaup, R. Mester, "Statistical model-based change detection in moving video", Signal Processing 31
(1993), for the test; K. Friston et al., "Assessing the significance of focal activations using their spatial
extent", Human Brain Mapping 1 (1994), for the test by extent. `light` and `imprint` name the sources of
theirs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision import compiled
from tactflow.vision.contact import background_kernels, contact_outline_kernels
from tactflow.vision.contact.background import CELL, UntouchedGel
from tactflow.vision.contact.contact_outline import fill_level, hidden_cells, outline_level
from tactflow.vision.geometry import downsample

ContactMethod = Literal["noise", "colour"]
Float = NDArray[np.float32]

_WEAK = 0.02
"""Places with less of the summed squared deviation than this part of the main one's are wrinkles of it."""
_LEAVE = 0.7
"""Part of the threshold, in standard deviations, that is enough to stay in contact."""
_BLOBS = 12
"""At most so many places are outlined."""
_LEAST = 8
"""Cells that must change together; 128 px^2 is the halo of a ball's first touch."""
_FADE = 0.96
"""How fast the strongest recent change is forgotten, per frame: half in 17 frames."""
_SLOW_FADE = 0.98
"""The same for wide, faint changes, which a gel that creeps back shows longest."""
_TINTED = 12.0
"""Squared deviation of the colour from which a cell counts as part of a wide change: 1 of 400 by chance."""
_WIDE = 0.01
"""Part of the picture that a wide change covers at least: more than the noise of compression, which comes in
blocks of 16 px of the camera."""
_CLUSTER = 0.7
"""Cells by which a wide change must be larger for each factor of e in the rate of false alarms: measured on
white noise, smoothed as the cells are."""
_GONE = 0.5
"""A faint change of which less is left after a frame has no longer the outline that it had, and is gone."""
_BRIDGE = 8.0
"""Radius of the gaps in an outline that a removed marker may have left, px."""


@dataclass(frozen=True, slots=True)
class ContactResult:
    """Where a frame shows contact.

    mask : (H, W) uint8, 255 in contact, else 0. touching : whether any pixel is in contact.
    strength : largest change anywhere, in standard deviations of the untouched gel (`noise` only; else 0).
    """

    mask: NDArray[np.uint8]
    touching: bool
    strength: float = 0.0


def chi_square_threshold(probability: float) -> float:
    """Value that a chi-square variable with three degrees of freedom exceeds with a probability in (0, 1)."""
    if not 0 < probability < 1:
        raise ValueError(f"required a probability in (0, 1), got {probability}")
    low, high = 0.0, 1500.0
    for _ in range(60):
        middle = (low + high) / 2
        tail = math.erfc(math.sqrt(middle / 2)) + math.sqrt(2 * middle / math.pi) * math.exp(-middle / 2)
        low, high = (middle, high) if tail > probability else (low, middle)
    return high


class ContactDetector:
    """Finds where a gel is touched, by comparison with frames of the untouched gel.

    Computed in float32; against float64 the outline moves by at most 1 px, the strength by 1e-5 of itself.

    Parameters
    ----------
    method : `noise` works for gels that answer with brightness or colour. `colour` is a plain distance of
        colours with a fixed threshold.
    false_alarms : expected number of frames of the untouched gel that are called contact, per frame, in
        (0, 1). Lower misses lighter contacts.
    repeatability : part of the brightness by which the light of the untouched gel may vary from place to
        place, as well as noise, 0..1. Higher misses lighter contacts.
    tint : the same for the colour of the light, if smaller than `repeatability`, 0..1: part of the brightness
        by which the channels may vary against each other. Higher finds soft contacts later on gels that
        answer with colour; lower sees blocks of compression.
    shift : distance by which the untouched gel may move against the camera, px. It makes sharp edges in the
        picture count less.
    relaxation : part of the strongest recent change that a gel may still show after it was released, in
        [0, 1): soft gels creep back within a second or so. Higher ends a contact earlier while it is lifted.
    creep : part of its change, 0..1, that a released gel loses from one frame to the next at most. What fades
        faster, but not to `relaxation` at once, is still being lifted. Higher ends a contact earlier.
    distance : for `colour`: change of colour that is contact, grey levels.

    Raises
    ------
    ValueError : a parameter out of its range.
    """

    def __init__(
        self,
        method: ContactMethod = "noise",
        *,
        false_alarms: float = 1e-6,
        repeatability: float = 0.025,
        tint: float = 0.01,
        shift: float = 1.0,
        relaxation: float = 0.2,
        creep: float = 0.1,
        distance: float = 24.0,
    ) -> None:
        if method not in ("noise", "colour"):
            raise ValueError(f"method: required 'noise' or 'colour', got {method!r}")
        if not 0 < false_alarms < 1:
            raise ValueError(f"false_alarms: required in (0, 1), got {false_alarms}")
        if not 0 <= repeatability <= 1:
            raise ValueError(f"repeatability: required in [0, 1], got {repeatability}")
        if not 0 <= tint <= 1:
            raise ValueError(f"tint: required in [0, 1], got {tint}")
        if not (shift >= 0 and math.isfinite(shift)):
            raise ValueError(f"shift: required >= 0 px, got {shift}")
        if not 0 <= relaxation < 1:
            raise ValueError(f"relaxation: required in [0, 1), got {relaxation}")
        if not 0 <= creep <= 1:
            raise ValueError(f"creep: required in [0, 1], got {creep}")
        if not (distance > 0 and math.isfinite(distance)):
            raise ValueError(f"distance: required > 0 grey levels, got {distance}")
        self._method = method
        self._false_alarms = false_alarms
        self._repeatability = repeatability
        self._tint = min(tint, repeatability)
        self._shift = shift
        self._relaxation = relaxation
        self._creep = creep
        self._distance = distance
        if method == "noise":
            compiled.load(background_kernels, downsample, contact_outline_kernels)
        self.reset()

    def reset(self) -> None:
        """Forget the reference."""
        self._last: NDArray[np.uint8] | None = None
        self._gel: UntouchedGel | None = None
        self._before: NDArray[np.bool_] | None = None
        self._limits: dict[int, float] = {}
        self._strongest = self._strongest_wide = 0.0
        self._evidence: Float | None = None
        self._suspected: NDArray[np.bool_] | None = None
        self._outline: NDArray[np.uint8] | None = None

    @property
    def has_reference(self) -> bool:
        """Whether a frame of the untouched gel is known."""
        return self._last is not None

    def add_reference(self, image: NDArray[np.uint8]) -> None:
        """Learn from a frame of the untouched gel; the more, the better the noise is known.

        image : (H, W, 3) uint8, BGR grey levels, without markers. Raises ValueError if it is not of that
        kind, or not of the size of the frames before.
        """
        self._check(image)
        if self._method != "noise":
            self._last = image.copy()
            return
        if self._gel is None:
            self._gel = UntouchedGel(image, self._repeatability, self._tint, self._shift)
        else:
            self._gel.add(image)
        self._last = image

    def detect(self, image: NDArray[np.uint8], hidden: NDArray[np.uint8] | None = None) -> ContactResult:
        """Compare a frame with the untouched gel.

        image : (H, W, 3) uint8, BGR grey levels, without markers, of the reference's size.
        hidden : (H, W) uint8, not 0 where a marker was removed (`noise` only). There the outline follows what
            is seen to both sides. None: what was painted there is taken for seen.
        Raises ValueError if they are not of that kind, or without a reference.
        """
        self._check(image)
        if hidden is not None and (hidden.shape != image.shape[:2] or hidden.dtype != np.uint8):
            raise ValueError(
                f"required a uint8 mask of shape {image.shape[:2]}, got shape {hidden.shape}, "
                f"dtype {hidden.dtype}"
            )
        if self._last is None:
            raise ValueError("required a reference frame first: call add_reference")
        if self._method == "colour":
            return _colour_distance(image, self._last, self._distance)
        return self._against_noise(image, hidden)

    def _check(self, image: NDArray[np.uint8]) -> None:
        if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or image.size == 0:
            raise ValueError(
                f"required a non-empty (H, W, 3) uint8 image, got shape {image.shape}, dtype {image.dtype}"
            )
        if self._last is not None and image.shape != self._last.shape:
            raise ValueError(f"required the reference's shape {self._last.shape}, got {image.shape}")

    def _against_noise(self, image: NDArray[np.uint8], hidden: NDArray[np.uint8] | None) -> ContactResult:
        assert self._gel is not None
        before, self._before = self._before, None
        change = self._gel.compare(image, before, self._evidence)
        square, colour, evidence, left = change.square, change.colour, change.evidence, change.left
        largest, largest_colour = change.largest, change.largest_colour
        strength = math.sqrt(max(largest, largest_colour))
        self._evidence = evidence
        blobs = self._clear(square, largest, before, left)
        clear = bool(blobs)
        if clear:
            self._suspected = None
        else:
            blobs = self._faint(colour, evidence, before, left)
        self._strongest = max(self._strongest * _FADE, largest if blobs else 0.0)
        self._strongest_wide = max(self._strongest_wide * _SLOW_FADE, largest_colour if blobs else 0.0)
        if not blobs:
            self._outline = None
            return ContactResult(np.zeros(image.shape[:2], np.uint8), False, strength)
        self._before = _union(blobs, square.shape)
        if not clear and left < 1 - self._creep and self._outline is not None:
            return ContactResult(self._outline.copy(), True, strength)
        mask = np.zeros(image.shape[:2], np.uint8)
        for rows, columns, inside in blobs:
            top, start = CELL * rows.start, CELL * columns.start
            lengths = self._gel.lengths(change, rows, columns, inside)
            below = None if hidden is None else hidden_cells(hidden, top, start, inside)
            fill_level(outline_level(lengths, _BRIDGE / 2, below), top, start, mask)
        self._outline = mask if cv2.countNonZero(mask) else None
        return ContactResult(mask, self._outline is not None, strength)

    def _clear(
        self, square: Float, largest: float, before: NDArray[np.bool_] | None, left: float
    ) -> list[_Blob]:
        """Contact by the size of the change, so that its outline can be seen.

        largest : value of `square`. before : cells in contact in the frame before. left : part of the change
        there that is left.
        """
        limit, remembered = self._limit(square.size), self._relaxation**2 * self._strongest
        start, stay = max(limit, remembered), limit * _LEAVE**2
        if not self._relaxation < left < 1 - self._creep:
            stay = max(stay, remembered)
        if largest < (start if before is None else stay):
            return []
        return _blobs(square, limit / 4, start, stay, before)

    def _faint(
        self, colour: Float, evidence: Float, before: NDArray[np.bool_] | None, left: float
    ) -> list[_Blob]:
        """Contact by the extent of a change of colour, in two frames; or one that fades while it is lifted.

        before, left : as for `_clear`.
        """
        suspected, self._suspected = self._suspected, None
        if left <= _GONE:
            return []
        fading = left < 1 - self._creep
        belongs = _wide_change(colour, self._extent(colour.size))
        if belongs is not None:
            if not fading and colour[belongs].max() < self._relaxation**2 * self._strongest_wide:
                belongs = None
            self._suspected = belongs
        if before is None:
            # One frame may be a flash, a cable's shadow, a damaged picture.
            if belongs is None or suspected is None or not (belongs & suspected).any():
                return []
        elif fading and evidence[before].max() >= self._limit(colour.size) * _LEAVE**2:
            belongs = before if belongs is None else before | belongs
        if belongs is None:
            return []
        return _blobs(evidence, self._limit(colour.size) / 4, math.inf, 0.0, belongs)

    def _extent(self, cells: int) -> float:
        """Cells that a change of colour covers which is contact for its extent."""
        return max(_WIDE * cells, _CLUSTER * math.log(cells / self._false_alarms))

    def _limit(self, cells: int) -> float:
        if cells not in self._limits:
            self._limits[cells] = chi_square_threshold(self._false_alarms / cells)
        return self._limits[cells]


_Blob = tuple[slice, slice, NDArray[np.bool_]]


def _union(blobs: list[_Blob], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """(h, w) bool: cells of all blobs."""
    cells = np.zeros(shape, np.bool_)
    for rows, columns, inside in blobs:
        cells[rows, columns] |= inside
    return cells


def _wide_change(colour: Float, extent: float) -> NDArray[np.bool_] | None:
    """(h, w) bool: cells of connected changes of colour that cover `extent` cells at least; None: no such."""
    changed = (colour > _TINTED).view(np.uint8)
    if cv2.countNonZero(changed) < extent:
        return None
    _, labels, stats, _ = cv2.connectedComponentsWithStats(changed, connectivity=8)
    wide = stats[:, cv2.CC_STAT_AREA] >= extent
    wide[0] = False
    return np.asarray(wide[labels], np.bool_) if wide.any() else None


def _closed_changes(square: Float, weak: float) -> NDArray[np.uint8]:
    """(h, w) uint8: 1 where a squared deviation is above `weak`, after closing by 3 x 3 cells, else 0."""
    if compiled.active():
        closed = np.empty(square.shape, np.uint8)
        background_kernels.close_changes(square, weak, closed)
        return closed
    above = (square > weak).view(np.uint8)
    return np.asarray(cv2.morphologyEx(above, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8)), np.uint8)


def _blobs(
    square: Float, weak: float, start: float, stay: float, before: NDArray[np.bool_] | None
) -> list[_Blob]:
    """Connected changes that are contact: rows and columns of a window of cells, and which of them belong.

    square : (h, w) float32, squared deviations. weak : belongs to a contact if connected to it. start : makes
    a new contact. stay : keeps one. before : the cells that were in contact in the frame before.
    """
    changed = _closed_changes(square, weak)
    outlines, _ = cv2.findContours(changed, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    height, width = square.shape
    least = min(_LEAST, square.size // 4)
    found: list[_Blob] = []
    for outline in outlines:
        left, top, wide, high = cv2.boundingRect(outline)
        if wide * high < least:
            continue
        rows = slice(max(top - 1, 0), min(top + high + 1, height))
        columns = slice(max(left - 1, 0), min(left + wide + 1, width))
        inside = np.zeros((rows.stop - rows.start, columns.stop - columns.start), np.uint8)
        cv2.drawContours(inside, [outline], 0, 1, cv2.FILLED, offset=(-columns.start, -rows.start))
        inside &= changed[rows, columns]
        area = cv2.countNonZero(inside)
        if area < least:
            continue
        belongs = inside.view(np.bool_)
        peak = cv2.minMaxLoc(square[rows, columns], inside)[1]
        stays = before is not None and peak >= stay and bool((before[rows, columns] & belongs).any())
        if peak >= start or stays:
            found.append((rows, columns, belongs))
    if len(found) < 2:
        return found
    energies = [float(square[rows, columns][belongs].sum()) for rows, columns, belongs in found]
    order = sorted(range(len(found)), key=lambda index: -energies[index])
    return [found[index] for index in order[:_BLOBS] if energies[index] >= _WEAK * energies[order[0]]]


def _colour_distance(
    image: NDArray[np.uint8], reference: NDArray[np.uint8], distance: float
) -> ContactResult:
    change = cv2.blur(cv2.absdiff(image, reference), (5, 5)).astype(np.float32)
    squared = np.einsum("ijk,ijk->ij", change, change)
    mask = np.where(squared > distance**2, 255, 0).astype(np.uint8)
    mask = np.asarray(cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((7, 7), np.uint8)), np.uint8)
    return ContactResult(mask, bool(mask.any()))
