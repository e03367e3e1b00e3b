"""Whether the markers move as an object that touches the gel moves them."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from tactflow.vision.arrays import Flags, Floats, Indices, Points
from tactflow.vision.markers.lattice import LONGEST_LINK, neighbour_graph, pitch_of
from tactflow.vision.types import Markers, MarkerStatus

TOGETHER: Final = 3
"""Neighbouring markers that must have moved: a single one may have been confused with another."""
TRIPLES: Final = 15
"""Largest number of pairs among the neighbours of a marker, of which there are up to six."""
STAY: Final = 0.6
"""Low hysteresis threshold, as a fraction of the threshold for motion. Chosen by hand."""
ALONE: Final = 3.0
"""Threshold for a contact that the light does not show, over that for motion: its region is coarse, and where
the light responds at all it shows most contacts earlier. Chosen on the simulator's press, whose first frames
had a region of ten times the area, and on sts_640 and tactip_video, of which no contact is lost."""
LASTING: Final = 4
"""Largest number of consecutive frames of motion that are averaged: the error of a mean of n is smaller by
the root of n, so that less motion is enough. Chosen on every second recording of franka_mini."""
FADES: Final = 0.7
"""Motion relative to the frame before below which a contact is ending and is not averaged. Chosen by hand."""
STILL: Final = 0.5
"""Fraction of the threshold up to which a marker is at rest. Chosen by hand."""
FORGET: Final = 0.96
"""Decay of the strongest recent motion per frame: half in 17 frames, as for the light."""
STRETCHED: Final = 0.7
"""Fraction of the largest strain above which a marker is in contact: a contact drags all gel around it along,
but strains it most at its border. Chosen on the simulator, mini_ball and gelslim_ball, where the region then
overlaps the true one by 0.3 to 0.7 (IoU, medians), and less where a contact slides."""
_TRACKED: Final = int(MarkerStatus.TRACKED)


class Motion(NamedTuple):
    """Motion of the markers in one frame.

    moving : whether neighbouring markers have moved in a way that no motion of the whole gel explains.
    clearly : whether they have moved so far that it is a contact, whatever the light shows.
    largest : the third largest of their motions, px; 0 with fewer than three tracked markers.
    left : (N,) float64, the motion of each tracked marker that no motion of the whole gel explains, px; 0 of
    others. bound : (N,) float64, threshold for motion, px.
    """

    moving: bool
    clearly: bool
    largest: float
    left: Floats
    bound: Floats

    def still(self) -> Flags:
        """Markers (N,) bool that are at rest: their motion is below half the threshold.

        A marker with an unknown standard error, such as one that is not tracked, is not at rest.
        """
        return np.asarray(self.left <= STILL * self.bound)


class MotionTest:
    """Tests whether markers have moved against each other, beyond their standard errors.

    A motion of the whole gel, or of the camera, is not a contact: both are stiff, so that it is a shift and a
    turn. These are estimated by medians, which follow the majority of the markers, and removed. The rest of a
    tracked marker's motion is compared with its standard error, combined with `steadiness`. Markers that are
    inferred or lost have no vote.

    Parameters
    ----------
    origin : (N, 2) float64, markers in the reference frame, px.
    false_alarms : rate of frames of an untouched gel in which markers seem to move, in (0, 1), if the errors
        of neighbours are independent.
    steadiness : standard deviation of each coordinate of the markers of an untouched gel, px. Higher misses
        lighter contacts.
    relaxation : fraction of the strongest recent motion that a gel may still show after its release, [0, 1).

    Raises
    ------
    ValueError : a parameter out of its range.

    References
    ----------
    P. J. Rousseeuw, A. M. Leroy, "Robust Regression and Outlier Detection", 1987, for fits by medians.

    Examples
    --------
    >>> origin = np.array([[x, y] for y in range(0, 100, 20) for x in range(0, 100, 20)], float)
    >>> test = MotionTest(origin)
    >>> status, stderr = np.zeros(25, np.uint8), np.full(25, 0.02)
    >>> test(Markers(origin, origin + [3.0, 1.0], status, stderr)).moving  # all alike
    False
    >>> pressed = origin.copy()
    >>> pressed[[6, 7, 8]] += [2.0, 0.0]
    >>> test(Markers(origin, pressed, status, stderr)).moving
    True
    """

    def __init__(
        self,
        origin: Points,
        *,
        false_alarms: float = 1e-6,
        steadiness: float = 0.14,
        relaxation: float = 0.1,
    ) -> None:
        if not 0 < false_alarms < 1:
            raise ValueError(f"false_alarms: required in (0, 1), got {false_alarms}")
        if not (steadiness > 0 and math.isfinite(steadiness)):
            raise ValueError(f"steadiness: required > 0 px, got {steadiness}")
        if not 0 <= relaxation < 1:
            raise ValueError(f"relaxation: required in [0, 1), got {relaxation}")
        self._origin = np.array(origin, np.float64)
        self.count = count = len(self._origin)
        """Number of markers."""
        arms = self._origin - (self._origin.mean(axis=0) if count else 0.0)
        # Motion of each marker in a turn by 1 radian about the centre; the same over its squared length.
        self._turning = arms[:, ::-1] * [-1.0, 1.0]
        self._levers = self._turning / np.maximum((arms * arms).sum(axis=1, keepdims=True), 1.0)
        self._variance = steadiness**2
        self._relaxation = relaxation
        self.pitch = pitch_of(self._origin) if count > 1 else 0.0
        """Median distance of a marker to its nearest neighbour, px; 0 for fewer than two."""
        self._links = neighbour_graph(self._origin, LONGEST_LINK * self.pitch)
        self._neighbours = _neighbours(self._links, count)
        # A motion in a plane exceeds k standard deviations with exp(-k^2 / 2); three must at once.
        alone = (false_alarms / (TRIPLES * max(1, count))) ** (1 / TOGETHER)
        self._limit = math.sqrt(-2 * math.log(alone))
        self._strongest = 0.0
        self._moving = self._clearly = False
        self._lasted, self._largest = 1, 0.0

    def __call__(self, markers: Markers) -> Motion:
        """Test the markers of one frame, in order.

        Raises ValueError if they are not as many as in the reference.
        """
        if len(markers.position) != len(self._origin):
            raise ValueError(f"required {len(self._origin)} markers, got {len(markers.position)}")
        left = self._unexplained(markers)
        bound = self._limit * np.sqrt(np.square(markers.stderr) + self._variance)
        ratio = np.zeros(self.count + 1)
        # Nothing exceeds an unknown standard error.
        exceeds = (left > self._relaxation * self._strongest) & (bound > 0)
        np.divide(left, bound, out=ratio[:-1], where=exceeds)
        second = np.sort(ratio[self._neighbours], axis=1)[:, -2]
        chain = float(np.minimum(ratio[:-1], second).max(initial=0.0))
        largest = float(np.sort(left)[-TOGETHER]) if len(left) >= TOGETHER else 0.0
        self._lasted = min(self._lasted + 1, LASTING) if self._moving else 1
        alone = ALONE if largest < FADES * self._largest else ALONE / math.sqrt(self._lasted)
        self._largest = largest
        # Motion beyond the far threshold is beyond the near one as well.
        self._clearly = chain > alone * (STAY if self._clearly else 1.0)
        self._moving = self._clearly or chain > (STAY if self._moving else 1.0)
        self._strongest = max(self._strongest * FORGET, largest if self._moving else 0.0)
        return Motion(self._moving, self._clearly, largest, left, bound)

    def _unexplained(self, markers: Markers) -> Floats:
        """(N,), `Motion.left`: the residual after a shift and a turn, estimated by medians."""
        seen = markers.status == _TRACKED
        if np.count_nonzero(seen) < TOGETHER:
            return np.zeros(self.count)
        moved = markers.position - self._origin
        moved -= _median(moved[seen])
        moved -= _median((self._levers * moved).sum(axis=1)[seen]) * self._turning
        return np.where(seen, np.hypot(moved[:, 0], moved[:, 1]), 0.0)

    def stretched(self, markers: Markers) -> Points:
        """Positions (K, 2), px, of the markers at the most strained links between tracked ones.

        Empty where no two neighbours are tracked.
        """
        first, second = self._links.T
        tracked = markers.status == _TRACKED
        seen = tracked[first] & tracked[second]
        moved = markers.position - self._origin
        length = np.hypot(*(self._origin[first] - self._origin[second]).T)
        strain = np.hypot(*(moved[first] - moved[second]).T) * seen / length
        most = self._links[seen & (strain >= STRETCHED * strain.max(initial=0.0))]
        return np.asarray(markers.position[np.unique(most)], np.float64)


def _median(values: Floats) -> Floats:
    """Median of numbers or of rows, along the first axis. `np.median` takes four times as long."""
    ordered, count = np.sort(values, axis=0), len(values)
    return np.asarray((ordered[(count - 1) // 2] + ordered[count // 2]) / 2)


def _neighbours(links: Indices, count: int) -> Indices:
    """(N, K), K >= 2, neighbours of each of `count` markers, filled up with `count`. links : (L, 2)."""
    both = np.concatenate([links, links[:, ::-1]])
    first, second = both[np.argsort(both[:, 0], kind="stable")].T
    place = np.arange(len(first)) - np.searchsorted(first, first)
    neighbours = np.full((count, max(place.max(initial=0) + 1, 2)), count)
    neighbours[first, place] = second
    return neighbours
