"""Does anything touch the gel that did not, has anything moved? A cheap look at a raw frame.

Some lines of the frame are summed over tiles: the light of each channel, and the least-squares displacement
of the gel's edges (Lucas and Kanade, 1981). All are taken against the untouched gel, after the exposure, as
single tiles and over windows of 3 and 7. What a sensor's compression, flicker and noise do to them is learned
tile by tile from the differences between frames in a row (von Neumann, 1941): the calmest of all blocks of
frames counts, so that motion is not taken for noise. The bound of all tests together is set from the share of
still frames that may fail (Bonferroni).
"""

from __future__ import annotations

from collections import deque
from statistics import NormalDist
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.arrays import MAD_TO_SIGMA, Floats32, check_color_image
from tactflow.vision.compiled import kernel

TILES: Final = 24
"""Tiles along the longer side of a frame: a contact of 4 % of its width fills one."""
READ: Final = 250_000
"""Bytes of a frame that are read: all of a small one, a sixth of 800 x 600 px. More cost time."""
LINES: Final = 6
"""Lines of a tile that are read at least. A third of all is evenly spaced, so that no contact falls between
them; the others are those with the strongest edges, which show best how far the gel has moved."""
WINDOWS: Final = (1, 3, 7)
"""Widths of the windows of tiles, tiles: a faint contact shows in the mean over its own size."""
LIGHT: Final = 3 * len(WINDOWS)
PLANES: Final = LIGHT + 2
"""Numbers of a tile: its light in three channels and windows, and a displacement along x and y."""
NEAR: Final = 3
"""Width of the windows in which a displacement is measured, tiles."""
WARM_UP: Final = 4
"""Differences of frames from which the first noise is learned."""
BLOCK: Final = 8
"""The same of every later block. The least of many blocks of 8, smoothed over 25 tiles, is 15 % too low."""
FORGET: Final = 1.02
"""Growth of the learned variance from block to block, so that a sensor may become noisier: it doubles in 280
frames, some ten seconds."""
LEVEL: Final = 1.0
"""Grey levels: a smaller departure of a tile from the untouched gel is no contact, as pictures are rounded to
whole levels; of a window, that over its width, as a mean is known better."""
SHIFT: Final = 0.05
"""px: tolerance of the dots' positions."""
RECENT: Final = 5
"""Frames whose strongest change is what the gel shows at rest, so that a flicker of five frames is part of
it: a sixth of a second."""
LAG: Final = 3
"""Frames that are too recent for that: a contact that begins slowly shall not make itself rest."""
GLANCES: Final = 0.01
"""Share of still frames in which dots are looked at all the same: that costs less than a frame in full."""
ROUNDING: Final = 1 / 12
"""Variance of rounding to whole grey levels, squared levels."""


class Look(NamedTuple):
    """What a frame needs.

    changed : whether anything may have moved by more than the tolerance; if not, all results are repeated.
    suspect : whether something may touch the gel that did not in the last frame that was worked on in full;
        implies `changed`. If not, the contact stays, and only the dots are looked at.
    """

    changed: bool
    suspect: bool


