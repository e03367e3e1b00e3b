"""Whether the markers move as an object that touches the gel moves them."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from tactflow.vision.arrays import Flags, Floats, Indices, Points
from tactflow.vision.compiled import kernel
from tactflow.vision.markers.lattice import MAX_LINK_PITCHES, neighbour_graph, pitch_of
from tactflow.vision.types import Markers, MarkerStatus

MIN_MOVING_NEIGHBOURS: Final = 3
"""Neighbouring markers that must have moved: a single one may have been confused with another."""
MAX_NEIGHBOUR_PAIRS: Final = 15
"""Largest number of pairs among the neighbours of a marker, of which there are up to six."""
LOW_THRESHOLD_FRACTION: Final = 0.6
"""Low hysteresis threshold, as a fraction of the threshold for motion. Chosen by hand."""
UNLIT_THRESHOLD_RATIO: Final = 3.0
"""Threshold for a contact that the light does not show, over that for motion: its region is coarse, and where
the light responds at all it shows most contacts earlier. Chosen on the simulator's press, whose first frames
had a region of ten times the area, and on sts_640 and tactip_video, of which no contact is lost."""
MAX_AVERAGED_FRAMES: Final = 4
"""Largest number of consecutive frames of motion that are averaged: the error of a mean of n is smaller by
the root of n, so that less motion is enough. Chosen on every second recording of franka_mini."""
FADING_RATIO: Final = 0.7
"""Motion relative to the frame before below which a contact is ending and is not averaged. Chosen by hand."""
REST_FRACTION: Final = 0.5
"""Fraction of the threshold up to which a marker is at rest. Chosen by hand."""
DECAY_PER_FRAME: Final = 0.96
"""Decay of the strongest recent motion per frame: half in 17 frames, as for the light."""
CONTACT_STRAIN_FRACTION: Final = 0.7
"""Fraction of the largest strain above which a marker is in contact: a contact drags all gel around it along,
but strains it most at its border. Chosen on the simulator, mini_ball and gelslim_ball, where the region then
overlaps the true one by 0.3 to 0.7 (IoU, medians), and less where a contact slides."""
_TRACKED: Final = int(MarkerStatus.TRACKED)


class Motion(NamedTuple):
    """Motion of the markers in one frame.

    Attributes
    ----------
    moving : whether neighbouring markers have moved in a way that no motion of the whole gel explains.
    clearly : whether they have moved so far that it is a contact, whatever the light shows.
    largest : the third largest of their motions, px; 0 with fewer than three tracked markers.
    left : (N,) float64, the motion of each tracked marker that no motion of the whole gel explains, px; 0
        of others.
    bound : (N,) float64, threshold for motion, px.
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
        return np.asarray(self.left <= REST_FRACTION * self.bound)


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
        levers = arms / np.maximum((arms * arms).sum(axis=1, keepdims=True), 1.0)
        self._rest = np.ascontiguousarray(np.hstack([self._origin, arms, levers]).T)
        self._variance = steadiness**2
        self._relaxation = relaxation
        self.pitch = pitch_of(self._origin) if count > 1 else 0.0
        """Median distance of a marker to its nearest neighbour, px; 0 for fewer than two."""
        self._links = neighbour_graph(self._origin, MAX_LINK_PITCHES * self.pitch)
        # A motion in a plane exceeds k standard deviations with exp(-k^2 / 2); three must at once.
        alone = (false_alarms / (MAX_NEIGHBOUR_PAIRS * max(1, count))) ** (1 / MIN_MOVING_NEIGHBOURS)
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
        left, bound = np.zeros(self.count), np.empty(self.count)
        largest, chain = rate_motion(
            np.ascontiguousarray(markers.position, np.float64),
            markers.status == _TRACKED,
            np.ascontiguousarray(markers.stderr, np.float64),
            self._rest,
            self._links,
            self._limit,
            self._variance,
            self._relaxation * self._strongest,
            left,
            bound,
            MIN_MOVING_NEIGHBOURS,
        )
        self._lasted = min(self._lasted + 1, MAX_AVERAGED_FRAMES) if self._moving else 1
        alone = (
            UNLIT_THRESHOLD_RATIO
            if largest < FADING_RATIO * self._largest
            else UNLIT_THRESHOLD_RATIO / math.sqrt(self._lasted)
        )
        self._largest = largest
        # Motion beyond the far threshold is beyond the near one as well.
        self._clearly = chain > alone * (LOW_THRESHOLD_FRACTION if self._clearly else 1.0)
        self._moving = self._clearly or chain > (LOW_THRESHOLD_FRACTION if self._moving else 1.0)
        self._strongest = max(self._strongest * DECAY_PER_FRAME, largest if self._moving else 0.0)
        return Motion(self._moving, self._clearly, largest, left, bound)

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
        most = self._links[seen & (strain >= CONTACT_STRAIN_FRACTION * strain.max(initial=0.0))]
        return np.asarray(markers.position[np.unique(most)], np.float64)


@kernel
def rate_motion(
    position: Points,
    tracked: Flags,
    stderr: Floats,
    rest: Floats,
    links: Indices,
    limit: float,
    variance: float,
    resting: float,
    left: Floats,
    bound: Floats,
    min_count: int,
) -> tuple[float, float]:
    """The third largest motion, px, and the largest multiple of its threshold that each marker of a chain of
    three neighbours reaches.

    position : (N, 2), px. tracked : (N,). stderr : (N,), px, NaN where unknown. rest : (6, N), of each marker
    in the reference: x and y, and its arm, x and y from the middle of all, px; the arm over its square, 1/px.
    links : (L, 2), neighbours. limit : threshold, standard deviations. variance : of markers of an untouched
    gel, px^2. resting : motion up to which a marker of a released gel is at rest, px. left : (N,) of 0,
    filled, see `Motion`; stays 0 with fewer than `min_count` tracked markers. bound : (N,), filled, see
    `Motion`.
    """
    at, arm, lever = rest[:2].T, rest[2:4].T, rest[4:].T
    moved = position - at
    if tracked.any():
        moved = moved - np.median(moved[tracked], axis=0)
        turn = np.median((moved[:, 1] * lever[:, 0] - moved[:, 0] * lever[:, 1])[tracked])
        moved = moved + turn * np.column_stack([arm[:, 1], -arm[:, 0]])
    if tracked.sum() >= min_count:
        left[tracked] = np.hypot(*moved[tracked].T)
    bound[:] = limit * np.sqrt(stderr * stderr + variance)
    # Nothing exceeds an unknown standard error, NaN.
    counts = (left > resting) & (bound > 0)
    ratio = np.divide(left, bound, out=np.zeros_like(left), where=counts)
    both = np.vstack([links, links[:, ::-1]])
    order = np.lexsort((-ratio[both[:, 1]], both[:, 0]))
    of, beside = both[order, 0], ratio[both[order, 1]]
    # Of each marker with two neighbours, the place of the second one.
    again = np.flatnonzero(of[1:] == of[:-1]) + 1
    again = again[(again < 2) | (of[again - 2] != of[again])]
    chain = np.minimum(ratio[of[again]], beside[again])
    largest = np.sort(left)[::-1]
    return float(largest[2]) if len(largest) > 2 else 0.0, float(chain.max(initial=0.0))
