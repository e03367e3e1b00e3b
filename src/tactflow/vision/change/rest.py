"""A cheap test on a raw frame: has a contact begun, or has anything moved?

Some lines of the frame are summed over tiles: the light of each channel, and the least-squares displacement
of the gel's edges (Lucas and Kanade, 1981). The light is tested as in `ContactDetector`, against the
untouched gel under the illumination of this frame. As long as no tile has changed by half the detection
threshold, or by more than in a frame without contact, the detector would find nothing. Displacements are
compared with the sensor's own noise, which is learned tile by tile from the differences of consecutive frames
(von Neumann, 1941).
"""

from __future__ import annotations

from collections import deque
from statistics import NormalDist
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.arrays import Floats32, Indices, check_color_image
from tactflow.vision.compiled import kernel
from tactflow.vision.contact.background import Derived
from tactflow.vision.contact.components import WIDE_DEVIATION

LONG_SIDE_TILES: Final = 24
"""Tiles along the longer side of a frame: a contact of 4 % of its width fills one. A smaller spot without
colour may be missed."""
READ_BYTES: Final = 250_000
"""Bytes of a frame that are read: all of a small one, a sixth of 800 x 600 px. More would cost time."""
MIN_LINES_PER_TILE: Final = 6
"""Minimum number of lines that are read per tile. A third of the lines is evenly spaced, so that no contact
falls between them; the others are those with the strongest edges, which show motion best."""
TILE_NOISE_GREY: Final = 1.0
"""Standard deviation of a tile's light, grey levels: compression changes it by up to as much."""
GEL_MOVEMENT_TILES: Final = 0.077
"""Movement of the untouched gel against the camera, tiles: the detector's 1 px of 300."""
GROWTH_TOLERANCE: Final = 0.05
"""Tolerated growth of a deviation that showed no contact, in thresholds. At 0 to 0.05 none of 360 real
contacts begins late, at 0.1 one does; at 0 flicker and noise cost 2 % of the frames at rest."""
WINDOW_TILES: Final = 3
"""Width of the windows in which a displacement is measured, tiles."""
NOISE_BLOCK_FRAMES: Final = 8
"""Number of frame differences per estimate of the noise; half as many for the first one."""
NOISE_BLOCK_COUNT: Final = 5
"""Number of estimates whose median is the noise, so that motion in two of them has no effect: about a
second."""
DOT_TOLERANCE_PX: Final = 0.05
"""Tolerance of the positions of dots, px."""
SLOPE_STEPS_PER_GREY: Final = 8
"""Steps of the slopes per grey level: the sum of the positive weights of Sobel's filter, over both sides."""
ROUNDING_VARIANCE: Final = 1 / 12
"""Variance of rounding to whole grey levels, squared levels."""


class Look(NamedTuple):
    """What has to be computed for a frame.

    Attributes
    ----------
    changed : whether anything may have moved by more than the tolerance; if not, all results are repeated.
    suspect : whether a contact may have begun since the last frame that was processed in full; implies
        `changed`. If not, the contact stays the same, and only the dots are measured.
    """

    changed: bool
    suspect: bool


class _Measurement(NamedTuple):
    """Measurements of a frame.

    Attributes
    ----------
    departure : (rows, columns) float32, deviation of the light from that of the untouched gel, in
        thresholds.
    shift : (2, rows, columns) float32, of the edges along x and y, in units of `_px_per_edge`, in which the
        noise is uniform.
    """

    departure: Floats32
    shift: Floats32


