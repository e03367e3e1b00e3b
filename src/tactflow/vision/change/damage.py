"""Pictures that a camera did not take: empty buffers, and frames damaged on their way.

Each row of a picture that a lens has drawn is correlated from pixel to pixel, because the lens blurs it (J.
von Neumann, 1941: the ratio of the squared differences of neighbours to the variance). A row that was never
transmitted is constant, one of other bytes is white noise: neither has a correlated part. A row of which some
bytes were lost is the same as before, but displaced along itself by whole pixels, light and housing included.
A gel that is touched does none of this to a row over its whole width.
"""

from __future__ import annotations

from functools import cached_property
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from tactflow.vision.arrays import Floats32, check_color_image

EXAMINED_ROWS: Final = 48
"""Rows of a picture that are examined: three for each of the 16 lines of a block of JPEG at 800 x 600."""
MIN_RUN_ROWS: Final = 4
"""Minimum number of successive rows of those that are damaged: a twelfth of the picture."""
MAX_CONSTANT_ROW_VARIANCE: Final = 1.0
"""Largest variance of a constant row after compression, squared grey levels."""
MIN_STRUCTURED_ROW_VARIANCE: Final = 9.0
"""Smallest variance of a row whose loss is noticed, squared grey levels: three times
`MAX_CONSTANT_ROW_VARIANCE` in standard deviations."""
NOISE_VON_NEUMANN_RATIO: Final = 0.6
"""Ratio of von Neumann, 1 for white noise, above which no lens has drawn a row. Even white texture has 0.4
behind the sharpest lens, whose blur has a standard deviation of 0.7 px."""
MAX_LAG_PX: Final = 32
"""Largest displacement that is searched, px."""
MIN_LAG_PX: Final = 4
"""Smallest displacement that is damage, px: half a block of JPEG. A gel that is dragged as a whole moves by 2
to 3 px on the recordings."""
MAX_RESIDUAL_NOISE_RATIO: Final = 3.0
"""Largest squared residual of a displaced row, relative to that of noise: bytes are displaced by whole
pixels, while a dragged gel, by any distance, leaves a residual at the edges of its dots."""
MIN_IMPROVEMENT_RATIO: Final = 9.0
"""Ratio of the squared residuals without and with the displacement: three standard deviations of noise."""
PARTS_PER_ROW: Final = 4
MIN_DISPLACED_PARTS: Final = 3
"""Parts of a row, and the number of them that must show the displacement: an object that has moved fills one
or two, or leaves the dots beside it."""
MIN_DISPLACED_ROWS: Final = 6
"""Minimum number of displaced rows: an eighth of the picture."""
MAX_DISPLACED_PICTURES: Final = 30
"""Number of successive displaced pictures after which this is how the camera delivers them."""
SAMPLES_PER_SIDE: Final = 32
"""Points along each side of the picture that decide whether it is examined."""
MIN_CHANGED_SHARE: Final = 0.01
"""Minimum share of these points that changed since the last whole picture. A displacement of the lower half
by 8 px changes 3.4 % in the scene `press`."""
MIN_CHANGE_SIGMAS: Final = 6.0
"""Minimum change of such a point, standard deviations of the noise of one picture: of its difference from
another one, 4.2."""


class _Rows:
    """Some rows of a picture, (n, W, 3) uint8; each property is computed once."""

    def __init__(self, picture: NDArray[np.uint8]) -> None:
        self._rows = picture[_places(picture.shape[0], EXAMINED_ROWS)]

    @cached_property
    def empty(self) -> NDArray[np.bool_]:
        """(n,) whether a row has no correlated part in any channel."""
        flags = np.ones(len(self._rows), np.bool_)
        for channel in (1, 0, 2):
            structure, noise = _variances(self._rows[flags, :, channel])
            limit = np.maximum(
                np.float32(MAX_CONSTANT_ROW_VARIANCE), np.float32(1 / NOISE_VON_NEUMANN_RATIO - 1) * noise
            )
            flags[flags] = structure < limit
        return flags

    @cached_property
    def visible(self) -> NDArray[np.bool_]:
        """(n,) whether a row has a strong correlated part in some channel."""
        pairs = [_variances(self._rows[..., channel]) for channel in range(3)]
        flags = [
            structure > np.maximum(np.float32(MIN_STRUCTURED_ROW_VARIANCE), noise)
            for structure, noise in pairs
        ]
        return np.asarray(np.any(flags, axis=0))

    @cached_property
    def noise(self) -> float:
        """Variance of the noise of green, in the calmest quarter of the rows."""
        return float(np.quantile(_variances(self._rows[..., 1])[1], 0.25))

    @cached_property
    def detail(self) -> Floats32:
        """(n, W), green without its mean over 2 `MAX_LAG_PX` + 1 px."""
        green = self._rows[..., 1].astype(np.float32)
        return np.asarray(green - cv2.blur(green, (2 * MAX_LAG_PX + 1, 1)), np.float32)


def _variances(rows: NDArray[np.uint8]) -> tuple[Floats32, Floats32]:
    """Variances of the correlated part and of the noise of each row (n, W)."""
    values = rows.astype(np.float32)
    noise = np.square(np.diff(values, axis=1)).mean(axis=1) / 2
    return np.asarray(values.var(axis=1) - noise, np.float32), np.asarray(noise, np.float32)


def shows_gel(picture: NDArray[np.uint8]) -> bool:
    """Whether a picture shows anything: it is neither black nor uniform, nor pure noise.

    picture : (H, W, 3) uint8. Raises ValueError for another array.

    >>> shows_gel(np.full((48, 64, 3), (0, 135, 0), np.uint8))
    False
    >>> shows_gel(np.tile(np.arange(64, dtype=np.uint8)[None, :, None], (48, 1, 3)))
    True
    """
    check_color_image(picture)
    if min(picture.shape[:2]) < 2:
        return True
    return not (_Rows(picture).empty.all() and _Rows(picture.swapaxes(0, 1)).empty.all())


