"""Where every mark of the reference frame is now."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.markers import Detection, to_gray
from tactflow.vision.types import Markers, MarkerStatus

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

# Sub-pixel phases per axis at which the reference appearance is kept: an eighth of a pixel is the farthest an
# estimate lies from one of them, where the linear model errs by far less than the noise.
_PHASES: Final = 4
# Costs of the joint choice, in units where a stretch of one half between neighbours costs 0.5: of not seeing a
# mark, and of each of its links then.
# A step is repeated, so many times at most, while it was longer than this, px: from there the linear model
# leaves less than 0.005 px.
_CONVERGED: Final = 0.25
_ROUNDS: Final = 4
_PRIOR: Final = 0.25
_MISSING: Final = 1.0
_MISSING_EDGE: Final = 0.25
# A mark is lost when the weights of the found marks around it (one at a pitch's distance has 0.66) sum to less.
_LEAST_SUPPORT: Final = 0.6


class _Appearance:
    """Measures marks against their own look in the reference, by least squares in the image as it is.

    A patch of the frame is modelled as gain * reference mark, shifted, + a plane (Lucas and Kanade 1981 with
    the illumination model of Hager and Belhumeur 1998, in the inverse form of Baker and Matthews 2004: all
    that is costly is done once for the reference). The frame is only ever read at whole pixels; it is the
    noise-free side, the reference, that is interpolated.
    """

    def __init__(self, reference: NDArray[np.float32], origin: FloatArray, radius: float) -> None:
        self.radius = radius
        reach = int(np.ceil(1.55 * radius + 1.2))
        self.pad = reach + 1
        self.shape = reference.shape
        axis = np.arange(-reach, reach + 1)
        grid_y, grid_x = np.meshgrid(axis, axis, indexing="ij")
        disc = np.hypot(grid_x, grid_y) <= 1.55 * radius + 1.2
        self._width = reference.shape[1] + 2 * self.pad
        self._offsets = (grid_y[disc] * self._width + grid_x[disc]).astype(np.int64)
        self.pixels = int(disc.sum())
        x, y = grid_x[disc].astype(np.float64), grid_y[disc].astype(np.float64)
        plane, _ = np.linalg.qr(np.column_stack([np.ones_like(x), x, y]))
        self._plane = plane.astype(np.float32)

        count = len(origin)
        self._rows = np.arange(count)
        steps = (np.arange(_PHASES) + 0.5) / _PHASES - 0.5
        pinv = np.empty((_PHASES, _PHASES, count, 3, self.pixels), np.float32)
        gram = np.empty((_PHASES, _PHASES, count, 3, 3), np.float32)
        spread = np.empty((_PHASES, _PHASES, count), np.float32)
        half = 0.25
        for row, phase_y in enumerate(steps):
            for column, phase_x in enumerate(steps):
                phase = np.array([phase_x, phase_y])

                def look(shift_x: float, shift_y: float, phase: FloatArray = phase) -> FloatArray:
                    points = origin - phase - (shift_x, shift_y)
                    return _resample(reference, points, reach)[:, disc]

                mark = look(0, 0)
                slope_x = (look(half, 0) - look(-half, 0)) / (2 * half)
                slope_y = (look(0, half) - look(0, -half)) / (2 * half)
                basis = np.stack([mark, slope_x, slope_y], axis=1)
                basis -= (basis @ plane) @ plane.T
                products = basis @ basis.transpose(0, 2, 1)
                # A trace of ridge keeps marks without contrast solvable; they are never trusted anyway.
                ridge = 1e-6 * np.trace(products, axis1=1, axis2=2) + 1e-6
                inverse = np.linalg.inv(products + ridge[:, None, None] * np.eye(3))
                pinv[row, column] = inverse @ basis
                gram[row, column] = products
                spread[row, column] = 0.5 * (inverse[:, 1, 1] + inverse[:, 2, 2])
        self._pinv = pinv.reshape(_PHASES * _PHASES * count, 3, self.pixels)
        self._gram = gram.reshape(_PHASES * _PHASES * count, 3, 3)
        self._spread = spread.reshape(_PHASES * _PHASES * count)
        self._count = count
        limits = np.array([reference.shape[1] - 1, reference.shape[0] - 1], np.float64)
        self._limits = limits

    def padded(self, gray: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The frame with a rim, flat, so that patches may reach over its border."""
        pad = self.pad
        return np.asarray(
            cv2.copyMakeBorder(gray, pad, pad, pad, pad, cv2.BORDER_REPLICATE), np.uint8
        ).ravel()

    def measure(
        self, flat: NDArray[np.uint8], start: FloatArray, marks: IntArray | None = None
    ) -> tuple[FloatArray, NDArray[Any], NDArray[Any], NDArray[Any]]:
        """Measure marks from starting points (n, 2), right to about a radius.

        marks : (n,) which marks these are; None for all.
        Returns positions (n, 2), gain (n,), explained share of the contrast (n,), standard error (n,).
        """
        marks = self._rows if marks is None else marks
        position, gain, share, stderr = self._step(flat, start, marks)
        active = np.flatnonzero(_longer(position - start, _CONVERGED))
        for _ in range(_ROUNDS):
            if len(active) == 0:
                break
            before = position[active]
            position[active], gain[active], share[active], stderr[active] = self._step(
                flat, before, marks[active]
            )
            active = active[_longer(position[active] - before, _CONVERGED)]
        return position, gain, share, stderr

    def _step(
        self, flat: NDArray[np.uint8], start: FloatArray, marks: IntArray
    ) -> tuple[FloatArray, NDArray[Any], NDArray[Any], NDArray[Any]]:
        """One least-squares step from the phase nearest to the starting points."""
        base = np.rint(np.minimum(np.maximum(start, 0.0), self._limits))
        cell = ((start - base + 0.5) * _PHASES).astype(np.int64)
        np.minimum(np.maximum(cell, 0, out=cell), _PHASES - 1, out=cell)
        corner = base.astype(np.int64) + self.pad
        index = (corner[:, 1] * self._width + corner[:, 0])[:, None] + self._offsets
        patch = flat.take(index).astype(np.float32)
        # Far from zero, sums of squares would lose digits.
        patch -= np.float32(128)
        which = (cell[:, 1] * _PHASES + cell[:, 0]) * self._count + marks
        theta = np.matmul(self._pinv[which], patch[:, :, None])[:, :, 0]
        gain = theta[:, 0]
        safe = np.maximum(gain, np.float32(0.15))
        step = theta[:, 1:] / safe[:, None]
        np.minimum(np.maximum(step, -self.radius, out=step), self.radius, out=step)
        position = base + ((cell + 0.5) / _PHASES - 0.5) + step
        seen = (np.matmul(self._gram[which], theta[:, :, None])[:, :, 0] * theta).sum(axis=1)
        level = patch @ self._plane
        total = np.einsum("nk,nk->n", patch, patch) - np.einsum("nk,nk->n", level, level)
        rest = np.maximum(total - seen, np.float32(1e-3))
        stderr = np.sqrt(rest * (self._spread[which] / max(self.pixels - 6, 1))) / safe
        return position, gain, seen / (seen + rest), stderr


