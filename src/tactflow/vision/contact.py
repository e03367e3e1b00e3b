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
theirs. Seed function `difference`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.imprint import imprint
from tactflow.vision.light import LightChange, light_change
from tactflow.vision.marker_mask import halved_mask
from tactflow.vision.seed_contact import seed_contact_mask

ContactMethod = Literal["noise", "colour", "seed"]
Float = NDArray[np.float32]

_CELL = 4
"""Side of a cell, px: averages 16 pixels, so that noise of 2 grey levels is half a level."""
_PRIOR = 8
"""Number of frames that the noise guessed from the first frame's own grain counts for."""
_QUANTISATION = 12**-0.5
"""Standard deviation of rounding to whole grey levels."""
_LEVELS = 6
"""Ranges of brightness for which noise is guessed separately (shot noise grows with the light)."""
_CORRELATED = 2.0
"""How much less than white noise the guessed noise shrinks by smoothing: demosaicing and video compression
leave little noise between neighbours, and more over distances."""
_DARK = 0.1
"""Part of the mean brightness that is added before changes are taken relative to the brightness."""
_SHARP = 0.05
"""Relative change by which an edge, moved by `shift`, begins to count less for the outline."""
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


@dataclass(frozen=True, slots=True)
class _Reference:
    """The untouched gel: (h, w, 3) float32 at a quarter, (2h, 2w, 3) at half resolution."""

    mean: Float
    shade: Float
    weight: Float
    sharper: Float
    grey: Float
    light: LightChange
    half: Float
    half_shade: Float
    half_scale: Float


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
        colours with a fixed threshold. `seed` is the original rule: brighter in all channels.
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
        if method not in ("noise", "colour", "seed"):
            raise ValueError(f"method: required 'noise', 'colour' or 'seed', got {method!r}")
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
        self._count = 0
        self._mean: Float | None = None
        self._half: Float | None = None
        self._squares: Float | None = None
        self._noise: Float | None = None
        self._known: _Reference | None = None
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
        half, cells = _cells(image)
        smooth = np.asarray(cv2.blur(cells, (3, 3)), np.float32)
        if self._mean is None or self._half is None or self._squares is None:
            self._mean, self._half = smooth, half.astype(np.float32)
            self._squares = np.zeros_like(smooth)
            self._noise = _spatial_noise(cells)
        else:
            known = self._reference()
            change = self._change(smooth, known)[0]
            self._squares = self._squares + change * change * np.float32(self._count / (self._count + 1))
            self._mean = self._mean + change / np.float32(self._count + 1)
            self._half = self._half + (half - self._half) / np.float32(self._count + 1)
        self._count += 1
        self._last = image
        self._known = None

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
        if self._method == "seed":
            mask = seed_contact_mask(image, self._last)
            return ContactResult(mask, bool(mask.any()))
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

    def _reference(self) -> _Reference:
        if self._known is not None:
            return self._known
        assert self._mean is not None
        assert self._half is not None
        assert self._squares is not None
        assert self._noise is not None
        mean, count = self._mean, self._count
        variance = (_PRIOR * self._noise**2 + self._squares) / (_PRIOR + count - 1)
        steady = variance * (1 + 1 / count) + (self._shift / _CELL * _steepness(mean)) ** 2
        variance = steady + (self._repeatability * mean) ** 2
        light = LightChange(mean, np.asarray(variance, np.float32))
        weight = 1 / np.sqrt(variance)
        # One factor for all channels, so that a change in proportion to the brightness is none of colour.
        sharper = (variance / (steady + (self._tint * mean) ** 2)).min(axis=2)
        grey = mean * weight
        grey /= np.linalg.norm(grey, axis=2, keepdims=True) + np.float32(1e-6)
        dark = _DARK * self._half.mean(axis=(0, 1)) + 1
        edge = self._shift / 2 * _steepness(self._half) / (_SHARP * (self._half + dark))
        self._known = _Reference(
            mean=mean,
            shade=light.shade(mean),
            weight=np.asarray(weight, np.float32),
            sharper=np.asarray(sharper, np.float32),
            grey=np.asarray(grey * weight * np.sqrt(sharper)[..., None], np.float32),
            light=light,
            half=self._half,
            half_shade=light.shade(self._half),
            half_scale=np.asarray(1 / ((self._half + dark) * np.sqrt(1 + edge**2)), np.float32),
        )
        return self._known

    def _change(self, smooth: Float, known: _Reference) -> tuple[Float, Float]:
        """Cells minus reference minus the light's change, and the latter's coefficients."""
        found = known.light.fit(smooth)
        expected = light_change(found, known.shade, slice(None), slice(None))
        expected += known.mean
        return np.subtract(smooth, expected, out=expected), found

    def _against_noise(self, image: NDArray[np.uint8], hidden: NDArray[np.uint8] | None) -> ContactResult:
        known = self._reference()
        half, cells = _cells(image)
        change, found = self._change(np.asarray(cv2.blur(cells, (3, 3)), np.float32), known)
        square = _squared_length(change * known.weight)
        colour = _colour_change(change, square, known)
        evidence = np.maximum(square, colour)
        largest, largest_colour = cv2.minMaxLoc(square)[1], cv2.minMaxLoc(colour)[1]
        strength = math.sqrt(max(largest, largest_colour))
        before, self._before = self._before, None
        left = 1.0 if before is None else self._left(evidence, before)
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
        mask = np.zeros((cells.shape[0] * _CELL, cells.shape[1] * _CELL), np.uint8)
        for rows, columns, inside in blobs:
            level = _level(half, found, known, rows, columns, inside, hidden)
            large = cv2.resize(level, None, fx=2, fy=2, interpolation=cv2.INTER_LINEAR)
            window = mask[
                _CELL * rows.start : _CELL * rows.stop, _CELL * columns.start : _CELL * columns.stop
            ]
            window |= np.asarray(cv2.compare(large, np.zeros(1), cv2.CMP_GT), np.uint8)
        mask = np.ascontiguousarray(mask[: image.shape[0], : image.shape[1]])
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

    def _left(self, evidence: Float, before: NDArray[np.bool_]) -> float:
        """Part of the change of the frame before that is left where that showed contact."""
        if self._evidence is None:
            return 1.0
        inside = before.astype(np.float32).ravel()
        now, then = float(inside @ evidence.ravel()), float(inside @ self._evidence.ravel())
        return math.sqrt(now / then) if then > 0 else 1.0

    def _extent(self, cells: int) -> float:
        """Cells that a change of colour covers which is contact for its extent."""
        return max(_WIDE * cells, _CLUSTER * math.log(cells / self._false_alarms))

    def _limit(self, cells: int) -> float:
        if cells not in self._limits:
            self._limits[cells] = chi_square_threshold(self._false_alarms / cells)
        return self._limits[cells]


