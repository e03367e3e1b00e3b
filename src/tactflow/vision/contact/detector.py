"""Contact detection: comparison of a frame with frames of the untouched gel.

The detector first asks *whether* anything touches, by a test against the sensor's own noise at a stated rate
of false alarms, and then *where*, by a rule that does not depend on the noise:

1. Frames are compared as means over cells of 4 x 4 px, lightly smoothed (`background`).
2. A smooth change of the illumination over the whole frame is fitted robustly and removed.
3. The residual, divided by its standard deviation, is chi-square distributed with three degrees of freedom
   where nothing touches. One threshold, corrected for the number of cells, decides whether anything does.
4. Changes of colour alone are tested as well: lamps flicker and shadows fall in brightness, hardly in colour.
   A fainter change of colour is a contact if it is wide, which noise and compression blocks are not. A gray
   camera has no colour; there the light minus its mean nearby takes its place, because the light of lamps
   changes more smoothly than that of contacts.
5. Where lamps have different colours, a change that a loss of light explains is dirt or a shadow (`dirt`).
6. A contact ends at the noise level, or at a fraction of the strongest recent change, because a released gel
   creeps back. While it fades faster than by creep, it is still being unloaded and has not ended.
7. The shape of the gel gives the contact region (`heights`, `level_lines`), and the outline is found there at
   half resolution (`contact_outline`).

References
----------
T. Aach, A. Kaup, R. Mester, "Statistical model-based change detection in moving video", Signal Processing 31
(1993), for the test; K. Friston et al., "Assessing the significance of focal activations using their spatial
extent", Human Brain Mapping 1 (1994), for the test by extent. The other files name their own sources.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import special

from tactflow.vision.arrays import Flags, Floats32, check_color_image, check_mask
from tactflow.vision.contact.background import CELL_PX, BackgroundModel, Change
from tactflow.vision.contact.components import MIN_CELLS, contact_cells, wide_change
from tactflow.vision.contact.contact_outline import (
    BORDER_SLOPE_FRACTION,
    CORE_SLOPE_FRACTION,
    change_over_maximum,
    contact_level,
    draw_level,
)
from tactflow.vision.contact.dirt import attenuated_cells
from tactflow.vision.contact.heights import HeightModel
from tactflow.vision.contact.level_lines import ContactFinder

LOW_THRESHOLD_FRACTION: Final = 0.25
"""Low hysteresis threshold, as a fraction of the detection threshold on squared deviations: half of it in
standard deviations. Chosen by hand."""
HELD_THRESHOLD_FRACTION: Final = 0.7
"""Threshold for an existing contact, as a fraction of the detection threshold in standard deviations. Chosen
by hand."""
DECAY_PER_FRAME: Final = 0.98
"""Decay of the strongest recent change per frame: it halves in 34 frames. Chosen by hand."""
MIN_WIDE_COLOUR_SHARE: Final = 0.01
"""Minimum area of a wide change of colour, as a fraction of the picture: more than compression noise, which
comes in blocks of 16 px of the camera (4 cells without contact where 48 would be contact). Light is
compressed in blocks of 8 px, less than the other minimum."""
CELLS_PER_LOG_RATE: Final = 0.7
"""Increase of the minimum area of a wide change, in cells, for each factor of e in the rate of false alarms:
measured on white noise, smoothed as the cells are."""
ENDED_FRACTION: Final = 0.5
"""A faint change that falls below this fraction of itself within one frame has ended. Chosen by hand."""


@dataclass(frozen=True, slots=True)
class ContactResult:
    """Where a frame shows contact.

    Attributes
    ----------
    mask : (H, W) uint8, 255 in contact, else 0: within the outer edge of the imprint.
    touching : whether any pixel is in contact.
    strength : largest change anywhere, in standard deviations of the untouched gel.
    deviations : (2, h, w) float32, squared changes of each cell that belongs to a contact, of its light and
        of its colour alone, in variances of the untouched gel; 0 elsewhere. The second is that of the light
        minus its mean nearby on a gray camera, and the same as the first where all channels of a colour
        camera change alike. None without contact.
    core : (H, W) uint8, 255 where the gel clings to the object, inside the mask; 0 where that is not known.
        None without contact.
    """

    mask: NDArray[np.uint8]
    touching: bool
    strength: float
    deviations: Floats32 | None = None
    core: NDArray[np.uint8] | None = None


@lru_cache(maxsize=16)
def chi_square_threshold(probability: float) -> float:
    """Value that a chi-square variable with three degrees of freedom exceeds with a probability in (0, 1).

    >>> round(chi_square_threshold(0.05), 3)
    7.815
    """
    if not 0 < probability < 1:
        raise ValueError(f"required a probability in (0, 1), got {probability}")
    return float(2 * special.gammainccinv(1.5, probability))


class ContactDetector:
    """Finds where a gel is touched, by comparison with frames of the untouched gel.

    Computed in float32; against float64 the outline moves by at most 1 px, the strength by 1e-5 of itself.

    Parameters
    ----------
    false_alarms : expected number of frames of the untouched gel that are called contact, per frame, in
        (0, 1). Lower misses lighter contacts.
    repeatability : local variation of the light on the untouched gel beyond noise, as a fraction of the
        brightness, 0..1. Higher misses lighter contacts.
    tint : the same for colour, if smaller than `repeatability`, 0..1: how much the channels vary against each
        other, or on a gray camera the light against that nearby. Higher finds soft contacts later on gels
        that respond with colour; lower detects compression blocks.
    shift : distance by which the untouched gel may move against the camera, px. It makes sharp edges in the
        picture count less.
    relaxation : fraction of the strongest recent change that a gel may still show after release, in [0, 1):
        soft gels creep back within a second or so. Higher ends a contact earlier while it is lifted.
    creep : largest fraction of its change that a released gel loses from one frame to the next, 0..1. A
        change that fades faster, but not to `relaxation` at once, is a contact being lifted. Higher ends a
        contact earlier.
    border : slope at the outline as a fraction of its largest nearby, in (0, 1). Higher draws it further in.
    core : the same at the border of the core; at least `border`.

    Raises
    ------
    ValueError : a parameter out of its range.

    Examples
    --------
    >>> import numpy as np
    >>> gel = np.full((64, 48, 3), 120, np.uint8)
    >>> pressed = gel.copy()
    >>> pressed[20:40, 20:40] = 180
    >>> detector = ContactDetector()
    >>> detector.add_reference(gel)
    >>> detector.detect(gel).touching, detector.detect(pressed).touching
    (False, True)
    """

    def __init__(
        self,
        *,
        false_alarms: float = 1e-6,
        repeatability: float = 0.025,
        tint: float = 0.01,
        shift: float = 1.0,
        relaxation: float = 0.2,
        creep: float = 0.1,
        border: float = BORDER_SLOPE_FRACTION,
        core: float = CORE_SLOPE_FRACTION,
    ) -> None:
        for name, value in {"false_alarms": false_alarms, "border": border, "core": core}.items():
            if not 0 < value < 1:
                raise ValueError(f"{name}: required in (0, 1), got {value}")
        for name, value in {"repeatability": repeatability, "tint": tint, "creep": creep}.items():
            if not 0 <= value <= 1:
                raise ValueError(f"{name}: required in [0, 1], got {value}")
        if not (shift >= 0 and math.isfinite(shift)):
            raise ValueError(f"shift: required >= 0 px, got {shift}")
        if not 0 <= relaxation < 1:
            raise ValueError(f"relaxation: required in [0, 1), got {relaxation}")
        self._false_alarms = false_alarms
        self._steadiness = repeatability, min(tint, repeatability), shift
        self._relaxation, self._creep = relaxation, creep
        self._borders = border, max(border, core)
        self.reset()

    def reset(self) -> None:
        """Forget the reference."""
        self._background: BackgroundModel | None = None
        self._shape: tuple[int, ...] = ()
        self._gel: NDArray[np.uint8] | None = None
        self._before: Floats32 | None = None
        self._strongest = self._strongest_wide = 0.0
        self._suspected: Flags | None = None
        self._masks: tuple[NDArray[np.uint8], NDArray[np.uint8]] | None = None
        self._heights, self._contacts = HeightModel(), ContactFinder()

    @property
    def has_reference(self) -> bool:
        """Whether a frame of the untouched gel is known."""
        return self._background is not None

    def add_reference(self, image: NDArray[np.uint8], valid: NDArray[np.uint8] | None = None) -> None:
        """Learn from a frame of the untouched gel; more frames estimate the noise better.

        image : (H, W, 3) uint8, BGR grey levels, without markers.
        valid : (H, W) uint8, 0 where the picture shows no gel, and so no contact either; that of the first
            frame holds. None: gel is everywhere.
        Raises ValueError if an array has another type or shape, or another size than earlier frames.
        """
        self._check(image)
        if valid is not None:
            check_mask(valid, image.shape[:2], "valid")
        if self._background is not None:
            self._background.add(image)
            return
        self._shape = image.shape
        self._background = BackgroundModel(image, *self._steadiness, valid)
        if valid is not None and not valid.all():
            self._gel = np.asarray((valid > 0) * np.uint8(255))

    def detect(self, image: NDArray[np.uint8]) -> ContactResult:
        """Compare a frame with the untouched gel.

        image : (H, W, 3) uint8, BGR grey levels, without markers, of the reference's size.
        Raises ValueError if the image has another type or size, or if there is no reference yet.
        """
        self._check(image)
        if self._background is None:
            raise ValueError("required a reference frame first: call add_reference")
        change = self._background.compare(image, self._before)
        before, self._before = None if self._before is None else self._before > 0, None
        strength = math.sqrt(max(change.largest, change.largest_colour))
        found = self._clear(change, before)
        if found is not None and self._background.colours is not None:
            dirt = attenuated_cells(change.cells, self._background.colours, found)
            if dirt is not None:
                change = change.without(dirt)
                found = self._clear(change, before)
        faint = found is None
        if found is None:
            found = self._faint(change, before)
        else:
            self._suspected = None
        largest, widest = (0.0, 0.0) if found is None else (change.largest, change.largest_colour)
        self._strongest = max(self._strongest * DECAY_PER_FRAME, largest)
        self._strongest_wide = max(self._strongest_wide * DECAY_PER_FRAME, widest)
        if found is None:
            self._masks = None
            return ContactResult(np.zeros(image.shape[:2], np.uint8), False, strength)
        if self._masks is not None and faint and change.remaining < 1 - self._creep:
            mask, core = (kept.copy() for kept in self._masks)
        else:
            mask, core = self._masks = self._outlined(change, found, image.shape[:2])
        deviations = change.deviations * found
        self._before = deviations[2]
        if self._heights.alike and not self._background.gray:
            # Under white lamps a contact has no colour: what would be its change is that of the light.
            deviations[1] = deviations[0]
        return ContactResult(mask, True, strength, deviations[:2], core)

    def _check(self, image: NDArray[np.uint8]) -> None:
        check_color_image(image)
        if self._background is not None and image.shape != self._shape:
            raise ValueError(f"required the reference's shape {self._shape}, got {image.shape}")

    def _outlined(
        self, change: Change, changed: Flags, shape: tuple[int, ...]
    ) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """Contact mask (H, W) of a change, and its core: the outlined regions, or the changed cells without a
        core if none is found."""
        assert self._background is not None
        heights = self._heights(change.cells)
        mask, inner = np.zeros((2, *shape), np.uint8)
        regions = self._contacts(heights, changed)
        for rows, columns, inside, *cores in regions:
            if change.dirt is not None:
                inside &= ~change.dirt[rows, columns]
            if heights.slopes is None:
                window = self._background.window_change(change, rows, columns, inside, heights.mixtures)
            else:
                slopes = heights.slopes[:, rows, columns] * inside
                window = np.stack([cv2.resize(plane, None, fx=2, fy=2) for plane in slopes])
            shown = change_over_maximum(window)
            for border, surely, drawn in zip(self._borders, cores, (mask, inner), strict=True):
                level = contact_level(shown, surely, border)
                draw_level(level, CELL_PX * rows.start, CELL_PX * columns.start, drawn)
        if not regions:
            draw_level(np.asarray(cv2.resize(changed - np.float32(0.5), None, fx=2, fy=2)), 0, 0, mask)
        # Cells reach beyond the gel.
        return (mask, inner) if self._gel is None else (mask & self._gel, inner & self._gel)

    def _clear(self, change: Change, before: Flags | None) -> Flags | None:
        """Cells (h, w) in contact by the size of their change, or None.

        before : cells in contact in the previous frame.
        """
        squared = change.deviations[0]
        limit, remembered = self._limit(squared.size), self._relaxation**2 * self._strongest
        start, stay = max(limit, remembered), limit * HELD_THRESHOLD_FRACTION**2
        if not self._relaxation < change.remaining < 1 - self._creep:
            stay = max(stay, remembered)
        if change.largest < (start if before is None else stay):
            return None
        return _contact_cells(squared, limit, start, stay, before)

    def _faint(self, change: Change, before: Flags | None) -> Flags | None:
        """Cells (h, w) in contact by the extent of a change of colour in two frames, or that fade while being
        lifted; or None.

        before : as for `_clear`.
        """
        suspected, self._suspected = self._suspected, None
        if change.remaining <= ENDED_FRACTION:
            return None
        fading = change.remaining < 1 - self._creep
        _, colour, evidence = change.deviations
        limit = self._limit(colour.size)
        belongs = wide_change(colour, self._extent(colour.size))
        if belongs is not None:
            remembered = self._relaxation**2 * self._strongest_wide
            if not fading and colour[belongs].max() < remembered:
                belongs = None
            self._suspected = belongs
        if before is None:
            # One frame may be a flash, a cable's shadow, a damaged picture.
            if belongs is None or suspected is None or not (belongs & suspected).any():
                return None
        elif fading and evidence[before].max() >= limit * HELD_THRESHOLD_FRACTION**2:
            belongs = before if belongs is None else before | belongs
        if belongs is None:
            return None
        return _contact_cells(evidence, limit, math.inf, 0.0, belongs)

    def _extent(self, cells: int) -> float:
        """Number of cells from which a faint change of colour is a contact."""
        assert self._background is not None
        share = 0.0 if self._background.gray else MIN_WIDE_COLOUR_SHARE
        return max(share * cells, CELLS_PER_LOG_RATE * math.log(cells / self._false_alarms))

    def _limit(self, cells: int) -> float:
        """Detection threshold on squared deviations, corrected for the number of cells."""
        return chi_square_threshold(self._false_alarms / cells)


def _contact_cells(
    squared: Floats32, limit: float, start: float, stay: float, before: Flags | None
) -> Flags | None:
    """Cells (h, w) in contact, or None if there are none; limit : detection threshold, others as for
    `contact_cells`."""
    found = np.empty(squared.shape, np.bool_)
    last, least = np.zeros_like(found) if before is None else before, min(MIN_CELLS, found.size // 4)
    count = contact_cells(squared, LOW_THRESHOLD_FRACTION * limit, start, stay, last, least, found)
    return found if count else None
