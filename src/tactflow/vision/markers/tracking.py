"""Track the marks of the reference frame."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from tactflow.vision.arrays import Flags, Floats, Indices
from tactflow.vision.markers import lattice
from tactflow.vision.markers.detection import (
    Detection,
    NoMarkersError,
    detect_markers,
    require_image,
    to_gray,
)
from tactflow.vision.markers.matching import (
    SEARCH_RADIUS_PITCHES,
    Interpolator,
    MarkerGraph,
    common_displacement,
    grow,
)
from tactflow.vision.markers.motion import MotionEvidence
from tactflow.vision.markers.selection import MIN_STRENGTH_RATIO, MIN_SUPPORT
from tactflow.vision.markers.spots import MIN_SIGMA_PX, RADIUS_PER_SIGMA, find_peaks
from tactflow.vision.markers.template import Alignment, MarkerTemplates
from tactflow.vision.types import Markers, MarkerStatus

SEARCH_INTERVAL_FRAMES: Final = 10
"""Number of frames between two searches for marks that stay missing. Chosen by hand."""

MAX_DISPLACEMENT_PITCHES: Final = 1.3
"""Default maximum displacement of a mark between two frames, pitches. Chosen by hand."""

JOINING_PROBABILITY: Final = 0.95
"""Minimum probability of a new mark that the reference did not show: 96 % of these are marks."""

_INFERRED: Final = np.uint8(MarkerStatus.INFERRED)
_LOST: Final = np.uint8(MarkerStatus.LOST)


class MarkerTracker:
    """Tracks the marks of a reference frame: position, status, standard error and probability of each.

    Each mark is first aligned with its template, starting from its last position. If all are found and their
    displacements form a smooth field, the frame is done. Otherwise the frame is searched for spots, and the
    largest smooth component of the field is grown: it predicts the positions of adjacent marks, which take
    the nearest spots and are aligned as before. Invisible marks are interpolated from their neighbours.

    Positions are always measured against the reference, so they do not drift; the last position is only a
    starting point. Identities rest on the smoothness of the whole field, so a wrong one does not persist.

    A mark that stays while its neighbours move, such as dirt before the camera or a reflection, is rejected
    and lost from then on. When the gel is at rest again after its first motion, marks are detected once more;
    new ones, where the lattice predicts a mark, are appended.

    Computed in float32, with templates of 16 bits; positions and standard errors agree with float64 to 1e-4
    px.

    Parameters
    ----------
    reference : (H, W, 3) uint8 BGR or (H, W) uint8, the untouched gel; or several such frames of one size,
        whose mean has less noise.
    detection : the marks of the reference. None: those that `detect_markers` finds in the first frame.
    max_displacement : maximum displacement of a mark between two frames, or from the prediction of its
        neighbours, px. Larger values cost time in the search and risk confusion. None: 1.3 times the pitch.
    valid : (H, W) uint8, non-zero where there is gel, for new marks. None: everywhere.

    Raises
    ------
    ValueError : no reference frames, or frames of different size or type.

    References
    ----------
    See the modules `template`, `spots` and `matching`.

    Examples
    --------
    >>> from tactflow.sim import open_scene
    >>> scene = open_scene("press?frames=3")
    >>> reference = scene.frame(0)
    >>> tracker = MarkerTracker(reference)
    >>> markers = tracker.track(scene.frame(1))
    >>> bool((markers.status == MarkerStatus.TRACKED).all())
    True
    """

    def __init__(
        self,
        reference: NDArray[np.uint8] | Sequence[NDArray[np.uint8]],
        detection: Detection | None = None,
        *,
        max_displacement: float | None = None,
        valid: NDArray[np.uint8] | None = None,
    ) -> None:
        frames = [reference] if isinstance(reference, np.ndarray) else list(reference)
        if not frames:
            raise ValueError("required at least one reference frame, got none")
        grays = [to_gray(frame) for frame in frames]
        if any(gray.shape != grays[0].shape for gray in grays):
            raise ValueError(f"required reference frames of one size, got {[gray.shape for gray in grays]}")
        if max_displacement is not None and not 0 < max_displacement < np.inf:
            raise ValueError(f"required max_displacement > 0 px, got {max_displacement:g}")
        detection = detection or detect_markers(frames[0], valid=valid)
        if not len(detection.centers):
            raise ValueError("required a detection of at least one mark, got none")
        mean = np.asarray(np.mean(np.stack(grays), axis=0, dtype=np.float32))
        self._shape = grays[0].shape
        self._shapes = (self._shape, (*self._shape, 3))
        self._pitch, self._radius = detection.pitch, detection.dot_radius
        self._valid, self._looked_again = valid, False
        self._prior = detection.probability
        # A visible mark moves at most across the frame; the votes for a jump take memory.
        across = float(np.hypot(*self._shape))
        self._farthest = min(max_displacement or MAX_DISPLACEMENT_PITCHES * self._pitch, across)
        self._polarity = detection.polarity
        self._origin = np.array(detection.centers, np.float64)
        dark = detection.polarity == "dark"
        self._templates = MarkerTemplates(mean, self._origin, _radii(detection), dark)
        self._sigma = max(self._radius / RADIUS_PER_SIGMA, MIN_SIGMA_PX)
        peaks, strength = find_peaks(mean, self._sigma, self._polarity, 0.0)
        usual = strength[KDTree(peaks).query(self._origin)[1]] if len(peaks) else np.ones(1)
        self._least = MIN_STRENGTH_RATIO * float(np.median(usual))
        self._know(self._origin, detection.edges)
        self.reset()

    def _know(self, origin: Floats, edges: Indices) -> None:
        """Set the marks of the reference, (N, 2) px, and what depends on them; edges : (E, 2)."""
        self._origin, self._count = origin, len(origin)
        self._graph = MarkerGraph(origin, edges)
        self._interpolator = Interpolator(origin, self._pitch)
        nearest = lattice.nearest(origin, 1)[0][:, :1]
        self._apart = nearest[:, 0] if nearest.size else np.full(self._count, self._pitch)

    def reset(self) -> None:
        """Forget what was tracked; the reference stays."""
        self._position = self._origin.copy()
        self._seen = np.ones(self._count, bool)
        self._age = 0
        self._evidence = self._weigh(np.zeros(self._count))
        self._has_moved = False

    def _weigh(self, against: Floats) -> MotionEvidence:
        """Motion evidence that starts from known evidence (N,) against the marks."""
        prior = np.full(self._count, np.nan) if self._prior is None else self._prior
        return MotionEvidence(self._origin, self._pitch, prior, against)

    def track(self, image: NDArray[np.uint8]) -> Markers:
        """Track the marks in one frame.

        image : (H, W, 3) uint8 BGR or (H, W) uint8, of the reference's size.
        Returns new arrays; `stderr` is NaN for invisible marks, and new marks are appended. Raises ValueError
        for another size.
        """
        if image.shape not in self._shapes or image.dtype != np.uint8:
            require_image(image)
            raise ValueError(f"required a frame of (height, width) {self._shape}, got {image.shape[:2]}")
        image = np.ascontiguousarray(image)
        found = self._align(image, self._position)
        smooth, torn = self._graph.check(found.position, found.seen)
        # If marks stay missing, search again from time to time.
        missing = np.count_nonzero(found.seen) < self._count - len(self._evidence.left)
        self._age = self._age + 1 if missing else 0
        if torn or self._age >= SEARCH_INTERVAL_FRAMES or (missing and (self._seen & ~found.seen).any()):
            found = self._search(image, found, smooth)
            self._age = 0
        position, stderr, seen = found
        # All TRACKED, which is 0; `np.full` takes three times as long.
        status = np.zeros(self._count, np.uint8)
        errors = stderr.astype(np.float64)
        if not seen.all():
            errors[~seen], status[~seen] = np.nan, _LOST
            position[~seen] = self._position[~seen]
            status[self._interpolator.place(position, seen)] = _INFERRED
        self._position, self._seen = position, seen
        moves = self._evidence.add(position - self._origin, stderr, seen)
        left = self._evidence.left
        seen[left], errors[left], status[left] = False, np.nan, _LOST
        self._has_moved = self._has_moved or moves
        if self._has_moved and not (moves or self._looked_again) and 2 * np.count_nonzero(seen) > len(seen):
            self._looked_again = True
            if self._join(image):
                return self.track(image)
        probability = None if self._prior is None else self._evidence.probability
        return Markers(self._origin.copy(), position.copy(), status, errors, self._radius, probability)

    def _align(self, image: NDArray[np.uint8], start: Floats) -> Alignment:
        """Align the marks from starting points (N, 2), px; rejected marks count as invisible."""
        found = self._templates.align(image, start)
        found.seen[self._evidence.left] = False
        return found

    def _join(self, image: NDArray[np.uint8]) -> bool:
        """Append marks of a frame at rest that the reference did not show; returns whether there are any."""
        try:
            radius = min(max(1.0, self._radius), min(self._shape) / 4)
            found = detect_markers(image, dot_radius=radius, polarity=self._polarity, valid=self._valid)
        except NoMarkersError:
            return False
        if found.probability is None or self._prior is None:
            return False
        joins = (found.probability > JOINING_PROBABILITY) & (
            lattice.support(found.centers, lattice.Lattice(self._position).predicted) >= MIN_SUPPORT
        )
        joins &= _are_apart(found.centers, self._position, self._pitch / 2)
        if not joins.any():
            return False
        centers, known = found.centers[joins], np.arange(self._count + int(joins.sum())) < self._count
        self._templates.add(to_gray(image).astype(np.float32), centers, _radii(found)[joins])
        # Their positions in the reference follow from the motion of the marks around.
        origin = np.concatenate([self._origin, centers])
        placed = np.concatenate([self._position, centers])
        Interpolator(origin, self._pitch).place(placed, known)
        origin[~known] -= placed[~known] - centers
        self._know(origin, lattice.neighbour_graph(origin, lattice.MAX_LINK_PITCHES * self._pitch))
        self._prior = np.concatenate([self._prior, found.probability[joins]])
        self._evidence = self._weigh(np.append(self._evidence.against, np.zeros(len(centers))))
        self._position = np.concatenate([self._position, centers])
        self._seen = np.concatenate([self._seen, known[~known]])
        return True

    def _search(self, image: NDArray[np.uint8], found: Alignment, smooth: Flags) -> Alignment:
        """Assign spots to the marks outside the largest smooth component of the field, and align them."""
        gray = to_gray(image).astype(np.float32)
        spots, _ = find_peaks(gray, self._sigma, self._polarity, self._least)
        inliers = self._best_start(image, found, smooth, spots)
        # The position of a visible mark that is not an inlier is a spot like any other.
        own = found.position[found.seen & ~inliers]
        spots = np.concatenate([spots, own[_are_apart(own, spots, SEARCH_RADIUS_PITCHES * self._pitch)]])
        spots = spots[_are_apart(spots, found.position[inliers], SEARCH_RADIUS_PITCHES * self._pitch)]
        found.position[~inliers], found.seen[~inliers] = self._position[~inliers], False
        reach = np.minimum(SEARCH_RADIUS_PITCHES * self._apart, self._farthest)
        marks, chosen = grow(found.position, inliers, spots, self._interpolator, reach)
        if len(marks):
            found.put(marks, self._templates.align(image, spots[chosen], marks))
            found.seen[self._evidence.left] = False
        return found

    def _best_start(self, image: NDArray[np.uint8], found: Alignment, smooth: Flags, spots: Floats) -> Flags:
        """Align each grid from the start with the most inliers, in place; returns the inliers, (N,): the
        largest smooth component.

        A grid that was aligned a pitch off is as smooth as the correct one; only the number of its visible
        marks reveals the error. So for a grid with missing marks, two more starts are tried: its rest
        position, and the displacement that most pairs of a mark and a spot vote for.
        """
        inliers = self._graph.largest_component(found.seen, smooth)
        # A grid of N marks that is a pitch off misses a row, which has about sqrt(N) marks.
        torn = [grid for grid in self._graph.grids if 2 * np.count_nonzero(~inliers[grid]) > len(grid) ** 0.5]
        if not torn:
            return inliers
        jumped = self._position.copy()
        for grid in torn:
            jumped[grid] += common_displacement(jumped[grid], spots, self._pitch, self._farthest)
        for start in (self._origin, jumped):
            other = self._align(image, start)
            smooth, _ = self._graph.check(other.position, other.seen)
            there = self._graph.largest_component(other.seen, smooth)
            for grid in torn:
                if np.count_nonzero(there[grid]) > np.count_nonzero(inliers[grid]):
                    inliers[grid] = there[grid]
                    found.put(grid, other.take(grid))
        return inliers


def _radii(detection: Detection) -> Floats:
    """Radius (N,) of each mark, px."""
    count, radii = len(detection.centers), detection.radii
    return np.full(count, detection.dot_radius) if radii is None else radii


def _are_apart(points: Floats, others: Floats, distance: float) -> Flags:
    """Whether each point (n, 2) is farther than a distance, px, from all others (m, 2); (n,)."""
    if not (len(points) and len(others)):
        return np.ones(len(points), bool)
    return np.asarray(KDTree(others).query(points)[0] > distance)