class _Spots:
    """Finds spots of the marks' size anywhere in a frame, fast: a difference of Gaussians at low resolution."""

    def __init__(self, reference: NDArray[np.uint8], detection: Detection) -> None:
        self._factor = 1
        while detection.dot_radius / self._factor >= 3.4:
            self._factor *= 2
        radius = detection.dot_radius / self._factor
        self._narrow = max(radius / 1.83, 0.8)
        self._wide = float(np.sqrt(1.6**2 - 1.0) * self._narrow)
        self._sign = 1.0 if detection.polarity == "dark" else -1.0
        size = 2 * max(1, round(0.7 * radius)) + 1
        self._neighbourhood = np.ones((size, size), np.uint8)
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

    def find(self, gray: NDArray[np.uint8], least: float) -> tuple[FloatArray, FloatArray]:
        """Spots (M, 2), px, and their strength (M,) relative to the reference's marks."""
        response = self._response(gray)
        highest = cv2.dilate(response, self._neighbourhood)
        threshold = least * self.typical
        peak = cv2.compare(response, highest, cv2.CMP_GE)
        peak = cv2.bitwise_and(peak, cv2.compare(response, threshold, cv2.CMP_GT))
        peak[0] = peak[-1] = 0
        peak[:, 0] = peak[:, -1] = 0
        found = cv2.findNonZero(peak)
        if found is None:
            return np.zeros((0, 2)), np.zeros(0)
        points = found.reshape(-1, 2)
        columns, rows = points[:, 0], points[:, 1]
        value = response[rows, columns]
        result = np.empty((len(points), 2))
        for axis, (step_y, step_x) in enumerate(((0, 1), (1, 0))):
            before = response[rows - step_y, columns - step_x]
            after = response[rows + step_y, columns + step_x]
            bend = np.minimum(before + after - 2 * value, -1e-6)
            result[:, axis] = points[:, axis] + np.clip(0.5 * (before - after) / bend, -0.5, 0.5)
        return result * self._factor + (self._factor - 1) / 2, (value / self.typical).astype(np.float64)


