"""Where something touches the gel: comparison with frames of the untouched gel.

The default method first asks *whether*, by a test against the sensor's own noise at a stated rate of false
alarms, and then *where*, by a rule that does not depend on the noise:

1. Frames are compared as means over cells of 4 x 4 px, lightly smoothed (`background`).
2. A change of the illumination that is smooth over the whole frame is fitted robustly and taken out.
3. What is left, divided by its standard deviation, is chi-square distributed with three degrees of freedom
   where nothing touches. One threshold, corrected for the number of cells, says whether anything does.
4. Beside that, changes of colour alone: lamps flicker and shadows fall in brightness, hardly in colour. A
   fainter change of colour is contact if it is wide, which neither noise nor compressed blocks are.
5. Contact ends at the noise, or at a part of the strongest recent change, since a released gel creeps back;
   but not while it fades faster than by creeping: then it is still being unloaded.
6. Where it touches, the shape of the gel tells (`heights`, `level_lines`), and the outline is found there at
   half resolution (`contact_outline`).

References
----------
T. Aach, A. Kaup, R. Mester, "Statistical model-based change detection in moving video", Signal Processing 31
(1993), for the test; K. Friston et al., "Assessing the significance of focal activations using their spatial
extent", Human Brain Mapping 1 (1994), for the test by extent. The other files name the sources of
theirs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import special

from tactflow.vision.arrays import Flags, Floats32, check_color_image
from tactflow.vision.contact.background import CELL, BackgroundModel, Change
from tactflow.vision.contact.components import contact_cells, wide_change
from tactflow.vision.contact.contact_outline import contact_level, draw_level
from tactflow.vision.contact.heights import HeightModel
from tactflow.vision.contact.level_lines import ContactFinder

ContactMethod = Literal["noise", "colour"]

CONNECTED: Final = 0.25
"""Low hysteresis threshold, as a fraction of the detection threshold on squared deviations: half of it in
standard deviations. Chosen by hand."""
STAY: Final = 0.7
"""Part of the threshold, in standard deviations, that is enough to stay in contact. Chosen by hand."""
FORGET: Final = 0.98
"""How fast the strongest recent change is forgotten, per frame: half in 34 frames. Chosen by hand."""
WIDE: Final = 0.01
"""Part of the picture that a wide change covers at least: more than the noise of compression, which comes in
blocks of 16 px of the camera (4 cells without contact where 48 would be contact)."""
CLUSTER: Final = 0.7
"""Cells by which a wide change must be larger for each factor of e in the rate of false alarms: measured on
white noise, smoothed as the cells are."""
GONE: Final = 0.5
"""A faint change of which less remains after a frame no longer has the outline that it had, and is gone.
Chosen by hand."""
COLOUR_BLUR: Final = 5
"""For `colour`: side of the square over which changes are averaged, px. Chosen by hand."""
COLOUR_OPENING: Final = 7
"""For `colour`: side of the smallest square that is contact, px. Chosen by hand."""


@dataclass(frozen=True, slots=True)
class ContactResult:
    """Where a frame shows contact.

    mask : (H, W) uint8, 255 in contact, else 0. touching : whether any pixel is in contact.
    strength : largest change anywhere, in standard deviations of the untouched gel (`noise` only; else 0).
    deviations : (2, h, w) float32, squared changes of each cell that belongs to a contact, of its light and
        of its colour alone, in variances of the untouched gel; 0 elsewhere (`noise` only; else None). Where
        all channels change alike both are the same.
    """

    mask: NDArray[np.uint8]
    touching: bool
    strength: float = 0.0
    deviations: Floats32 | None = None


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
        self.reset()

    def reset(self) -> None:
        """Forget the reference."""
        self._last: NDArray[np.uint8] | None = None
        self._background: BackgroundModel | None = None
        self._gel: NDArray[np.uint8] | None = None
        self._before: Flags | None = None
        self._strongest = self._strongest_wide = 0.0
        self._evidence: Floats32 | None = None
        self._suspected: Flags | None = None
        self._mask: NDArray[np.uint8] | None = None
        self._heights, self._contacts = HeightModel(), ContactFinder()

    @property
    def has_reference(self) -> bool:
        """Whether a frame of the untouched gel is known."""
        return self._last is not None

    def add_reference(self, image: NDArray[np.uint8], valid: NDArray[np.uint8] | None = None) -> None:
        """Learn from a frame of the untouched gel; the more, the better the noise is known.

        image : (H, W, 3) uint8, BGR grey levels, without markers.
        valid : (H, W) uint8, 0 where the picture shows no gel, and so no contact either (`noise` only; that
            of the first frame holds). None: gel is everywhere.
        Raises ValueError if they are not of that kind, or not of the size of the frames before.
        """
        self._check(image)
        _check_mask(valid, image)
        if self._method != "noise":
            self._last = image.copy()
            return
        if self._background is None:
            self._background = BackgroundModel(image, self._repeatability, self._tint, self._shift, valid)
            if valid is not None and not valid.all():
                self._gel = np.asarray((valid > 0) * np.uint8(255))
        else:
            self._background.add(image)
        self._last = image

    def detect(self, image: NDArray[np.uint8]) -> ContactResult:
        """Compare a frame with the untouched gel.

        image : (H, W, 3) uint8, BGR grey levels, without markers, of the reference's size.
        Raises ValueError if it is not of that kind, or without a reference.
        """
        self._check(image)
        if self._last is None:
            raise ValueError("required a reference frame first: call add_reference")
        if self._method == "colour":
            return _colour_distance(image, self._last, self._distance)
        return self._against_noise(image)

    def _check(self, image: NDArray[np.uint8]) -> None:
        check_color_image(image)
        if self._last is not None and image.shape != self._last.shape:
            raise ValueError(f"required the reference's shape {self._last.shape}, got {image.shape}")

    def _against_noise(self, image: NDArray[np.uint8]) -> ContactResult:
        assert self._background is not None
        before, self._before = self._before, None
        change = self._background.compare(image, before, self._evidence)
        self._evidence = change.evidence
        strength = math.sqrt(max(change.largest, change.largest_colour))
        found = self._clear(change, before)
        faint = found is None
        if found is None:
            found = self._faint(change, before)
        else:
            self._suspected = None
        largest, widest = (0.0, 0.0) if found is None else (change.largest, change.largest_colour)
        self._strongest = max(self._strongest * FORGET, largest)
        self._strongest_wide = max(self._strongest_wide * FORGET, widest)
        if found is None:
            self._mask = None
            return ContactResult(np.zeros(image.shape[:2], np.uint8), False, strength)
        self._before = found
        fading = faint and change.remaining < 1 - self._creep and self._mask is not None
        if not fading:
            self._mask = self._outlined(change, image.shape[:2])
        assert self._mask is not None
        mask = self._mask.copy() if fading else self._mask
        # A gray camera sees no colours: a change that is one of colour in others is one of light there.
        colour = change.squared if self._heights.alike else change.colour
        deviations = np.stack([change.squared, colour]) * self._before
        return ContactResult(mask, True, strength, deviations)

    def _outlined(self, change: Change, shape: tuple[int, ...]) -> NDArray[np.uint8]:
        """(H, W): the contacts that a change shows; the cells that have changed, where no shape does."""
        assert self._background is not None
        assert self._before is not None
        heights = self._heights(self._background.signed_change(change))
        mask = np.zeros(shape, np.uint8)
        regions = self._contacts(heights, self._before)
        for rows, columns, inside, core in regions:
            window = self._background.window_change(change, rows, columns, inside)
            surely = core.repeat(2, axis=0).repeat(2, axis=1)
            level = contact_level(window, surely, heights.mixtures)
            draw_level(level, CELL * rows.start, CELL * columns.start, mask)
        if not regions:
            draw_level(self._before - np.float32(0.5), 0, 0, mask, CELL)
        # Cells reach beyond the gel.
        return mask if self._gel is None else mask & self._gel

    def _clear(self, change: Change, before: Flags | None) -> Flags | None:
        """Contact by the size of the change, so that its outline can be seen.

        before : cells in contact in the previous frame.
        """
        limit, remembered = self._limit(change.squared.size), self._relaxation**2 * self._strongest
        start, stay = max(limit, remembered), limit * STAY**2
        if not self._relaxation < change.remaining < 1 - self._creep:
            stay = max(stay, remembered)
        if change.largest < (start if before is None else stay):
            return None
        return contact_cells(change.squared, CONNECTED * limit, start, stay, before)

    def _faint(self, change: Change, before: Flags | None) -> Flags | None:
        """Contact by the extent of a change of colour, in two frames; or one that fades while it is lifted.

        before : as for `_clear`.
        """
        suspected, self._suspected = self._suspected, None
        if change.remaining <= GONE:
            return None
        fading = change.remaining < 1 - self._creep
        limit = self._limit(change.colour.size)
        belongs = wide_change(change.colour, self._extent(change.colour.size))
        if belongs is not None:
            remembered = self._relaxation**2 * self._strongest_wide
            if not fading and change.colour[belongs].max() < remembered:
                belongs = None
            self._suspected = belongs
        if before is None:
            # One frame may be a flash, a cable's shadow, a damaged picture.
            if belongs is None or suspected is None or not (belongs & suspected).any():
                return None
        elif fading and change.evidence[before].max() >= limit * STAY**2:
            belongs = before if belongs is None else before | belongs
        if belongs is None:
            return None
        return contact_cells(change.evidence, CONNECTED * limit, math.inf, 0.0, belongs)

    def _extent(self, cells: int) -> float:
        """Cells that a change of colour covers which is contact for its extent."""
        return max(WIDE * cells, CLUSTER * math.log(cells / self._false_alarms))

    def _limit(self, cells: int) -> float:
        """Squared deviation that chance lets one of so many cells exceed in as many frames as is allowed."""
        return chi_square_threshold(self._false_alarms / cells)


def _check_mask(mask: NDArray[np.uint8] | None, image: NDArray[np.uint8]) -> None:
    if mask is not None and (mask.shape != image.shape[:2] or mask.dtype != np.uint8):
        raise ValueError(
            f"required a uint8 mask of shape {image.shape[:2]}, got shape {mask.shape}, dtype {mask.dtype}"
        )


def _colour_distance(
    image: NDArray[np.uint8], reference: NDArray[np.uint8], distance: float
) -> ContactResult:
    change = cv2.blur(cv2.absdiff(image, reference), (COLOUR_BLUR, COLOUR_BLUR)).astype(np.float32)
    squared = np.einsum("ijk,ijk->ij", change, change)
    mask = np.where(squared > distance**2, 255, 0).astype(np.uint8)
    mask = np.asarray(
        cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((COLOUR_OPENING, COLOUR_OPENING), np.uint8)), np.uint8
    )
    return ContactResult(mask, bool(mask.any()))