class RestTest:
    """Decides from a raw frame which of its results could differ from those of earlier frames.

    A contact can begin only where the light deviates from that of the untouched gel by more than the contact
    test allows, and by more than in the last frame that was processed in full and showed no contact: a gel
    that creeps back does not begin one. During contact, every frame is processed in full. Dots have moved if
    edges near them have, beyond the sensor's own noise, since the last frame in which they were measured; on
    a sensor whose noise hides 0.05 px, they always may have.

    Raises ValueError for a frame of another type or shape, or a parameter out of range.

    Parameters
    ----------
    frame : (H, W, 3) uint8 BGR, the untouched gel.
    repeatability, tint : see `ContactDetector`.
    false_alarms : share of still frames in which the dots are measured nevertheless, in (0, 0.5].
    window : rows and columns of the frame that are examined, with start and stop; None: all.

    Examples
    --------
    >>> still = np.full((48, 64, 3), 100, np.uint8)
    >>> test = RestTest(still)
    >>> test.look(still)
    Look(changed=True, suspect=True)
    >>> touched = still.copy()
    >>> touched[10:20, 10:20] = 150
    >>> [test.look(frame).suspect for frame in (still, still + np.uint8(1), touched)]
    [False, False, True]
    """

    def __init__(
        self,
        frame: NDArray[np.uint8],
        *,
        repeatability: float = 0.025,
        tint: float = 0.01,
        false_alarms: float = 0.01,
        window: tuple[slice, slice] | None = None,
    ) -> None:
        if not 0 < false_alarms <= 0.5:
            raise ValueError(f"required false_alarms in (0, 0.5], got {false_alarms}")
        check_color_image(frame)
        self._shape = frame.shape
        height, width, _ = self._shape
        self._window = window or (slice(0, height), slice(0, width))
        examined = frame[self._window]
        height, width, _ = examined.shape
        tile = min(max(MIN_LINES_PER_TILE, round(max(height, width) / LONG_SIDE_TILES)), height, width)
        rows, columns = height // tile, width // tile
        lines = min(max(MIN_LINES_PER_TILE, READ_BYTES // (3 * tile * rows * columns)), tile)
        green = examined[: rows * tile, : columns * tile, 1]
        slopes = _slopes(green.astype(np.float32))
        used = _used_lines(np.square(slopes).sum(axis=(0, 2)).reshape(rows, tile), lines)
        slopes = np.ascontiguousarray(slopes[:, used])
        self._used: Indices = used + self._window[0].start
        # Differences of whole grey levels, so that these are whole numbers, too.
        self._slopes: NDArray[np.int16] = np.rint(slopes * SLOPE_STEPS_PER_GREY).astype(np.int16)
        self._pixels = tile * lines
        tiles = 2, rows, lines, columns, tile
        energy = _near(np.square(slopes).reshape(tiles).sum(axis=(2, 4)))
        energy += np.float32(ROUNDING_VARIANCE * self._pixels)
        self._px_per_edge = np.asarray(1 / np.sqrt(energy), np.float32)
        self._px_per_step = self._px_per_edge / np.float32(SLOPE_STEPS_PER_GREY)
        self._at_rest: Indices = (self._slopes * green[used].astype(np.int64)).reshape(tiles).sum(axis=(2, 4))
        self._z = np.float32(-NormalDist().inv_cdf(false_alarms / (4 * rows * columns)))
        self._light = _LightTest(self._sums(frame)[0], repeatability, tint)
        self._frame: NDArray[np.uint8] | None = None
        self._last: _Measurement | None = None
        self._allowed: Floats32 | None = None
        self._followed: Floats32 | None = None
        self._steps: list[Floats32] = []
        self._variances: deque[Floats32] = deque(maxlen=NOISE_BLOCK_COUNT)
        # Until the noise is known, the dots may always have moved.
        self._bound: Floats32 = np.full_like(self._px_per_edge, -1)

    def look(self, frame: NDArray[np.uint8], *, touching: bool = False, due: bool = False) -> Look:
        """Compare a frame with the earlier ones.

        frame : of the first one's shape. It is kept until the next call and must not be modified until then.
        touching : whether the previous frame showed contact. due : whether the frame will be processed in
        full in any case.
        """
        if frame.shape != self._shape or frame.dtype != np.uint8:
            check_color_image(frame)
            raise ValueError(f"required a frame of shape {self._shape}, got {frame.shape}")
        before, self._frame = self._frame, frame
        if touching:
            # Measure nothing; start over after the contact.
            self._last = None
            return Look(True, True)
        if self._last is None and before is not None:
            # The contact had ended in the previous frame.
            self._last = self._measure(before)
            self._allowed, self._followed = self._last
        last, self._last = self._last, (now := self._measure(frame))
        if before is None or last is None or self._allowed is None or self._followed is None:
            self._allowed, self._followed = now
            return Look(True, True)
        if now.shift.tobytes() != last.shift.tobytes() or not self._is_same(frame, before):
            self._learn(now.shift - last.shift)
        elif not due:
            return Look(False, False)
        departed, moved = find_excess(
            now.departure, self._allowed, GROWTH_TOLERANCE, now.shift, self._followed, self._bound
        )
        suspect = due or departed > 0
        # A deviation that has crept back must not return unnoticed.
        self._allowed = now.departure if suspect else np.minimum(self._allowed, now.departure)
        changed = suspect or moved > 0
        if changed:
            self._followed = now.shift
        return Look(changed, suspect)

    def _is_same(self, frame: NDArray[np.uint8], other: NDArray[np.uint8]) -> bool:
        return np.array_equal(frame[self._window], other[self._window])

    def _measure(self, frame: NDArray[np.uint8]) -> _Measurement:
        light, shift = self._sums(frame)
        return _Measurement(self._light.departure(light), shift)

    def _sums(self, frame: NDArray[np.uint8]) -> tuple[Floats32, Floats32]:
        """Light (3, rows, columns), grey levels, and shift (2, rows, columns), see `sum_tiles`."""
        light = np.empty((3, *self._px_per_edge.shape[1:]), np.float32)
        shift = np.empty_like(self._px_per_edge)
        picture = np.ascontiguousarray(frame).reshape(len(frame), -1)
        left = 3 * self._window[1].start
        sum_tiles(picture, left, self._used, self._slopes, self._at_rest, self._px_per_step, light, shift)
        return light, shift

    def _learn(self, step: Floats32) -> None:
        """Update the noise with the difference of displacements in two consecutive frames."""
        self._steps.append(step)
        if len(self._steps) < (NOISE_BLOCK_FRAMES if self._variances else NOISE_BLOCK_FRAMES // 2):
            return
        # The variance excludes a steady drag.
        variance = np.var(self._steps, axis=0) / np.float32(2)
        self._steps.clear()
        # Neighbouring tiles are alike, except for one that is much noisier.
        near = np.stack([cv2.blur(plane, (5, 5)) for plane in variance])
        self._variances.append(
            np.maximum(np.maximum(near, variance / 2), np.float32(ROUNDING_VARIANCE / WINDOW_TILES**2))
        )
        bound = self._z * np.sqrt(2 * np.median(self._variances, axis=0))
        is_low = np.median(bound * self._px_per_edge) <= DOT_TOLERANCE_PX
        self._bound = np.asarray(bound if is_low else np.full_like(bound, -1), np.float32)


class _LightTest:
    """The test of `ContactDetector` on tiles instead of cells; its threshold is half of the detector's.

    Parameters
    ----------
    untouched : (3, rows, columns) float32, light of the untouched gel, grey levels.
    repeatability, tint : see `ContactDetector`.
    """

    def __init__(self, untouched: Floats32, repeatability: float, tint: float) -> None:
        slopes = [_slopes(plane) for plane in untouched]
        steady = TILE_NOISE_GREY**2 + GEL_MOVEMENT_TILES**2 * np.square(slopes).sum(axis=1)
        self._known = Derived.of(untouched, steady, repeatability, tint)
        self._before = np.zeros_like(untouched[0])
        self._change, self._deviations = np.empty((2, *untouched.shape), np.float32)

    def departure(self, light: Floats32) -> Floats32:
        """Deviation (rows, columns) float32 of the light of a frame, (3, rows, columns), in thresholds."""
        self._known.weigh(light, self._before, self._change, self._deviations)
        return np.asarray(np.sqrt(self._deviations[2] / np.float32(WIDE_DEVIATION)), np.float32)


def _slopes(plane: Floats32) -> Floats32:
    """Gradient (2, h, w) of a plane (h, w) along x and y."""
    axes = ((1, 0), (0, 1))
    border = cv2.BORDER_REPLICATE
    return np.stack([cv2.Sobel(plane, cv2.CV_32F, *axis, scale=1 / 8, borderType=border) for axis in axes])


def _near(sums: Floats32) -> Floats32:
    """Means of planes (2, rows, columns) over `WINDOW_TILES` tiles a side; 0 outside the frame."""
    size, border = (WINDOW_TILES, WINDOW_TILES), cv2.BORDER_CONSTANT
    return np.stack([cv2.blur(plane, size, borderType=border) for plane in sums])


def _used_lines(energy: Floats32, number: int) -> NDArray[np.intp]:
    """The lines that are read, ascending: `number` lines in each row of tiles.

    energy : (rows, lines of a tile), >= 0, of the edges in each line.
    """
    rows, lines = energy.shape
    spread = -(-number // 3)
    even = (2 * np.arange(spread) + 1) * lines // (2 * spread)
    others = energy.copy()
    others[:, even] = -1
    best = np.argsort(others, axis=1)[:, lines - number + spread :]
    inside = np.sort(np.hstack([np.broadcast_to(even, (rows, spread)), best]), axis=1)
    return np.asarray((inside + lines * np.arange(rows)[:, None]).ravel())


@kernel
def sum_tiles(
    picture: NDArray[np.uint8],
    left: int,
    used: Indices,
    slopes: NDArray[np.int16],
    at_rest: Indices,
    factor: Floats32,
    light: Floats32,
    shift: Floats32,
) -> None:
    """Fill `light`, the means of blue, green and red over tiles, and `shift`, that of the edges near them.

    picture : (H, 3 W). left : its first byte in a line. used : (n * rows,), its lines that are read; n < 258.
    slopes : (2, n * rows, m * columns), of green along x and y, in any unit.
    at_rest : (2, rows, columns), the sums over tiles of green of the untouched gel times its slopes.
    factor : (2, rows, columns), of the means over `WINDOW_TILES` tiles a side of the same sums of
    the picture, less `at_rest`. light : (3, rows, columns). shift : (2, rows, columns).
    """
    _, rows, columns = light.shape
    tiles = rows, len(used) // rows, columns, slopes.shape[2] // columns
    pictures = picture[used, left : left + 3 * slopes.shape[2]].reshape(*tiles, 3)
    light[:] = pictures.mean(axis=(1, 3)).transpose(2, 0, 1)
    moved = (slopes.reshape(2, *tiles) * pictures[..., 1].astype(np.int64)).sum(axis=(2, 4)) - at_rest
    shift[:] = _near(moved.astype(np.float32)) * factor


@kernel
def find_excess(
    departure: Floats32,
    allowed: Floats32,
    growth: float,
    shift: Floats32,
    followed: Floats32,
    bound: Floats32,
) -> tuple[float, float]:
    """The largest excess of `departure` over 1 and over `allowed` by `growth`, (rows, columns), and of the
    distance of `shift` from `followed` over `bound`, (2, rows, columns)."""
    departed = (departure - np.maximum(allowed + np.float32(growth), 1)).max()
    return float(departed), float((np.abs(shift - followed) - bound).max())
