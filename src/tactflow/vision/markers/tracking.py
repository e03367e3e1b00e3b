"""Where every mark of the reference frame is now."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision import compiled
from tactflow.vision.markers import matching, tracking_kernels
from tactflow.vision.markers.detection import Detection, refine_centers, require_image, to_gray
from tactflow.vision.markers.template import MarkerAppearance
from tactflow.vision.types import Markers, MarkerStatus

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

# A mark is lost when the weights of the found marks around it (one a pitch away has 0.66) sum to less.
_LEAST_SUPPORT: Final = 0.6
# Neighbours whose displacements differ by less than this share of their distance are beyond doubt.
_STEEP: Final = 0.4
_TRACKED: Final = np.uint8(MarkerStatus.TRACKED)
# This ridge turns a quadratic fit into a plane, and a plane into a mean, where there is too little to fit it.
_RIDGE: Final = np.diag([1e-9, 0.05, 0.05, 0.3, 0.3, 0.3])
# Spots for which there is room at first.
_ROOM: Final = 1024


class _Spots:
    """Finds spots of the marks' size anywhere in a frame: a difference of Gaussians at low resolution."""

    def __init__(self, reference: NDArray[np.uint8], detection: Detection) -> None:
        self._factor = 1
        while detection.dot_radius / self._factor >= 2.3:
            self._factor *= 2
        radius = detection.dot_radius / self._factor
        self._narrow = max(radius / 1.83, 0.8)
        self._wide = float(np.sqrt(1.6**2 - 1.0) * self._narrow)
        self._sign = 1.0 if detection.polarity == "dark" else -1.0
        size = 2 * max(1, round(0.7 * radius)) + 1
        self._neighbourhood = np.ones((size, size), np.uint8)
        self._margin = 3 * detection.dot_radius + 2 * self._factor
        response = self._response(reference)
        where = np.rint(self._shrink_points(detection.centers)).astype(np.int64)
        where = np.clip(where, 0, np.array([response.shape[1] - 1, response.shape[0] - 1]))
        self.typical = max(float(np.median(response[where[:, 1], where[:, 0]])), 1.0)

    def _shrink_points(self, points: FloatArray) -> FloatArray:
        return (points - (self._factor - 1) / 2) / self._factor

    def _response(self, gray: NDArray[np.uint8]) -> NDArray[np.float32]:
        factor = self._factor
        if factor > 1:
            height, width = gray.shape[0] // factor, gray.shape[1] // factor
            cut = gray[: height * factor, : width * factor]
            gray = np.asarray(cv2.resize(cut, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
        narrow = cv2.GaussianBlur(
            gray.astype(np.float32), (0, 0), self._narrow, borderType=cv2.BORDER_REPLICATE
        )
        wide = cv2.GaussianBlur(narrow, (0, 0), self._wide, borderType=cv2.BORDER_REPLICATE)
        response = cv2.subtract(wide, narrow) if self._sign > 0 else cv2.subtract(narrow, wide)
        return np.asarray(response, np.float32)

    def find(
        self, image: NDArray[np.uint8], least: float, low: FloatArray, high: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Spots (M, 2), px, between two corners, and their strength (M,), 1 for a typical mark."""
        factor = self._factor
        left, top = (max(int((side - self._margin) // factor) * factor, 0) for side in low.tolist())
        right, bottom = (max(int(side + self._margin), 0) for side in high.tolist())
        image = image[top:bottom, left:right]
        if min(image.shape[:2]) < 3 * factor:
            return np.zeros((0, 2)), np.zeros(0)
        response = self._response(_gray_part(image))
        points, value = self._peaks(response, least * self.typical)
        strength = np.asarray(value / self.typical, np.float64)
        return points * factor + ((factor - 1) / 2 + left, (factor - 1) / 2 + top), strength

    def _peaks(self, response: NDArray[np.float32], least: float) -> tuple[FloatArray, NDArray[np.float32]]:
        """Highest pixels of their neighbourhood, (M, 2) with the vertex of a parabola along each axis, and
        their response (M,)."""
        if compiled.active():
            room = _ROOM
            while True:
                points, value = np.empty((room, 2)), np.empty(room, np.float32)
                count = tracking_kernels.peaks(response, least, len(self._neighbourhood) // 2, points, value)
                if count <= room:
                    return points[:count], value[:count]
                room = count
        highest = cv2.dilate(response, self._neighbourhood)
        # Above `least` is the same as at least the next number in this precision.
        np.maximum(highest, np.nextafter(np.float32(least), np.float32(np.inf)), out=highest)
        peak = cv2.compare(response, highest, cv2.CMP_GE)
        peak[0] = peak[-1] = 0
        peak[:, 0] = peak[:, -1] = 0
        at = np.flatnonzero(peak)
        width = response.shape[1]
        rows, columns = np.divmod(at, width)
        flat = response.ravel()
        value = flat.take(at)
        points = np.empty((len(at), 2))
        for axis, (whole, step) in enumerate(((columns, 1), (rows, width))):
            before, after = flat.take(at - step), flat.take(at + step)
            bend = np.minimum(before + after - 2 * value, np.float32(-1e-6))
            offset = 0.5 * (before - after) / bend
            points[:, axis] = whole + np.minimum(np.maximum(offset, -0.5), 0.5)
        return points, value


class MarkerTracker:
    """Follows the marks of a reference frame: position, status and standard error of each.

    What is known of a frame comes from three steps. First each mark is measured against its own look in the
    reference, starting where it was last seen; where all marks are found and their displacements form a
    smooth field, this is the answer. Otherwise spots are searched in the whole frame, and the marks that do
    not belong to the largest smooth part of the field choose among them, jointly, so that neighbours move
    alike (min-sum belief propagation on the graph of neighbours). Then every choice is measured as before.
    Marks that are not seen are placed by a quadratic fit to the displacements around them.

    A position is always measured against the reference, never against the frame before, so nothing drifts;
    what a mark did before only serves as a starting point, and identities rest on the smoothness of the whole
    displacement field, so a wrong one does not survive.

    Measured in float32; positions and standard errors are those of float64 to 1e-4 px, and those with numba
    are those without to 1e-5 px where no step is at the edge of being repeated.

    Parameters
    ----------
    reference : (H, W, 3) uint8 BGR or (H, W) uint8, the untouched gel; or several such frames of one size,
        whose mean has less noise.
    detection : the marks of the reference; with several frames, their centres are taken again from the mean.
    max_displacement : farthest a mark may go between two frames, or from where its neighbours suggest, px.
        Larger values cost time in the search and admit more confusion. None: 1.3 times the pitch.

    Raises
    ------
    ValueError : no reference frames, or frames of different size or kind.

    References
    ----------
    Lucas and Kanade (1981); Hager and Belhumeur, "Efficient region tracking with parametric models of
    geometry and illumination", PAMI 20 (1998); Baker and Matthews, "Lucas-Kanade 20 years on", IJCV 56
    (2004); Lowe, IJCV 60 (2004), for the spots; Felzenszwalb and Huttenlocher, "Efficient belief propagation
    for early vision", IJCV 70 (2006).
    """

    def __init__(
        self,
        reference: NDArray[np.uint8] | Sequence[NDArray[np.uint8]],
        detection: Detection,
        *,
        max_displacement: float | None = None,
    ) -> None:
        frames = [reference] if isinstance(reference, np.ndarray) else list(reference)
        if not frames:
            raise ValueError("required at least one reference frame, got none")
        grays = [to_gray(frame) for frame in frames]
        if any(gray.shape != grays[0].shape for gray in grays):
            raise ValueError(f"required reference frames of one size, got {[gray.shape for gray in grays]}")
        if max_displacement is not None and not 0 < max_displacement < np.inf:
            raise ValueError(f"required max_displacement > 0 px, got {max_displacement:g}")
        mean = np.asarray(np.mean(np.stack(grays), axis=0, dtype=np.float32))
        self._shape = grays[0].shape
        self._shapes = (self._shape, (*self._shape, 3))
        self._origin = np.array(detection.centers, np.float64)
        if len(grays) > 1:
            dark = mean if detection.polarity == "dark" else 255 - mean
            self._origin = refine_centers(dark, self._origin, detection.dot_radius)
        self._count = len(self._origin)
        self._pitch = detection.pitch
        self._radius = detection.dot_radius
        self._farthest = max_displacement or 1.3 * detection.pitch
        self._appearance = MarkerAppearance(
            mean, self._origin, detection.dot_radius, detection.polarity == "dark"
        )
        self._spots = _Spots(np.rint(mean).astype(np.uint8), detection)
        self._edges = np.ascontiguousarray(detection.edges, np.int64).reshape(-1, 2)
        if len(self._edges) and not 0 <= self._edges.min() <= self._edges.max() < self._count:
            raise ValueError(
                f"required edges between marks 0 to {self._count - 1}, got {self._edges.tolist()}"
            )
        self._edge_length = np.linalg.norm(
            self._origin[self._edges[:, 0]] - self._origin[self._edges[:, 1]], axis=1
        )
        self._edge_first, self._edge_second = map(np.ascontiguousarray, self._edges.T)
        self._neighbours: list[list[tuple[int, int]]] = [[] for _ in range(self._count)]
        for number, (first, second) in enumerate(self._edges.tolist()):
            self._neighbours[first].append((second, number))
            self._neighbours[second].append((first, number))
        degree = [len(links) for links in self._neighbours]
        usual = sorted(degree)[len(degree) // 2]
        self._rim = np.array([links < usual for links in degree])
        self._enough_rim = 0.85 * np.count_nonzero(self._rim)
        self._rim_weight = [3 if links < usual else 1 for links in degree]
        self._island = _islands(self._neighbours)
        links = [link for of_mark in self._neighbours for link in of_mark]
        self._links = np.array(links, np.int64).reshape(-1, 2)
        self._rim_weights, self._islands = np.array(self._rim_weight), np.array(self._island, np.int64)
        self._links_begin = np.cumsum([0, *degree], dtype=np.int64)
        self._cell = 0.12 * self._pitch
        self._raster_shape = tuple(int(side / self._cell) + 2 for side in self._shape)
        self._around_spot, self._around_mark = self._disc(0.35), self._disc(0.3)
        self._around, self._around_weight = _surroundings(self._origin, self._pitch)
        self.reset()

    def reset(self) -> None:
        """Forget what was tracked; the reference stays."""
        self._position = self._origin.copy()
        self._seen = np.ones(self._count, bool)
        self._steepest = np.full(len(self._edges), _STEEP)
        self._age = 0

    def track(self, image: NDArray[np.uint8]) -> Markers:
        """Find the marks in one frame.

        image : (H, W, 3) uint8 BGR or (H, W) uint8, of the reference's size.
        Returns fresh arrays; `stderr` is NaN for marks that are not seen. Raises ValueError for another size.
        """
        if image.shape not in self._shapes or image.dtype != np.uint8:
            require_image(image)
            raise ValueError(f"required a frame of (height, width) {self._shape}, got {image.shape[:2]}")
        image = np.ascontiguousarray(image) if compiled.active() else to_gray(image)
        view = self._appearance.view(image)
        position, gain, share, stderr = self._appearance.measure(view, self._position)
        seen, stretch, doubt = self._judge(position, gain, share)
        self._age += 1
        # Something is missing or strongly stretched: look again now and then.
        if doubt == 2 or (doubt == 1 and self._age >= 10):
            position, seen, stderr = self._search(image, view, position, seen, stderr, stretch)
            # What this search has left stretched is no reason for another, within bounds.
            self._steepest = np.minimum(np.maximum(_STEEP, self._stretch(position) + 0.15), 0.7)
            self._age = 0
        status = np.full(self._count, _TRACKED)
        stderr = stderr.astype(np.float64)
        if doubt and not seen.all():
            stderr[~seen] = np.nan
            self._infer(position, seen, status)
        self._position, self._seen = position, seen
        return Markers(self._origin.copy(), position.copy(), status, stderr, self._radius)

    def _stretch(self, position: FloatArray) -> FloatArray:
        """By how much the displacements of neighbours differ, as a fraction of their distance: (E,)."""
        moved = position - self._origin
        change = _lengths(moved.take(self._edge_first, axis=0) - moved.take(self._edge_second, axis=0))
        return np.asarray(change / self._edge_length, np.float64)

    def _judge(
        self, position: FloatArray, gain: NDArray[Any], share: NDArray[Any]
    ) -> tuple[BoolArray, FloatArray, int]:
        """Which marks are seen, how the field is stretched, and whether measuring the marks where they were
        last may have missed or mistaken one: 0 no, 1 as long as something is missing, 2 most likely."""
        longest, restless = 0.8 * self._radius, 0.1 * self._pitch
        if compiled.active():
            seen, stretch = np.empty(self._count, np.bool_), np.empty(len(self._edges))
            doubt = tracking_kernels.judge(
                position,
                self._position,
                self._origin,
                gain,
                share,
                self._edges,
                self._edge_length,
                self._steepest,
                self._seen,
                longest,
                restless,
                _STEEP,
                seen,
                stretch,
            )
            return seen, stretch, doubt
        move = _lengths(position - self._position)
        seen = _trusted(gain, share) & (move < longest)
        stretch = self._stretch(position)
        if seen.all() and stretch.max(initial=0.0) < _STEEP:
            return seen, stretch, 0
        rough = np.flatnonzero(stretch > self._steepest)
        if (self._seen & ~seen).any() or (
            seen[self._edge_first[rough]] & seen[self._edge_second[rough]]
        ).any():
            return seen, stretch, 2
        # Something is missing or strongly stretched: look at once where the rest has moved.
        return seen, stretch, 2 if move[seen].max(initial=0.0) > restless else 1

    def _search(
        self,
        image: NDArray[np.uint8],
        view: NDArray[np.uint8],
        position: FloatArray,
        seen: BoolArray,
        stderr: NDArray[Any],
        stretch: FloatArray,
    ) -> tuple[FloatArray, BoolArray, NDArray[Any]]:
        """Joint choice among the spots of the whole frame, for marks outside the largest smooth part."""
        if np.count_nonzero(self._rim & seen) < self._enough_rim:
            jump = self._common_jump(image)
            if jump is not None:
                start = self._position + jump
                position, gain, share, stderr = self._appearance.measure(view, start)
                seen = _trusted(gain, share) & (_lengths(position - start) < 0.8 * self._radius)
                stretch = self._stretch(position)
        settled = self._largest_part(seen, stretch)
        free = np.flatnonzero(~settled)
        if len(free) == 0:
            return position, seen, stderr
        moved = position - self._origin
        common = _median(moved[settled])
        expected = np.concatenate([self._position[free], self._origin[free] + common])
        low, high = expected.min(axis=0) - self._farthest, expected.max(axis=0) + self._farthest
        expected = expected.reshape(2, len(free), 2)
        spots, strength = self._spots.find(image, 0.25, low, high)
        # What was measured without belonging to that part is a spot like any other, if it is not one already.
        own = position[free[seen[free]]]
        own = own[~self._near(own, spots, self._around_spot)]
        unclaimed = ~self._near(spots, position[settled], self._around_mark)
        spots = np.concatenate([spots[unclaimed], own])
        strength = np.concatenate([strength[unclaimed], np.full(len(own), 0.5)])
        chosen = matching.choose_spots(
            self._origin,
            self._edges,
            free,
            settled,
            moved,
            expected,
            spots,
            strength,
            pitch=self._pitch,
            farthest=self._farthest,
        )
        result, stderr, found = position.copy(), stderr.copy(), settled.copy()
        given = chosen >= 0
        self._take(view, free[given], spots[chosen[given]], result, stderr, found)
        unused = np.ones(len(spots), bool)
        unused[chosen[given]] = False
        if not found.all() and unused.any():
            # Where the field is steep, a fit to the marks around foretells better than their motions do.
            self._infer(result, found, np.empty(self._count, np.uint8))
            missing = np.flatnonzero(~found)
            away = np.hypot(*(result[missing][:, None] - spots[unused]).transpose(2, 0, 1))
            spot = away.argmin(axis=1)
            mutual = (away.argmin(axis=0)[spot] == np.arange(len(missing))) & (
                away.min(axis=1) < 0.4 * self._pitch
            )
            self._take(view, missing[mutual], spots[unused][spot[mutual]], result, stderr, found)
        return result, found, stderr

    def _common_jump(self, image: NDArray[np.uint8]) -> FloatArray | None:
        """The displacement since the last frame that nearly all marks share, if there is clearly one.

        Every pair of a mark and a spot votes for its displacement (a Hough transform; Ballard 1981). Only
        this tells a jump of the whole grid by nearly a pitch from a small one the other way, which all marks
        but those of one side would agree with.
        """
        size = np.array([self._shape[1], self._shape[0]], np.float64)
        spots, _ = self._spots.find(image, 0.4, np.zeros(2), size)
        if len(spots) == 0:
            return None
        cell = 0.1 * self._pitch
        reach = int(self._farthest / cell)
        votes = _differences(self._position, spots, (reach + 1) * cell)
        bins = np.rint(votes / cell).astype(np.int64)
        near = (np.abs(bins) <= reach).all(axis=1)
        votes, bins = votes[near], bins[near] + reach
        side = 2 * reach + 1
        counts = np.bincount(bins[:, 1] * side + bins[:, 0], minlength=side * side).reshape(side, side)
        around = cv2.boxFilter(
            counts.astype(np.float32), -1, (5, 5), normalize=False, borderType=cv2.BORDER_CONSTANT
        )
        row, column = np.unravel_index(int(np.argmax(around)), around.shape)
        agree = (np.abs(bins - (column, row)) <= 2).all(axis=1)
        most = int(agree.sum())
        around[max(row - 5, 0) : row + 6, max(column - 5, 0) : column + 6] = 0
        if most < 0.75 * self._count or most < float(around.max()) + max(2.0, 0.05 * self._count):
            return None
        return np.asarray(votes[agree].mean(axis=0), np.float64)

    def _take(
        self,
        view: NDArray[np.uint8],
        marks: IntArray,
        spots: FloatArray,
        position: FloatArray,
        stderr: NDArray[Any],
        found: BoolArray,
    ) -> None:
        """Measure marks at their spots and enter what is found, in place."""
        if len(marks) == 0:
            return
        measured, gain, share, error = self._appearance.measure(view, spots, marks)
        sharp = _trusted(gain, share) & (_lengths(measured - spots) < 0.6 * self._radius + 0.5)
        position[marks] = np.where(sharp[:, None], measured, spots)
        # A spot that hardly looks like the mark any more is still its place, to a part of its radius.
        stderr[marks] = np.where(sharp, error, 0.15 * self._radius)
        found[marks] = sharp | ((gain > 0.3) & (gain < 3.0) & (share > 0.33))

    def _disc(self, distance: float) -> NDArray[np.uint8]:
        """Cells within so many pitches of a cell."""
        size = 2 * round(distance * self._pitch / self._cell) + 1
        return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)), np.uint8)

    def _near(self, points: FloatArray, others: FloatArray, disc: NDArray[np.uint8]) -> BoolArray:
        """Which points have one of the others within a disc, to a tenth of a pitch; by a raster, so that the
        cost does not grow with the product of their numbers."""
        if len(points) == 0 or len(others) == 0:
            return np.zeros(len(points), bool)
        height, width = self._raster_shape
        raster = np.zeros((height, width), np.uint8)
        scale, limits = 1 / self._cell, np.array([width - 1, height - 1])
        if compiled.active():
            found = np.empty(len(points), np.bool_)
            tracking_kernels.near(points, others, scale, disc, raster, found)
            return found
        column, row = np.minimum(np.maximum((others * scale + 0.5).astype(np.int64), 0), limits).T
        raster[row, column] = 1
        raster = np.asarray(cv2.dilate(raster, disc), np.uint8)
        column, row = np.minimum(np.maximum((points * scale + 0.5).astype(np.int64), 0), limits).T
        return np.asarray(raster[row, column] > 0, np.bool_)

    def _largest_part(self, seen: BoolArray, stretch: FloatArray) -> BoolArray:
        """The largest set of seen marks that are linked by edges along which the displacement is smooth.

        Marks at the rim count three times: they hardly move, so the part that holds them is the right one.
        Where the marks of the reference fall into several grids without links, each has its own part.
        """
        settled = np.zeros(self._count, np.bool_)
        if compiled.active():
            tracking_kernels.largest_part(
                seen, stretch, self._links_begin, self._links, self._rim_weights, self._islands, settled
            )
            return settled
        linked = (stretch < tracking_kernels.LINKED).tolist()
        waiting = seen.tolist()
        neighbours = self._neighbours
        best: dict[int, tuple[int, list[int]]] = {}
        for seed in range(self._count):
            if not waiting[seed]:
                continue
            waiting[seed] = False
            part = [seed]
            for mark in part:
                for other, edge in neighbours[mark]:
                    if waiting[other] and linked[edge]:
                        waiting[other] = False
                        part.append(other)
            weight = sum(map(self._rim_weight.__getitem__, part))
            island = self._island[seed]
            if weight > best.get(island, (0, []))[0]:
                best[island] = (weight, part)
        for _, part in best.values():
            settled[part] = True
        return settled

    def _infer(self, position: FloatArray, found: BoolArray, status: NDArray[np.uint8]) -> None:
        """Place the marks that were not found by a quadratic fit to the displacements around, in place."""
        missing = np.flatnonzero(~found)
        status[missing] = MarkerStatus.INFERRED
        around = self._around[missing]
        weight = self._around_weight[missing] * found[around]
        offset = (self._origin[around] - self._origin[missing][:, None]) / self._pitch
        moved = (position - self._origin)[around]
        x, y = offset[..., 0], offset[..., 1]
        basis = np.empty((*x.shape, 6))
        for number, term in enumerate((1.0, x, y, x * x, x * y, y * y)):
            basis[..., number] = term
        weighted = (basis * weight[:, :, None]).transpose(0, 2, 1)
        fitted = np.linalg.solve(weighted @ basis + _RIDGE, weighted @ moved)[:, 0]
        support = weight.sum(axis=1)
        placed = support > _LEAST_SUPPORT
        position[missing[placed]] = self._origin[missing[placed]] + fitted[placed]
        position[missing[~placed]] = self._position[missing[~placed]]
        status[missing[~placed]] = MarkerStatus.LOST


def _gray_part(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Of a part of a contiguous image, without a copy as `to_gray` makes."""
    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)


def _differences(points: FloatArray, others: FloatArray, reach: float) -> FloatArray:
    """All others - points (n, 2) whose y is within reach, so that not everything meets everything."""
    others = others[np.argsort(others[:, 1])]
    first = np.searchsorted(others[:, 1], points[:, 1] - reach)
    count = np.searchsorted(others[:, 1], points[:, 1] + reach) - first
    before = np.cumsum(count) - count
    other = np.arange(count.sum()) + np.repeat(first - before, count)
    return np.asarray(others[other] - np.repeat(points, count, axis=0), np.float64)


def _median(vectors: FloatArray) -> FloatArray:
    """Of each coordinate, (2,); zero for none. A fifth of the time of `np.median` for a hundred vectors."""
    if len(vectors) == 0:
        return np.zeros(2)
    ordered = np.sort(vectors, axis=0)
    return np.asarray((ordered[(len(vectors) - 1) // 2] + ordered[len(vectors) // 2]) / 2, np.float64)


def _lengths(vectors: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt(np.einsum("ni,ni->n", vectors, vectors)), np.float64)


def _trusted(gain: NDArray[Any], share: NDArray[Any]) -> BoolArray:
    strong = (gain > tracking_kernels.LEAST_GAIN) & (gain < tracking_kernels.MOST_GAIN)
    return np.asarray(strong & (share > tracking_kernels.LEAST_SHARE), np.bool_)


def _islands(neighbours: list[list[tuple[int, int]]]) -> list[int]:
    """For each mark the smallest mark that it is linked to, directly or through others."""
    island = [-1] * len(neighbours)
    for seed in range(len(neighbours)):
        if island[seed] >= 0:
            continue
        island[seed] = seed
        part = [seed]
        for mark in part:
            for other, _ in neighbours[mark]:
                if island[other] < 0:
                    island[other] = seed
                    part.append(other)
    return island


def _surroundings(origin: FloatArray, pitch: float) -> tuple[IntArray, FloatArray]:
    """For each mark up to 24 nearest others, and weights that fall off with distance."""
    count = len(origin)
    reach = min(24, count - 1)
    if reach < 1:
        return np.zeros((count, 0), np.int64), np.zeros((count, 0))
    near = np.empty((count, reach), np.int64)
    weight = np.empty((count, reach))
    for mark in range(count):
        squared = ((origin - origin[mark]) ** 2).sum(axis=1)
        squared[mark] = np.inf
        order = np.argsort(squared, kind="stable")[:reach]
        near[mark] = order
        weight[mark] = np.exp(-squared[order] / (2 * (1.1 * pitch) ** 2))
    weight[weight < 0.02] = 0.0
    return near, weight
