"""Measure marks against their own look in the reference frame."""

from __future__ import annotations

from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision import compiled
from tactflow.vision.markers import template_kernels
from tactflow.vision.markers.detection import to_gray
from tactflow.vision.markers.template_kernels import ALIKE_GAIN, ALIKE_SHARE, LEAST_DIVISOR, LEAST_REST

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

# Sub-pixel phases per axis at which the reference look is kept: an eighth of a pixel is the farthest an
# estimate lies from one of them, where the linear model errs by far less than the noise.
_PHASES: Final = 4
# A step is repeated, so many times at most, while it was longer than this, px: from there the linear model
# leaves less than 0.005 px.
_CONVERGED: Final = 0.25
_ROUNDS: Final = 3
# Error that remains without noise, px: edges sharper than the pixels allow cannot be interpolated exactly
# (measured on rendered dots with edges of 0.5 to 0.7 px standard deviation: 0.003 to 0.005 px).
_SAMPLING: Final = 0.004
_LANES: Final = 32


class MarkerAppearance:
    """Measures marks against their own look in the reference, by least squares in the image as it is.

    A patch of the frame is modelled as light * reference mark, shifted, + a constant, where the light is a
    plane: at the edge of a contact it has a slope, and a dark mark dims this slope as it dims all light, so
    that a plane that is *added* to the mark pulls it, by up to 0.2 px. To a bright mark, whose level is its
    own, the slope is added. (Lucas and Kanade 1981 with the illumination model of Hager and Belhumeur 1998,
    in the inverse form of Baker and Matthews 2004: all that is costly is done once for the reference.) The
    frame is only ever read at whole pixels; it is the noise-free side, the reference, that is interpolated.

    reference : (H, W) float32, grey levels. origin : (N, 2) float64, px. radius : of a mark, px.
    dark : whether marks are darker than the gel.
    """

    def __init__(
        self, reference: NDArray[np.float32], origin: FloatArray, radius: float, dark: bool = True
    ) -> None:
        self.radius = radius
        reach = int(np.ceil(1.55 * radius + 1.2))
        self.pad = reach + 1
        self.shape = reference.shape
        axis = np.arange(-reach, reach + 1)
        grid_y, grid_x = np.meshgrid(axis, axis, indexing="ij")
        disc = np.hypot(grid_x, grid_y) <= 1.55 * radius + 1.2
        width = reference.shape[1] + 2 * self.pad
        self._strides = np.array([1, width])
        self._first = self.pad * (width + 1)
        self.pixels = int(disc.sum())
        self._disc = np.array([grid_x[disc], grid_y[disc]], np.int64)
        x, y = grid_x[disc] / radius, grid_y[disc] / radius

        count = len(origin)
        self._rows = np.arange(count)
        steps = (np.arange(_PHASES) + 0.5) / _PHASES - 0.5
        # Rows of whole vector registers: the pixels after the patch's own weigh nothing.
        length = -(-self.pixels // _LANES) * _LANES
        self._offsets = np.zeros(length, np.int64)
        self._offsets[: self.pixels] = self._disc[1] * width + self._disc[0]
        weights = np.zeros((_PHASES, _PHASES, count, 6, length), np.float32)
        gram = np.empty((_PHASES, _PHASES, count, 3, 3), np.float32)
        spread = np.empty((_PHASES, _PHASES, count), np.float32)
        # A slope spans the phases on either side, in binary fractions: most looks serve several times.
        half = 1 / _PHASES
        looks: dict[tuple[float, float], FloatArray] = {}

        def look(right: float, down: float) -> FloatArray:
            if (right, down) not in looks:
                looks[right, down] = _resample(reference, origin - (right, down), reach)[:, disc]
            return looks[right, down]

        for row, phase_y in enumerate(steps.tolist()):
            for column, phase_x in enumerate(steps.tolist()):
                mark = look(phase_x, phase_y)
                slope_x = (look(phase_x + half, phase_y) - look(phase_x - half, phase_y)) / (2 * half)
                slope_y = (look(phase_x, phase_y + half) - look(phase_x, phase_y - half)) / (2 * half)
                lit = mark if dark else np.ones_like(mark)
                plane, _ = np.linalg.qr(np.stack([np.ones_like(lit), lit * x, lit * y], axis=2))
                basis = np.stack([mark, slope_x, slope_y], axis=1)
                basis -= (basis @ plane) @ plane.transpose(0, 2, 1)
                products = basis @ basis.transpose(0, 2, 1)
                # A trace of ridge keeps marks without contrast solvable; they are never trusted anyway.
                ridge = 1e-6 * np.trace(products, axis1=1, axis2=2) + 1e-6
                inverse = np.linalg.inv(products + ridge[:, None, None] * np.eye(3))
                weights[row, column, :, :3, : self.pixels] = inverse @ basis
                weights[row, column, :, 3:, : self.pixels] = plane.transpose(0, 2, 1)
                gram[row, column] = products
                spread[row, column] = 0.5 * (inverse[:, 1, 1] + inverse[:, 2, 2])
        # Of each mark at each phase: what gives gain and shift, and the light's plane, orthonormal.
        self._weights = weights.reshape(_PHASES * _PHASES * count, 6, length)
        self._gram = gram.reshape(_PHASES * _PHASES * count, 3, 3)
        self._spread = spread.reshape(_PHASES * _PHASES * count) / np.float32(max(self.pixels - 6, 1))
        self._phase_strides = np.array([count, _PHASES * count])
        self._limits = np.array([reference.shape[1] - 1, reference.shape[0] - 1], np.float64)
        self._whole = np.array([reach, _PHASES, _ROUNDS])
        self._real = np.array([radius, _CONVERGED, _SAMPLING])

    def view(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """What `measure` wants of an image (H, W, 3) BGR or (H, W) grey.

        Compiled, it reads the pixels around the marks, (H, W, channels); otherwise all are made grey, with a
        rim, so that patches may reach over the border, flat.
        """
        if compiled.active():
            return np.ascontiguousarray(image if image.ndim == 3 else image[:, :, None])
        pad = self.pad
        return np.asarray(
            cv2.copyMakeBorder(to_gray(image), pad, pad, pad, pad, cv2.BORDER_REPLICATE), np.uint8
        ).ravel()

    def measure(
        self, view: NDArray[np.uint8], start: FloatArray, marks: IntArray | None = None
    ) -> tuple[FloatArray, NDArray[Any], NDArray[Any], NDArray[Any]]:
        """Measure marks from starting points (n, 2), right to about a radius.

        view : of the frame. marks : (n,) which marks these are; None for all.
        Returns positions (n, 2), gain (n,), explained share of the contrast (n,), standard error (n,).
        """
        marks = self._rows if marks is None else marks
        if view.ndim == 3:
            return self._measure_compiled(view, start, marks)
        position, gain, share, stderr = self._step(view, start, marks)
        for _ in range(_ROUNDS):
            again = _longer(position - start, _CONVERGED) & (share > ALIKE_SHARE) & (gain > ALIKE_GAIN)
            active = np.flatnonzero(again)
            if len(active) == 0:
                break
            start = position.copy()
            position[active], gain[active], share[active], stderr[active] = self._step(
                view, position[active], marks[active]
            )
        return position, gain, share, stderr

    def _measure_compiled(
        self, view: NDArray[np.uint8], start: FloatArray, marks: IntArray
    ) -> tuple[FloatArray, NDArray[Any], NDArray[Any], NDArray[Any]]:
        position = np.empty((len(marks), 2))
        found = np.empty((3, len(marks)), np.float32)
        template_kernels.measure(
            view,
            np.ascontiguousarray(start),
            marks,
            self._weights,
            self._gram,
            self._spread,
            self._disc,
            self._whole,
            self._real,
            position,
            found,
        )
        return position, found[0], found[1], found[2]

    def _step(
        self, flat: NDArray[np.uint8], start: FloatArray, marks: IntArray
    ) -> tuple[FloatArray, NDArray[Any], NDArray[Any], NDArray[Any]]:
        """One least-squares step from the phase nearest to the starting points."""
        # Quarters of a pixel: whole pixels above, the phase below.
        inside = np.minimum(np.maximum(start, 0.0), self._limits)
        quarter = (inside * _PHASES + _PHASES / 2).astype(np.int64)
        index = quarter // _PHASES @ self._strides + self._first
        which = quarter % _PHASES @ self._phase_strides + marks
        patch = flat.take(index[:, None] + self._offsets).astype(np.float32)
        # Far from zero, sums of squares would lose digits.
        patch -= np.float32(128)
        patch[:, self.pixels :] = 0
        sums = np.matmul(self._weights.take(which, axis=0), patch[:, :, None])
        theta, level = sums[:, :3], sums[:, 3:, 0]
        seen = np.vecdot(np.matmul(self._gram.take(which, axis=0), theta)[:, :, 0], theta[:, :, 0])
        gain = theta[:, 0, 0]
        safe = np.maximum(gain, LEAST_DIVISOR)
        step = theta[:, 1:, 0] / safe[:, None]
        np.minimum(np.maximum(step, -self.radius, out=step), self.radius, out=step)
        position = (quarter + 0.5) / _PHASES - 0.5 + step
        contrast = np.vecdot(patch, patch) - np.vecdot(level, level)
        rest = np.maximum(contrast - seen, LEAST_REST)
        stderr = np.sqrt(rest * self._spread.take(which) / (safe * safe) + np.float32(_SAMPLING**2))
        return position, gain, seen / (seen + rest), stderr


def _longer(vectors: FloatArray, length: float) -> BoolArray:
    return np.asarray(np.einsum("ni,ni->n", vectors, vectors) > length * length, np.bool_)


def _resample(image: NDArray[np.float32], points: FloatArray, reach: int) -> FloatArray:
    """Patches (N, 2 reach + 1, 2 reach + 1) centred on sub-pixel points, by a windowed sinc of six taps."""
    pad = reach + 4
    padded = cv2.copyMakeBorder(image, pad, pad, pad, pad, cv2.BORDER_REPLICATE)
    base = np.floor(points).astype(np.int64)
    fraction = points - base
    span = np.arange(-reach - 2, reach + 4)
    height, width = padded.shape
    rows = np.clip(base[:, 1, None] + pad + span, 0, height - 1)
    columns = np.clip(base[:, 0, None] + pad + span, 0, width - 1)
    patches = padded[rows[:, :, None], columns[:, None, :]].astype(np.float64)
    weights_x, weights_y = _lanczos(fraction[:, 0]), _lanczos(fraction[:, 1])
    size = 2 * reach + 1
    across = sum(patches[:, :, tap : tap + size] * weights_x[:, tap, None, None] for tap in range(6))
    return np.asarray(
        sum(across[:, tap : tap + size] * weights_y[:, tap, None, None] for tap in range(6)), np.float64
    )


def _lanczos(fraction: FloatArray) -> FloatArray:
    """Weights (N, 6) of the pixels at -2 .. 3 for points between 0 and 1 (Lanczos; Duchon 1979)."""
    distance = fraction[:, None] - np.arange(-2, 4)
    weights = np.sinc(distance) * np.sinc(distance / 3)
    return np.asarray(weights / weights.sum(axis=1, keepdims=True), np.float64)