class DamageTest:
    """Decides whether a picture has come from the camera as it was taken.

    A picture is damaged if a twelfth of its rows, side by side, have lost what they show in the reference, or
    an eighth of them show it displaced. It is examined only if it differs from the last whole one in one
    point of 100. After 30 displaced pictures, the displacement is taken for the camera's own.

    Raises ValueError for a picture of another type or shape.

    Parameters
    ----------
    reference : (H, W, 3) uint8 BGR, a whole picture.

    Examples
    --------
    >>> from tactflow.sim import open_scene
    >>> scene = open_scene("press")
    >>> test = DamageTest(scene.frame(0))
    >>> cut = scene.frame(60)
    >>> cut[300:] = 128
    >>> [test.is_damaged(picture) for picture in (scene.frame(59), cut, scene.frame(61))]
    [False, True, False]
    """

    def __init__(self, reference: NDArray[np.uint8]) -> None:
        check_color_image(reference)
        height, width = reference.shape[:2]
        self._shape = reference.shape
        self._points = _stride(height), _stride(width), 1
        self._last = self._sampled(reference)
        self._reference: _Rows | None = None
        self._displaced = 0
        if min(height, width) >= 2:
            self._learn(_Rows(reference))

    def is_damaged(self, picture: NDArray[np.uint8]) -> bool:
        """Whether the next picture, of the reference's shape, is damaged."""
        check_color_image(picture)
        if picture.shape != self._shape:
            raise ValueError(f"required a picture of shape {self._shape}, got {picture.shape}")
        points = self._sampled(picture)
        change = np.abs(points - self._last)
        if (
            self._reference is not None
            and np.count_nonzero(change > self._noise) > MIN_CHANGED_SHARE * change.size
        ):
            rows = _Rows(picture)
            if _longest(rows.empty & self._reference.visible) >= self._shortest:
                return True
            if self._is_displaced(rows):
                self._displaced += 1
                if self._displaced < MAX_DISPLACED_PICTURES:
                    return True
                self._learn(rows)
        self._displaced = 0
        self._last = points
        return False

    def _sampled(self, picture: NDArray[np.uint8]) -> NDArray[np.int16]:
        return picture[self._points].astype(np.int16)

    def _learn(self, rows: _Rows) -> None:
        """Compare with these rows from now on."""
        self._reference = rows
        self._noise = MIN_CHANGE_SIGMAS * max(rows.noise, 1 / 12) ** 0.5
        # Rows between the pins of a picture in black and white are empty, too.
        self._shortest = max(MIN_RUN_ROWS, 2 * _longest(rows.empty))

    def _is_displaced(self, rows: _Rows) -> bool:
        """Whether enough rows show what those of the reference show, but displaced."""
        assert self._reference is not None
        now, before = rows.detail, self._reference.detail
        width = now.shape[1]
        lag = min(MAX_LAG_PX, width // 8)
        # What is left after a displacement is at least the noise of both.
        least = np.float32(width * max(2 * self._reference.noise, 1 / 12))
        changed = np.square(now - before).sum(axis=1) > np.float32(MIN_IMPROVEMENT_RATIO) * least
        if lag < MIN_LAG_PX or np.count_nonzero(changed) < MIN_DISPLACED_ROWS:
            return False
        now, before = now[changed], before[changed]
        size = fft.next_fast_len(width + lag, real=True)
        spectra = fft.rfft(now, size, axis=1) * np.conj(fft.rfft(before, size, axis=1))
        products = fft.irfft(spectra, size, axis=1)[:, np.arange(-lag, lag + 1)]
        best = products.argmax(axis=1) - lag
        shifts, counts = np.unique(best[np.abs(best) >= MIN_LAG_PX], return_counts=True)
        inner = slice(lag, width - lag)
        for shift in shifts[counts >= MIN_DISPLACED_ROWS]:
            rows_there = best == shift
            there = before[rows_there, lag - shift : width - lag - shift]
            left = _part_means(now[rows_there, inner] - there)
            still = _part_means(now[rows_there, inner] - before[rows_there, inner])
            widely = np.count_nonzero(still > MIN_IMPROVEMENT_RATIO * left, axis=1) >= MIN_DISPLACED_PARTS
            exact = widely & (left.mean(axis=1) < MAX_RESIDUAL_NOISE_RATIO * least / width)
            if np.count_nonzero(exact) >= MIN_DISPLACED_ROWS:
                return True
        return False


def _part_means(differences: Floats32) -> Floats32:
    """Mean squares (n, `PARTS_PER_ROW`) of parts of rows (n, W)."""
    parts = np.array_split(np.square(differences), PARTS_PER_ROW, axis=1)
    return np.stack([part.mean(axis=1) for part in parts], axis=1)


def _places(length: int, number: int) -> NDArray[np.intp]:
    """Indices evenly spread over a length, ascending, each once."""
    number = min(number, length)
    return (2 * np.arange(number) + 1) * length // (2 * number)


def _stride(length: int) -> slice:
    """A slice of about `SAMPLES_PER_SIDE` indices, evenly spread over a length."""
    step = max(1, length // SAMPLES_PER_SIDE)
    return slice(step // 2, None, step)


def _longest(flags: NDArray[np.bool_]) -> int:
    """Length of the longest run of true values, (n,) bool."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]])))
    return int((edges[1::2] - edges[::2]).max(initial=0))
