"""The first frames of a camera: find when its light is steady, and the frame that shows the untouched gel."""

from __future__ import annotations

from functools import lru_cache
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.arrays import MAD_TO_SIGMA, Floats32

COLUMN_COUNT: Final = 40
"""Cells across a picture, about. Chosen by hand: a cell is smaller than most contacts."""
CELL_SIDE_SAMPLES: Final = 4
"""Samples along the side of a cell. Sixteen of them take the noise of a pixel down to a quarter."""
BLACK_LIMIT_GREY, SATURATED_LIMIT_GREY = 8, 247
"""Grey levels below which a sample is black and above which it is saturated: it does not follow the exposure.
Chosen by hand."""
MAX_CLIPPED_SHARE: Final = 0.1
"""Share of such samples from which a cell is ignored. Chosen by hand."""

STEADY_SECONDS: Final = 0.4
"""Duration for which consecutive frames must be alike for the light to be steady, s. Chosen on franka_mini,
whose first frames may show the previous grasp for up to 0.32 s."""
MIN_STEADY_FRAMES, MAX_STEADY_FRAMES = 4, 10
"""Minimum number of these frames, so that they reveal a trend, and maximum, because a camera sets its
exposure from frame to frame. The minimum was chosen on every second recording of franka_mini, with two of
three and three of four frames left out."""
MIN_STATE_FRACTION: Final = 0.4
"""Minimum length of a state of the gel, as a fraction of these frames. Chosen by hand."""
MAX_STEADY_CHANGE: Final = 0.02
"""Maximum relative change of a channel in steady light: less than that of a contact (`repeatability`)."""
MAX_FLICKER_STDDEVS: Final = 2.5
"""The same for flickering light, in standard deviations. Chosen by hand."""
MIN_TRENDLESS_RATIO: Final = 1.0
"""Ratio of the squared changes from frame to frame to the squared deviations from the mean above which frames
scatter without a trend. It is 2 for independent frames; in ten of them it falls below 1.06 by chance once in
twenty times (J. von Neumann, Annals of Mathematical Statistics 12, 1941)."""
MIN_LOCAL_CHANGE: Final = 0.06
"""Minimum relative change of a cell against the rest of the picture if something moved there, after a mean
over 3 x 3 cells. Chosen on franka_mini: key frames of its compression stay below."""
MIN_MOVED_SHARE: Final = 0.01
"""Minimum share of cells that moved. Chosen by hand."""
OTHER_GEL_SHARE: Final = 0.5
"""Share of cells that moved above which two pictures show different gels: a touch leaves some of a gel as it
was."""
LIGHT_DEGREE: Final = 3
"""Degree of the polynomial in x and y that models the light of an untouched gel. Chosen by hand."""
MEDIAN_SIDE_CELLS: Final = 5
"""Side of the median filter that removes dots, cells. Chosen by hand."""
EVENER_RATIO: Final = 0.8
"""Ratio of two states' unevenness below which the evener one is the untouched gel, if the light was still
changing, or if the first state is so brief that it may be the end of a touch. Chosen on franka_mini: a
touched gel has 1.2 to 50 times the unevenness of the same gel at rest, and for faint contacts at least
0.9."""
MUCH_EVENER_RATIO: Final = 0.5
"""The same if there is no other reason to prefer the later state. Chosen by hand."""
EVEN_RATIO: Final = 1.5
"""Ratio up to which a state with steady light is preferred to one whose light was changing. Chosen on
franka_mini, where darker pictures have less contrast."""


class Look(NamedTuple):
    """Summary of a frame.

    Attributes
    ----------
    light : (h, w, channels) float32, logarithm of the mean of each cell.
    seen : bool of the same shape, whether the cell is neither black nor saturated.
    """

    light: Floats32
    seen: NDArray[np.bool_]