class RestTest:
    """Tells from a raw frame what of its results could differ from those of the frames before.

    A contact may begin only where the light departs further from that of the untouched gel than it did in the
    last frames that showed no contact; a gel that creeps back does not begin one. While something touches,
    every frame is worked on in full. Dots have moved if edges near them have, by the sensor's own noise,
    since the last frame in which they were looked at; on a sensor with which 0.05 px cannot be told from
    noise, they always may have.

    frame : (H, W, 3) uint8 BGR, the untouched gel.
    false_alarms : share of still frames that are worked on all the same, in (0, 0.5].

    Raises ValueError for a frame of another kind or shape, or a parameter out of range.

    >>> still = np.full((48, 64, 3), 100, np.uint8)
    >>> test = RestTest(still)
    >>> test.look(still)
    Look(changed=True, suspect=True)
    >>> [test.look(still + np.uint8(level)).suspect for level in (0, 1, 0, 1, 0, 1, 1)]
    [False, True, True, True, False, False, False]
    """

    def __init__(self, frame: NDArray[np.uint8], *, false_alarms: float = 1e-3) -> None:
        if not 0 < false_alarms <= 0.5:
            raise ValueError(f"required false_alarms in (0, 0.5], got {false_alarms}")
        check_color_image(frame)
        self._shape = frame.shape
        tile = min(max(LINES, round(max(self._shape) / TILES)), *self._shape[:2])
        rows, columns = self._shape[0] // tile, self._shape[1] // tile
        lines = min(max(LINES, READ // (3 * tile * rows * columns)), tile)
        gray = np.asarray(frame[: rows * tile, : columns * tile, 1], np.float32)
        slopes = np.stack([cv2.Sobel(gray, cv2.CV_32F, *axis, scale=1 / 8) for axis in ((1, 0), (0, 1))])
        used = _used_lines(np.square(slopes).sum(axis=(0, 2)).reshape(rows, tile), lines)
        self._used = used, slice(columns * tile)
        self._slopes: Floats32 = np.ascontiguousarray(slopes[:, used])
        self._resting: NDArray[np.uint8] = np.ascontiguousarray(frame[self._used][..., 1])
        width = columns * tile
        self._heaps = np.empty(3 * width, np.uint16), np.empty((2, width), np.float32)
        self._sums = np.empty((rows, columns, 5), np.float32)
        self._pixels = tile * lines
        energy = np.square(self._slopes).reshape(2, rows, -1, columns, tile).sum(axis=(2, 4))
        energy = _near(energy.transpose(1, 2, 0)) + np.float32(ROUNDING * self._pixels)
        self._px_per_edge = np.asarray(1 / np.sqrt(energy), np.float32)
        shares = np.repeat([false_alarms / LIGHT, GLANCES / 2], [LIGHT, 2]) / (2 * rows * columns)
        z = [-NormalDist().inv_cdf(share) for share in shares]
        self._z = np.array(z, np.float32)[:, None, None]
        self._level = np.repeat(LEVEL / np.array(WINDOWS, np.float32), 3)[:, None, None]
        light = np.repeat(ROUNDING / (self._pixels * np.square(WINDOWS)), 3)
        self._floor = np.append(light, [ROUNDING / NEAR**2] * 2).astype(np.float32)[:, None, None]
        self._rest = self._light(frame)
        self._frame: NDArray[np.uint8] | None = None
        self._last: Floats32 | None = None
        self._moved: Floats32 | None = None
        self._squares: list[Floats32] = []
        self._variance: Floats32 | None = None
        self._bound: Floats32 | None = None
        self._sees_shifts = False
        self._recent: deque[Floats32] = deque(maxlen=RECENT + LAG)
        self._envelope: Floats32 | None = None
        self._worked = True

    def look(self, frame: NDArray[np.uint8], *, touching: bool = False, due: bool = False) -> Look:
        """Compare a frame with those before.

        frame : of the first one's shape. It is kept until the next, and must not be written to meanwhile.
        touching : whether something touched the gel in the frame before. due : that the frame is worked on
        in full whatever it shows.
        """
        check_color_image(frame)
        if frame.shape != self._shape:
            raise ValueError(f"required a frame of shape {self._shape}, got {frame.shape}")
        before, self._frame = self._frame, frame
        if touching:
            # Nothing is looked at, and the rest begins anew behind the contact.
            self._last = None
            self._recent.clear()
            return Look(True, True)
        if self._last is None and before is not None:
            # In the frame before, nothing touched any more.
            self._last = self._planes(before)
            self._decide(self._last, changed=True, suspect=True)
        last, self._last = self._last, (now := self._planes(frame))
        if last is None or before is None:
            return self._decide(now, changed=True, suspect=True)
        step = now - last
        if not step.any() and np.array_equal(frame, before):
            return self._decide(now, changed=True, suspect=True) if due else Look(False, False)
        self._learn(step)
        if self._worked:
            self._envelope = self._resting_change()
        suspect = due or self._bound is None or self._departs(now)
        return self._decide(now, changed=suspect or self._moves(now), suspect=suspect)

    def _decide(self, now: Floats32, *, changed: bool, suspect: bool) -> Look:
        """Note what is done with a frame."""
        self._recent.append(np.abs(now[:LIGHT]))
        if changed:
            self._moved = now[LIGHT:]
        self._worked = suspect
        return Look(changed, suspect)

    def _departs(self, now: Floats32) -> bool:
        """Whether the light of any window has departed from that of the untouched gel."""
        assert self._envelope is not None
        if bool((np.abs(now[:LIGHT]) > self._envelope + self._limit).any()):
            return True
        # What has crept back may not come again unseen.
        np.minimum(self._envelope, self._resting_change(), out=self._envelope)
        return False

    def _resting_change(self) -> Floats32:
        """(9, rows, columns): the strongest change of the frames that tell what the gel shows at rest."""
        return np.asarray(np.max(list(self._recent)[:RECENT], axis=0), np.float32)

    def _moves(self, now: Floats32) -> bool:
        """Whether an edge may have moved since the dots were last looked at."""
        if not self._sees_shifts or self._moved is None or self._bound is None:
            return True
        return bool((np.abs(now[LIGHT:] - self._moved) > self._bound[LIGHT:]).any())

    def _planes(self, frame: NDArray[np.uint8]) -> Floats32:
        """(11, rows, columns): against the untouched gel, the light of each channel in windows of each width,
        grey levels, and the displacement in windows of `NEAR`, in units of `_px_per_edge`, in which noise is
        the same everywhere."""
        light = self._light(frame)
        ratio = ((light[::2, ::2] + 1) / (self._rest[::2, ::2] + 1)).reshape(-1, 3)
        change = light - self._rest * np.partition(ratio, len(ratio) // 2, axis=0)[len(ratio) // 2]
        planes = np.empty((PLANES, *self._sums.shape[:2]), np.float32)
        for first, width in zip(range(0, LIGHT, 3), WINDOWS, strict=True):
            planes[first : first + 3] = cv2.blur(change, (width, width)).transpose(2, 0, 1)
        planes[LIGHT:] = (_near(self._sums[..., 3:]) * self._px_per_edge).transpose(2, 0, 1)
        return planes

    def _light(self, frame: NDArray[np.uint8]) -> Floats32:
        """(rows, columns, 3): mean light of each channel; the sums of all kinds are in `_sums` then."""
        lines = frame[self._used].reshape(len(self._resting), -1)
        sum_tiles(lines, self._resting, self._slopes, *self._heaps, self._sums)
        return np.asarray(self._sums[..., :3] / np.float32(self._pixels), np.float32)

    def _learn(self, step: Floats32) -> None:
        """Take in the difference of two frames in a row."""
        self._squares.append(step * step)
        if len(self._squares) < (WARM_UP if self._variance is None else BLOCK):
            return
        if self._variance is None:
            # A camera that still settles, or a gel that still moves, shall not pass for noise.
            squares = np.median(self._squares, axis=0) * np.float32(MAD_TO_SIGMA**2)
        else:
            squares = np.mean(self._squares, axis=0)
        seen = squares / np.float32(2)
        # Neighbouring tiles are alike; one that is much louder than they are is louder.
        near = np.stack([cv2.blur(plane, (5, 5)) for plane in seen])
        seen = np.maximum(np.maximum(near, seen / 2), self._floor)
        older = self._variance
        self._variance = seen if older is None else np.minimum(older * np.float32(FORGET), seen)
        self._bound = np.sqrt(2 * self._variance) * self._z
        self._limit = self._bound[:LIGHT] + self._level
        shifts = self._bound[LIGHT:].transpose(1, 2, 0) * self._px_per_edge
        self._sees_shifts = bool(np.median(shifts) <= SHIFT)
        self._squares.clear()


def _near(sums: Floats32) -> Floats32:
    """Means over windows of `NEAR` tiles, (rows, columns, 2); what is outside of the frame adds nothing."""
    return np.asarray(cv2.blur(sums, (NEAR, NEAR), borderType=cv2.BORDER_CONSTANT), np.float32)


def _used_lines(energy: Floats32, number: int) -> NDArray[np.intp]:
    """The lines that are read, ascending: so many of each row of tiles.

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


@kernel(
    "void(uint8[:, ::1], uint8[:, ::1], float32[:, :, ::1], uint16[::1], float32[:, ::1], float32[:, :, ::1])"
)
def sum_tiles(
    lines: NDArray[np.uint8],
    resting: NDArray[np.uint8],
    slopes: Floats32,
    light: NDArray[np.uint16],
    shift: Floats32,
    sums: Floats32,
) -> None:
    """Sums over tiles of blue, green and red, and of the change of green times its slopes along x and y.

    lines : (n * rows, m * columns * 3), n < 258. resting : (n * rows, m * columns), green of the untouched
    gel. slopes : (2, n * rows, m * columns), levels per px. light, shift : (m * columns
    * 3,) and (2, m * columns), written over. sums : (rows, columns, 5), to be written.
    """
    rows, columns, _ = sums.shape
    thick, wide = resting.shape[0] // rows, resting.shape[1] // columns
    for row in range(rows):
        light[:] = 0
        shift[:] = 0
        for y in range(row * thick, (row + 1) * thick):
            for x in range(light.size):
                light[x] += lines[y, x]
            for x in range(resting.shape[1]):
                more = np.float32(lines[y, 3 * x + 1]) - np.float32(resting[y, x])
                shift[0, x] += more * slopes[0, y, x]
                shift[1, x] += more * slopes[1, y, x]
        for column in range(columns):
            blue, middle, red = 0, 0, 0
            right, down = np.float32(0), np.float32(0)
            for x in range(column * wide, (column + 1) * wide):
                blue += light[3 * x]
                middle += light[3 * x + 1]
                red += light[3 * x + 2]
                right += shift[0, x]
                down += shift[1, x]
            sums[row, column, 0] = blue
            sums[row, column, 1] = middle
            sums[row, column, 2] = red
            sums[row, column, 3] = right
            sums[row, column, 4] = down