_Blob = tuple[slice, slice, NDArray[np.bool_]]


def _level(
    half: NDArray[np.uint8],
    found: Float,
    known: _Reference,
    rows: slice,
    columns: slice,
    inside: NDArray[np.bool_],
    hidden: NDArray[np.uint8] | None,
) -> Float:
    """Level set of one contact's outline, at half resolution, over a window given in cells."""
    fine = slice(2 * rows.start, 2 * rows.stop), slice(2 * columns.start, 2 * columns.stop)
    answer = np.asarray(cv2.subtract(half[fine], known.half[fine], dtype=cv2.CV_32F), np.float32)
    expected = light_change(found, known.half_shade, *fine)
    answer -= expected
    answer *= known.half_scale[fine]
    answer = np.asarray(cv2.GaussianBlur(answer, (3, 3), 0.8, dst=expected), np.float32)
    size = (2 * inside.shape[1], 2 * inside.shape[0])
    belongs = cv2.resize(inside.view(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    below = None if hidden is None else _halved_mask(hidden, rows, columns)
    return imprint(answer, np.asarray(belongs, np.uint8), _BRIDGE / 2, below)


def _halved_mask(mask: NDArray[np.uint8], rows: slice, columns: slice) -> NDArray[np.uint8]:
    """A window, given in cells, of a mask at half resolution: 1 where any pixel is not 0, else 0."""
    part = mask[_CELL * rows.start : _CELL * rows.stop, _CELL * columns.start : _CELL * columns.stop]
    high, wide = _CELL * (rows.stop - rows.start), _CELL * (columns.stop - columns.start)
    if part.shape != (high, wide):
        below, beside = high - part.shape[0], wide - part.shape[1]
        part = np.asarray(cv2.copyMakeBorder(part, 0, below, 0, beside, cv2.BORDER_CONSTANT), np.uint8)
    return np.asarray(halved_mask(part) & np.uint8(1), np.uint8)


def _squared_length(vectors: Float) -> Float:
    """(h, w) float32: sum over the three channels of the squares of (h, w, 3) float32, which are lost."""
    vectors *= vectors
    return np.asarray(cv2.transform(vectors, np.ones((1, 3), np.float32)), np.float32)


def _union(blobs: list[_Blob], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """(h, w) bool: cells of all blobs."""
    cells = np.zeros(shape, np.bool_)
    for rows, columns, inside in blobs:
        cells[rows, columns] |= inside
    return cells


def _colour_change(change: Float, square: Float, known: _Reference) -> Float:
    """(h, w) float32: squared deviation of the colour, chi-square with two degrees of freedom: without the
    part of the change in which all channels go along with the brightness.

    change : (h, w, 3) float32, grey levels. square : (h, w) float32, its squared deviation.
    """
    along = np.asarray(cv2.transform(change * known.grey, np.ones((1, 3), np.float32)), np.float32)
    along *= along
    return np.asarray(cv2.subtract(square * known.sharper, along, dst=along), np.float32)


def _wide_change(colour: Float, extent: float) -> NDArray[np.bool_] | None:
    """(h, w) bool: cells of connected changes of colour that cover `extent` cells at least; None: no such."""
    changed = (colour > _TINTED).view(np.uint8)
    if cv2.countNonZero(changed) < extent:
        return None
    _, labels, stats, _ = cv2.connectedComponentsWithStats(changed, connectivity=8)
    wide = stats[:, cv2.CC_STAT_AREA] >= extent
    wide[0] = False
    return np.asarray(wide[labels], np.bool_) if wide.any() else None


def _blobs(
    square: Float, weak: float, start: float, stay: float, before: NDArray[np.bool_] | None
) -> list[_Blob]:
    """Connected changes that are contact: rows and columns of a window of cells, and which of them belong.

    square : (h, w) float32, squared deviations. weak : belongs to a contact if connected to it. start : makes
    a new contact. stay : keeps one. before : the cells that were in contact in the frame before.
    """
    changed = np.asarray(
        cv2.morphologyEx((square > weak).view(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8)), np.uint8
    )
    outlines, _ = cv2.findContours(changed, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    height, width = square.shape
    least = min(_LEAST, square.size // 4)
    found: list[tuple[float, _Blob]] = []
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
            energy = cv2.mean(square[rows, columns], inside)[0] * area
            found.append((energy, (rows, columns, belongs)))
    found.sort(key=lambda entry: -entry[0])
    return [blob for energy, blob in found[:_BLOBS] if energy >= _WEAK * found[0][0]]


def _cells(image: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], Float]:
    """Means over 2 x 2 px, uint8, and over 4 x 4 px, float32; the border is repeated to make whole cells."""
    bottom, right = -image.shape[0] % _CELL, -image.shape[1] % _CELL
    padded = np.ascontiguousarray(image)
    if bottom or right:
        padded = np.asarray(cv2.copyMakeBorder(padded, 0, bottom, 0, right, cv2.BORDER_REPLICATE), np.uint8)
    height, width = padded.shape[:2]
    half = cv2.resize(padded, (width // 2, height // 2), interpolation=cv2.INTER_AREA)
    cells = cv2.resize(half, (width // 4, height // 4), interpolation=cv2.INTER_AREA)
    return np.asarray(half, np.uint8), cells.astype(np.float32)


def _steepness(picture: Float) -> Float:
    """Grey levels per cell by which the brightness changes, here or in the cells around."""
    along = cv2.Scharr(picture, cv2.CV_32F, 1, 0, scale=1 / 32, borderType=cv2.BORDER_REPLICATE)
    across = cv2.Scharr(picture, cv2.CV_32F, 0, 1, scale=1 / 32, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(cv2.dilate(cv2.magnitude(along, across), np.ones((3, 3), np.uint8)), np.float32)


def _spatial_noise(cells: Float) -> Float:
    """Standard deviation of smoothed cells guessed from one frame, as a function of brightness.

    Second differences of neighbouring cells see the noise and hardly the shading; their median is not moved
    by markers. Grain of the gel counts as noise here, which errs on the side of silence.
    """
    noise = np.full_like(cells, _QUANTISATION)
    if cells.shape[1] < 3:
        return noise
    second = np.abs(cells[:, :-2] - 2 * cells[:, 1:-1] + cells[:, 2:]) * np.float32(1.4826 / math.sqrt(6))
    for channel in range(3):
        level = cells[:, 1:-1, channel].ravel()
        order = np.argsort(level)
        parts = [part for part in np.array_split(order, _LEVELS) if part.size]
        center = [float(level[part].mean()) for part in parts]
        spread = [float(np.median(second[..., channel].ravel()[part])) for part in parts]
        noise[..., channel] = np.interp(cells[..., channel], center, spread)
    # Smoothing 3 x 3 would divide by three were the cells independent; demosaicing and compression see to
    # it that they are not quite.
    return np.asarray(np.hypot(noise, _QUANTISATION) * (_CORRELATED / 3), np.float32)


def _colour_distance(
    image: NDArray[np.uint8], reference: NDArray[np.uint8], distance: float
) -> ContactResult:
    change = cv2.blur(cv2.absdiff(image, reference), (5, 5)).astype(np.float32)
    squared = np.einsum("ijk,ijk->ij", change, change)
    mask = np.where(squared > distance**2, 255, 0).astype(np.uint8)
    mask = np.asarray(cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((7, 7), np.uint8)), np.uint8)
    return ContactResult(mask, bool(mask.any()))