def look_at(frame: NDArray[np.uint8]) -> Look:
    """Sample a frame sparsely: about 160 x 120 of its pixels, whatever its size.

    frame : (H, W) or (H, W, channels) uint8.

    >>> look_at(np.full((480, 640, 3), 100, np.uint8)).light.shape
    (30, 40, 3)
    """
    step = max(1, max(frame.shape[:2]) // (COLUMN_COUNT * CELL_SIDE_SAMPLES))
    # A line camera's frame may be thinner than a step.
    top, left = (min(step, side) // 2 for side in frame.shape[:2])
    points = np.atleast_3d(frame[top::step, left::step])
    side = min(CELL_SIDE_SAMPLES, *points.shape[:2])
    high, wide = points.shape[0] // side, points.shape[1] // side
    cells = points[: high * side, : wide * side].reshape(high, side, wide, side, -1)
    clipped = ((cells < BLACK_LIMIT_GREY) | (cells > SATURATED_LIMIT_GREY)).mean(axis=(1, 3))
    light = np.log1p(cells.mean(axis=(1, 3), dtype=np.float32))
    return Look(light, clipped < MAX_CLIPPED_SHARE)


def change_between(before: Look, after: Look) -> tuple[Floats32, bool]:
    """Change of the light from one frame to another, and whether anything moved.

    Returns the logarithm of each channel's gain, (channels,) float32, the median over the picture, which is
    robust against an object that covers less than half of it; and whether cells changed relative to it.
    """
    gain, moved = _moved(before, after)
    return gain, bool(moved.mean() > MIN_MOVED_SHARE)


def _moved(before: Look, after: Look) -> tuple[Floats32, NDArray[np.bool_]]:
    """The gain as in `change_between`, and which cells changed relative to it, (h, w) bool."""
    both = before.seen & after.seen
    change = np.where(both, after.light - before.light, np.float32(np.nan))
    gain = np.zeros(change.shape[2], np.float32)
    visible = both.any(axis=(0, 1))
    gain[visible] = np.nanmedian(change[..., visible], axis=(0, 1))
    left = cv2.blur(np.where(both, change - gain, np.float32(0)), (3, 3))
    return gain, np.abs(np.atleast_3d(left)).max(axis=2) > MIN_LOCAL_CHANGE


def unevenness(look: Look) -> float:
    """Deviation of the light of a gel from a smooth polynomial over the picture, ignoring dots.

    An object that touches a gel bends its surface, which changes brightness and colour locally. Returns the
    mean squared residual of a polynomial in x and y, in squared relative changes, summed over the channels;
    infinite if too few cells are usable.
    """
    basis = _polynomials(*look.light.shape[:2])
    residuals = []
    for channel in range(look.light.shape[2]):
        plane = cv2.medianBlur(np.ascontiguousarray(look.light[..., channel]), MEDIAN_SIDE_CELLS).ravel()
        seen = look.seen[..., channel].ravel()
        if np.count_nonzero(seen) < 2 * basis.shape[1]:
            continue
        fitted = basis @ np.linalg.lstsq(basis[seen], plane[seen], rcond=None)[0]
        residuals.append(float(np.square(plane - fitted)[seen].mean()))
    return sum(residuals) if residuals else float("inf")


@lru_cache(maxsize=4)
def _polynomials(high: int, wide: int) -> Floats32:
    """(high * wide, terms): powers of x and y up to the degree `LIGHT_DEGREE`."""
    y, x = np.meshgrid(np.linspace(-1, 1, high), np.linspace(-1, 1, wide), indexing="ij")
    terms = [x**i * y**j for i in range(LIGHT_DEGREE + 1) for j in range(LIGHT_DEGREE + 1 - i)]
    return np.stack(terms, axis=-1).reshape(high * wide, -1).astype(np.float32)


class Settling:
    """Examines the first frames of a source until the light is steady.

    A camera sets exposure and white balance during its first frames, and some still deliver older pictures.
    Consecutive frames that differ only by a gain for each channel form a *state* of the gel; a new state
    begins when something moves. The best reference has steady light and belongs to the state that shows the
    untouched gel: the first one, unless a later state is much evener, or is as even and has steady light
    while the first one had not.

    Examples
    --------
    >>> gel = np.full((48, 64, 3), 120, np.uint8)
    >>> settling = Settling()
    >>> for index, exposure in enumerate((0.5, 0.8, *[1.0] * 10)):
    ...     settling.add(np.uint8(gel * exposure), index / 25)
    >>> settling.steady, settling.best()
    (True, 2)
    """

    def __init__(self) -> None:
        self._looks: list[Look] = []
        self._times: list[float] = []
        self._gains: list[Floats32] = []
        self._states: list[list[int]] = []

    def __len__(self) -> int:
        return len(self._looks)

    def add(self, frame: NDArray[np.uint8], t: float) -> None:
        """Add the next frame, taken at t, s: (H, W) or (H, W, channels) uint8, all of one size."""
        now, index = look_at(frame), len(self._looks)
        if index == 0:
            gain, moved = np.zeros(now.light.shape[2], np.float32), True
        else:
            step, moved = change_between(self._looks[-1], now)
            gain = self._gains[-1] + step
            moved = moved or change_between(self._looks[self._states[-1][0]], now)[1]
        if moved:
            self._states.append([])
        self._states[-1].append(index)
        self._looks.append(now)
        self._times.append(t)
        self._gains.append(gain)

    @property
    def _calm(self) -> int:
        """Number of consecutive frames that must be alike: those within the time `STEADY_SECONDS`."""
        step = float(np.median(np.diff(self._times))) if len(self) > 1 else 0.0
        return (
            int(np.clip(round(STEADY_SECONDS / step), MIN_STEADY_FRAMES, MAX_STEADY_FRAMES))
            if step > 0
            else MAX_STEADY_FRAMES
        )

    @property
    def _short(self) -> int:
        """Minimum number of frames of a state."""
        return round(MIN_STATE_FRACTION * self._calm)

    @property
    def steady(self) -> bool:
        """Whether the last frames show the same gel in the same light."""
        return self._is_steady(self._states[-1]) if self._states else False

    @property
    def touched(self) -> bool:
        """Whether the light was steady from the first frame until something touched the gel."""
        first, *later = self._states
        if not later or len(first) < self._short:
            return False
        spread = np.ptp([self._gains[i] for i in first], axis=0).max()
        return bool(spread < MAX_STEADY_CHANGE) and unevenness(
            self._looks[-1]
        ) > EVEN_RATIO * self._unevenness(first)

    @property
    def undecided(self) -> bool:
        """Whether the gel came to rest in another state than the first, although the first one is chosen.

        Their evenness does not reveal which of the two is the untouched gel.
        """
        if not self.steady or self.touched or self.best() not in self._states[0]:
            return False
        return change_between(self._looks[self.best()], self._looks[-1])[1]

    @property
    def outlived(self) -> bool:
        """Whether the first state is a leftover in the camera's buffers: it is brief, undecided, and the last
        state either shows something else nearly everywhere, or is about as even, so that no touch caused it.
        """
        first, last = self._states[0], self._states[-1]
        if len(first) >= self._calm / 2 or not self.undecided:
            return False
        moved = _moved(self._looks[first[0]], self._looks[-1])[1]
        return bool(moved.mean() > OTHER_GEL_SHARE) or self._unevenness(last) < EVEN_RATIO * self._unevenness(
            first
        )

    @property
    def begins(self) -> int:
        """Index of the frame with which the last state of the gel began."""
        return self._states[-1][0]

    @property
    def scattered(self) -> bool:
        """Whether most frames show another state of the gel than the previous frame."""
        return len(self) > 1 and 2 * len(self._states) > len(self)

    @property
    def unrelated(self) -> bool:
        """Whether these are separate pictures rather than a video."""
        return len(self) >= 2 * MAX_STEADY_FRAMES and self.scattered

    @property
    def changing(self) -> bool:
        """Whether consecutive frames show the same gel in unsteady light."""
        return not self.steady and len(self._states[-1]) >= self._calm

    @property
    def drift(self) -> float:
        """Largest relative change of a channel over the last frames."""
        gains = np.array(self._gains[-self._calm :])
        return float(np.expm1(np.ptp(gains, axis=0).max()))

    def touched_before(self, index: int) -> bool:
        """Whether something moved between the first frame and this one."""
        return index not in self._states[0]

    def best(self) -> int:
        """Index of the most typical frame of the untouched gel in steady light; 0 if the first is one of
        them."""
        return self._typical(self.alike())

    def latest(self) -> tuple[int, list[int]]:
        """Like `best` and `alike`, of the last state of the gel."""
        calm = self._calm_frames(self._states[-1])
        return self._typical(calm), calm

    def _typical(self, calm: list[int]) -> int:
        if calm[0] == 0:
            return 0
        lights = np.array([self._looks[i].light - self._gains[i] for i in calm])
        typical = np.median(lights, axis=0)
        return calm[int(np.abs(lights - typical).mean(axis=(1, 2, 3)).argmin())]

    def alike(self) -> list[int]:
        """Indices of all frames that show the untouched gel in the same steady light, in order."""
        first, *later = self._states
        best = first
        for state in later:
            if len(self._calm_frames(state)) >= self._short and self._is_better(state, best):
                best = state
        return self._calm_frames(best)

    def _is_better(self, state: list[int], than: list[int]) -> bool:
        """Whether a later state is the untouched gel rather than the best one so far."""
        here, there = self._unevenness(state), self._unevenness(than)
        calm = self._calm_frames(than)
        passing = len(calm) < self._calm / 2
        apart = np.abs(self._level(state)[0] - self._level(than)[0]).max()
        # A camera that sets its exposure does not hold one light at first, whatever a lamp does later.
        unsettled = than is not self._states[0] or apart > MAX_STEADY_CHANGE
        if (passing and unsettled) or calm[0] != than[0]:
            return here < there * (EVEN_RATIO if self._is_steady(state) else EVENER_RATIO)
        return here < there * (EVENER_RATIO if passing else MUCH_EVENER_RATIO)

    def _unevenness(self, state: list[int]) -> float:
        calm = self._calm_frames(state)
        return unevenness(self._looks[calm[len(calm) // 2]])

    def _is_steady(self, state: list[int]) -> bool:
        gains = np.array([self._gains[i] for i in state[-self._calm :]])
        if len(gains) < self._calm:
            return False
        scatter = np.square(gains - gains.mean(axis=0)).sum(axis=0)
        steps = np.square(np.diff(gains, axis=0)).sum(axis=0)
        return bool(
            np.all((np.ptp(gains, axis=0) < MAX_STEADY_CHANGE) | (steps > MIN_TRENDLESS_RATIO * scatter))
        )

    def _level(self, state: list[int]) -> tuple[Floats32, Floats32]:
        """Final light of a state, and its tolerance: (channels,) each."""
        gains = np.array([self._gains[i] for i in state[-self._calm :]])
        level = np.median(gains, axis=0)
        spread = np.float32(MAD_TO_SIGMA) * np.median(np.abs(gains - level), axis=0)
        return level, np.maximum(np.float32(MAX_STEADY_CHANGE), np.float32(MAX_FLICKER_STDDEVS) * spread)

    def _calm_frames(self, state: list[int]) -> list[int]:
        """The frames of a state in its final light."""
        level, tolerance = self._level(state)
        return [i for i in state if np.all(np.abs(self._gains[i] - level) <= tolerance)]