class MarkerTracker:
    """Follows the marks of a reference frame: position, status and standard error of each.

    What is known of a frame comes from three steps. First each mark is measured against its own look in the
    reference, starting where it was last seen; where all marks are found and their displacements form a
    smooth field, this is the answer. Otherwise spots are searched in the whole frame, and the marks that do not
    belong to the largest smooth part of the field choose among them, jointly, so that neighbours move alike
    (min-sum belief propagation on the graph of neighbours). Then every choice is measured as before. Marks that
    are not seen are placed by an affine fit to their neighbours.

    A position is always measured against the reference, never against the frame before, so nothing drifts;
    what a mark did before only serves as a starting point, and identities rest on the smoothness of the whole
    displacement field, so a wrong one does not survive.

    Parameters
    ----------
    reference : (H, W, 3) uint8 BGR or (H, W) uint8, the untouched gel; or several such frames of one size, whose
        mean has less noise.
    detection : the marks of the reference.
    max_displacement : farthest a mark may go between two frames, or from where its neighbours suggest, px.
        Larger values cost time in the search and admit more confusion. None: 1.3 times the pitch.

    Raises
    ------
    ValueError : no reference frames, or frames of different size or kind.

    References
    ----------
    Lucas and Kanade (1981); Hager and Belhumeur, "Efficient region tracking with parametric models of geometry
    and illumination", PAMI 20 (1998); Baker and Matthews, "Lucas-Kanade 20 years on", IJCV 56 (2004); Lowe,
    IJCV 60 (2004), for the spots; Felzenszwalb and Huttenlocher, "Efficient belief propagation for early
    vision", IJCV 70 (2006). Seed functions `m.init`, `m.run`, `m.get_flow`.
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
        if max_displacement is not None and not max_displacement > 0:
            raise ValueError(f"required max_displacement > 0 px, got {max_displacement:g}")
        mean = np.mean(np.stack(grays), axis=0, dtype=np.float32)
        self._shape = grays[0].shape
        self._origin = np.array(detection.centers, np.float64)
        self._count = len(self._origin)
        self._pitch = detection.pitch
        self._radius = detection.dot_radius
        self._farthest = max_displacement or 1.3 * detection.pitch
        self._appearance = _Appearance(mean, self._origin, detection.dot_radius)
        self._spots = _Spots(np.rint(mean).astype(np.uint8), detection)
        self._edges = detection.edges
        self._edge_length = np.linalg.norm(
            self._origin[self._edges[:, 0]] - self._origin[self._edges[:, 1]], axis=1
        )
        self._neighbours: list[list[tuple[int, int]]] = [[] for _ in range(self._count)]
        for number, (first, second) in enumerate(self._edges.tolist()):
            self._neighbours[first].append((second, number))
            self._neighbours[second].append((first, number))
        self._around, self._around_weight = _surroundings(self._origin, self._pitch)
        self.reset()

    def reset(self) -> None:
        """Forget what was tracked; the reference stays."""
        self._position = self._origin.copy()
        self._status = np.full(self._count, MarkerStatus.TRACKED, np.uint8)
        self._age = 0

    def track(self, image: NDArray[np.uint8]) -> Markers:
        """Find the marks in one frame.

        image : (H, W, 3) uint8 BGR or (H, W) uint8, of the reference's size.
        Returns fresh arrays; `stderr` is NaN for marks that are not seen. Raises ValueError for another size.
        """
        gray = to_gray(image)
        if gray.shape != self._shape:
            raise ValueError(f"required a frame of (height, width) {self._shape}, got {gray.shape}")
        flat = self._appearance.padded(gray)
        last = self._position
        position, gain, share, stderr = self._appearance.measure(flat, last)
        move = np.hypot(*(position - last).T)
        good = _trusted(gain, share) & (move < 0.8 * self._radius)
        displacement = position - self._origin
        change = displacement[self._edges[:, 0]] - displacement[self._edges[:, 1]]
        strain = np.hypot(change[:, 0], change[:, 1]) / self._edge_length
        seen_before = self._status == MarkerStatus.TRACKED
        missing = ~good
        smooth = bool((strain < 0.4)[good[self._edges].all(axis=1)].all())
        lost_one = bool((missing & seen_before).any())
        self._age += 1
        stale = bool(missing.any()) and (
            self._age >= 10 or float(move[good].max(initial=0.0)) > 0.1 * self._pitch
        )
        if lost_one or stale or not smooth:
            self._age = 0
            position, good, stderr = self._search(gray, flat, position, good, stderr, strain)
        status = np.where(good, MarkerStatus.TRACKED, MarkerStatus.INFERRED).astype(np.uint8)
        stderr = np.where(good, stderr, np.nan).astype(np.float64)
        if not good.all():
            self._infer(position, good, status)
        self._position = position
        self._status = status
        return Markers(self._origin.copy(), position.copy(), status.copy(), stderr)

    def _search(
        self,
        gray: NDArray[np.uint8],
        flat: NDArray[np.uint8],
        position: FloatArray,
        good: BoolArray,
        stderr: NDArray[Any],
        strain: FloatArray,
    ) -> tuple[FloatArray, BoolArray, FloatArray]:
        """Joint choice among the spots of the whole frame, for marks outside the largest smooth part."""
        origin, pitch = self._origin, self._pitch
        spots, strength = self._spots.find(gray, 0.25)
        settled = self._largest_part(good, strain)
        free = np.flatnonzero(~settled)
        result = position.copy()
        stderr = np.array(stderr, np.float64)
        extra = free[good[free]]
        if len(extra):
            apart = np.ones(len(extra), bool)
            if len(spots):
                apart = _distances(position[extra], spots).min(axis=1) > 0.35 * pitch
            spots = np.concatenate([spots, position[extra[apart]]])
            strength = np.concatenate([strength, np.full(int(apart.sum()), 0.5)])
        fixed = np.flatnonzero(settled)
        if len(spots) and len(fixed):
            unclaimed = _distances(spots, position[fixed]).min(axis=1) > 0.3 * pitch
            spots, strength = spots[unclaimed], strength[unclaimed]
        found = good.copy()
        found[free] = False
        chosen = self._choose(free, settled, position, spots, strength)
        taken = free[chosen >= 0]
        if len(taken):
            start = spots[chosen[chosen >= 0]]
            measured, gain, share, error = self._appearance.measure(flat, start, taken)
            near = np.hypot(*(measured - start).T) < 0.6 * self._radius + 0.5
            sharp = _trusted(gain, share) & near
            result[taken] = np.where(sharp[:, None], measured, start)
            # A spot that does not look like the mark any more is still its place, to a part of its radius.
            stderr[taken] = np.where(sharp, error, 0.15 * self._radius)
            found[taken] = True
        missing = np.flatnonzero(~found)
        if len(missing):
            status = np.where(found, MarkerStatus.TRACKED, MarkerStatus.INFERRED).astype(np.uint8)
            self._infer(result, found, status)
        return result, found, stderr

    def _largest_part(self, good: BoolArray, strain: FloatArray) -> BoolArray:
        """The largest set of found marks that are linked by edges along which the displacement is smooth."""
        linked = (strain < 0.3).tolist()
        open_ = good.tolist()
        best: list[int] = []
        for seed in range(self._count):
            if not open_[seed]:
                continue
            open_[seed] = False
            part = [seed]
            for mark in part:
                for other, edge in self._neighbours[mark]:
                    if open_[other] and linked[edge]:
                        open_[other] = False
                        part.append(other)
            if len(part) > len(best):
                best = part
        settled = np.zeros(self._count, bool)
        settled[best] = True
        return settled

    def _choose(
        self,
        free: IntArray,
        settled: BoolArray,
        position: FloatArray,
        spots: FloatArray,
        strength: FloatArray,
    ) -> IntArray:
        """For each free mark the number of its spot, or -1."""
        count = len(free)
        if count == 0 or len(spots) == 0:
            return np.full(count, -1, np.int64)
        origin = self._origin
        before = self._position[free]
        base = np.median((position - origin)[settled], axis=0) if settled.any() else np.zeros(2)
        distance = np.minimum(_distances(before, spots), _distances(origin[free] + base, spots))
        labels = min(8, len(spots), max(1, int((distance <= self._farthest).sum(axis=1).max())))
        label = np.argsort(distance, axis=1, kind="stable")[:, :labels]
        reachable = np.take_along_axis(distance, label, axis=1) <= self._farthest
        moved = spots[label] - origin[free][:, None]
        forbidden = 1e3
        unary = np.empty((count, labels + 1))
        unary[:, :labels] = 0.4 * np.clip(1.0 - strength[label], 0, 1)
        unary[:, :labels] += _PRIOR * (np.take_along_axis(distance, label, axis=1) / self._pitch) ** 2
        unary[:, :labels][~reachable] = forbidden
        unary[:, labels] = _MISSING
        slot = np.full(self._count, -1, np.int64)
        slot[free] = np.arange(count)
        ends = slot[self._edges]
        # Neighbours that are settled pull each on its own.
        for one, other in ((0, 1), (1, 0)):
            pulled = (ends[:, one] >= 0) & settled[self._edges[:, other]]
            if pulled.any():
                mark, anchor = ends[pulled, one], self._edges[pulled, other]
                span = origin[anchor] - origin[free[mark]]
                shift = (position - origin)[anchor]
                cost = np.full((len(mark), labels + 1), _MISSING_EDGE)
                cost[:, :labels] = _disagreement(moved[mark], shift[:, None], span[:, None])
                np.add.at(unary, mark, cost)
        inner = (ends >= 0).all(axis=1)
        if inner.any():
            first, second = ends[inner].T
            span = origin[free[second]] - origin[free[first]]
            pair = np.full((len(first), labels + 1, labels + 1), _MISSING_EDGE)
            pair[:, :labels, :labels] = _disagreement(
                moved[first][:, :, None], moved[second][:, None], span[:, None, None]
            )
            same = label[first][:, :, None] == label[second][:, None]
            pair[:, :labels, :labels][same] = 4.0
            belief = _propagate(unary, first, second, pair)
        else:
            belief = unary
        choice = np.argmin(belief, axis=1)
        margin = np.take_along_axis(belief, choice[:, None], axis=1)[:, 0] - belief[:, labels]
        chosen = np.where(choice < labels, label[np.arange(count), np.minimum(choice, labels - 1)], -1)
        # Two marks cannot share a spot: the surer one keeps it.
        used: set[int] = set()
        for mark in np.argsort(margin, kind="stable").tolist():
            spot = int(chosen[mark])
            if spot in used:
                chosen[mark] = -1
            elif spot >= 0:
                used.add(spot)
        return np.asarray(chosen, np.int64)

    def _infer(self, position: FloatArray, found: BoolArray, status: NDArray[np.uint8]) -> None:
        """Place the marks that were not found by an affine fit to the displacements around them, in place."""
        missing = np.flatnonzero(~found)
        around = self._around[missing]
        weight = self._around_weight[missing] * found[around]
        offset = (self._origin[around] - self._origin[missing][:, None]) / self._pitch
        moved = (position - self._origin)[around]
        basis = np.concatenate([np.ones((*offset.shape[:2], 1)), offset], axis=2)
        weighted = basis * weight[:, :, None]
        # The ridge on the slopes turns the fit into a mean where there is too little to fit them.
        normal = weighted.transpose(0, 2, 1) @ basis + np.diag([1e-9, 0.05, 0.05])
        fitted = np.linalg.solve(normal, weighted.transpose(0, 2, 1) @ moved)[:, 0]
        support = weight.sum(axis=1)
        placed = support > _LEAST_SUPPORT
        position[missing[placed]] = self._origin[missing[placed]] + fitted[placed]
        position[missing[~placed]] = self._position[missing[~placed]]
        status[missing[~placed]] = MarkerStatus.LOST


def _longer(vectors: FloatArray, length: float) -> BoolArray:
    return np.asarray(np.einsum("ni,ni->n", vectors, vectors) > length * length, np.bool_)


def _trusted(gain: NDArray[Any], share: NDArray[Any]) -> BoolArray:
    return np.asarray((gain > 0.3) & (gain < 3.0) & (share > 0.6), np.bool_)


def _distances(first: FloatArray, second: FloatArray) -> FloatArray:
    offset = first[:, None] - second[None]
    return np.asarray(np.hypot(offset[..., 0], offset[..., 1]), np.float64)


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


def _disagreement(first: FloatArray, second: FloatArray, span: FloatArray) -> FloatArray:
    """Cost of two displacements of neighbours `span` apart: relative stretch, squared and bounded."""
    change = second - first
    squared = (span**2).sum(axis=-1)
    cost = np.minimum(2.0 * (change**2).sum(axis=-1) / squared, 1.2)
    folded = ((span + change) * span).sum(axis=-1) < 0.25 * squared
    return np.asarray(cost + 1.0 * folded, np.float64)


def _propagate(unary: FloatArray, first: IntArray, second: IntArray, pair: FloatArray) -> FloatArray:
    """Min-sum belief propagation: (n, L) costs, edges with (L, L) costs each -> (n, L) beliefs (costs)."""
    source = np.concatenate([first, second])
    target = np.concatenate([second, first])
    cost = np.concatenate([pair, pair.transpose(0, 2, 1)])
    reverse = np.concatenate([np.arange(len(first)) + len(first), np.arange(len(first))])
    gather = np.zeros((len(unary), len(source)))
    gather[target, np.arange(len(source))] = 1.0
    message = np.zeros((len(source), unary.shape[1]))
    belief = unary
    for _ in range(12):
        outgoing = belief[source] - message[reverse]
        fresh = (outgoing[:, :, None] + cost).min(axis=1)
        fresh -= fresh.min(axis=1, keepdims=True)
        message = 0.7 * fresh + 0.3 * message
        belief = unary + gather @ message
    return belief


def _resample(image: NDArray[np.float32], points: FloatArray, reach: int) -> FloatArray:
    """Patches (N, 2 reach + 1, 2 reach + 1) centred on sub-pixel points, by cubic convolution (Keys 1981)."""
    pad = reach + 4
    padded = cv2.copyMakeBorder(image, pad, pad, pad, pad, cv2.BORDER_REPLICATE)
    base = np.floor(points).astype(np.int64)
    fraction = points - base
    span = np.arange(-reach - 1, reach + 3)
    height, width = padded.shape
    rows = np.clip(base[:, 1, None] + pad + span, 0, height - 1)
    columns = np.clip(base[:, 0, None] + pad + span, 0, width - 1)
    patches = padded[rows[:, :, None], columns[:, None, :]].astype(np.float64)
    weights_x, weights_y = _cubic(fraction[:, 0]), _cubic(fraction[:, 1])
    size = 2 * reach + 1
    across = sum(patches[:, :, tap : tap + size] * weights_x[tap][:, None, None] for tap in range(4))
    return np.asarray(
        sum(across[:, tap : tap + size] * weights_y[tap][:, None, None] for tap in range(4)), np.float64
    )


def _cubic(fraction: FloatArray) -> FloatArray:
    t = fraction
    return np.stack(
        [
            ((-0.5 * t + 1.0) * t - 0.5) * t,
            (1.5 * t - 2.5) * t * t + 1.0,
            ((-1.5 * t + 2.0) * t + 0.5) * t,
            (0.5 * t - 0.5) * t * t,
        ]
    )
