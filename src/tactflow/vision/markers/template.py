"""Align marks with their templates, which are cut from the reference frame."""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, spline_filter

from tactflow.vision.arrays import Flags, Floats, Floats32, Indices
from tactflow.vision.compiled import helper, kernel
from tactflow.vision.markers.spots import SAME_SIZE_RATIO

Bytes = NDArray[np.uint8]
Levels = NDArray[np.int16]

PHASES: Final = 4
"""Sub-pixel phases per axis at which templates are stored. An estimate lies at most an eighth of a pixel from
the nearest one, where the error of the linear model is far below the noise; if another phase is nearer, one
more step is made. Chosen by hand."""

MAX_STEPS: Final = 3
"""Maximum number of steps after the first one. Chosen by hand."""

SAMPLING_ERROR_PX: Final = 0.003
"""Error without noise, px: edges sharper than the sampling limit cannot be interpolated exactly. Measured on
rendered dots of radius 4.6 px with edges of 0.7 px standard deviation."""

PATCH_RADII: Final = 1.55
"""Radius of a template over that of its mark: it includes the mark's border and some gel. Chosen by hand."""

PATCH_MARGIN_PX: Final = 1.2
"""Additional margin of a template, px, for the shift of a phase and a step. Chosen by hand."""

RIDGE: Final = 1e-6
"""Ridge of the normal equations, relative to their trace: keeps marks without contrast solvable. Such marks
are never accepted. Chosen by hand."""

TINY: Final = np.finfo(np.float32).tiny
"""Keeps quotients finite."""

MIN_GAIN: Final = np.float32(0.2)
"""Minimum contrast of a visible mark, relative to its template, and lower bound of the divisor of a step:
that of a fainter mark would be all noise. Chosen by hand."""

MIN_R_SQUARED: Final = np.float32(0.5)
"""Minimum fraction of a visible mark's contrast that its template explains. Only then is another step made,
since it would not converge. Chosen by hand."""


class Alignment(NamedTuple):
    """Positions of marks.

    Attributes
    ----------
    position : (n, 2) float64, px.
    stderr : (n,) float32, standard error of each coordinate, px.
    seen : (n,) bool, whether the template fits.
    """

    position: Floats
    stderr: Floats32
    seen: Flags

    def put(self, marks: Indices, others: Alignment) -> None:
        """Replace the marks with indices (k,) by others, (k,), in place."""
        self.position[marks] = others.position
        self.stderr[marks] = others.stderr
        self.seen[marks] = others.seen

    def take(self, marks: Indices) -> Alignment:
        """The marks with indices (k,)."""
        return Alignment(self.position[marks], self.stderr[marks], self.seen[marks])


class _Model(NamedTuple):
    """Precomputed terms for the alignment of marks of one size.

    Attributes
    ----------
    weights : (PHASES^2 N, 5, p) int16, of the pixels of a disc.
    terms : (PHASES^2 N, 15) float32: the 9 elements of the Gram matrix, the variance per pixel, and the
        units of the 5 weights.
    widths : (rows,) int64, of the disc's rows, px.
    radius : of a mark, px.
    """

    weights: Levels
    terms: Floats32
    widths: Indices
    radius: float


class MarkerTemplates:
    """Aligns each mark of a frame with its template by least squares on the raw pixels.

    A patch of the frame is modelled as gain * template, shifted, times a plane of illumination, plus a
    constant. The plane is needed at the edge of a contact, where the light has a gradient. A dark mark dims
    this gradient as it dims all light, so merely *adding* a plane shifts the mark by up to 0.2 px. A bright
    mark has a brightness of its own, so there the gradient is added. The frame is only read at whole pixels;
    the reference, which has less noise, is interpolated once.

    Parameters
    ----------
    reference : (H, W) float32, grey levels.
    origin : (N, 2) float64, centres of the marks in the reference, px.
    radii : (N,) float64, px. A template must not include a neighbouring mark.
    dark : whether marks are darker than the gel.

    References
    ----------
    Lucas and Kanade (1981); Hager and Belhumeur, "Efficient region tracking with parametric models of
    geometry and illumination", PAMI 20 (1998), for the illumination; Baker and Matthews, "Lucas-Kanade 20
    years on", IJCV 56 (2004), for the inverse form, whose costly part is done once for the reference;
    Unser, "Splines: a perfect fit for signal and image processing", IEEE Signal Processing Magazine 16
    (1999), for the interpolation.

    Examples
    --------
    >>> import cv2
    >>> frame = np.full((40, 40), 150, np.uint8)
    >>> frame = cv2.GaussianBlur(cv2.circle(frame, (20, 20), 4, 40, -1), (0, 0), 1.0)
    >>> templates = MarkerTemplates(frame.astype(np.float32), np.array([[20.0, 20.0]]), np.array([4.0]))
    >>> moved = np.roll(frame, 1, axis=1)
    >>> templates.align(moved, np.array([[20.0, 20.0]])).position.round(1)
    array([[21., 20.]])
    """

    def __init__(self, reference: Floats32, origin: Floats, radii: Floats, dark: bool = True) -> None:
        self._dark = dark
        self._models: list[_Model] = []
        self._model_of, self._place = np.zeros((2, 0), np.int64)
        self.add(reference, origin, radii)

    def add(self, reference: Floats32, origin: Floats, radii: Floats) -> None:
        """Append marks (n, 2), px, with radii (n,), px, with templates from another frame."""
        step = np.floor(np.log(radii / radii.min()) / np.log(SAME_SIZE_RATIO) + 1e-6)
        sizes, size_of = np.unique(step, return_inverse=True)
        place = np.empty(len(radii), np.int64)
        known = len(self._models)
        for size in range(len(sizes)):
            those = np.flatnonzero(size_of == size)
            place[those] = np.arange(len(those))
            self._models.append(_model(reference, origin[those], float(radii[those].max()), self._dark))
        self._model_of = np.concatenate([self._model_of, size_of + known])
        self._place = np.concatenate([self._place, place])
        every = np.arange(len(self._place))
        self._all = [self._those_of(model, every) for model in range(len(self._models))]

    def _those_of(self, model: int, marks: Indices) -> tuple[Indices, Indices]:
        """The marks among these that belong to a model, and their indices in it."""
        which = np.flatnonzero(self._model_of[marks] == model)
        return which, self._place[marks[which]]

    def align(self, image: NDArray[np.uint8], start: Floats, marks: Indices | None = None) -> Alignment:
        """Align marks, from starting points within about a radius.

        image : (H, W, 3) uint8 BGR or (H, W) uint8. start : (n, 2) float64, px. marks : (n,) int64, their
        indices; None for all.
        """
        picture = np.ascontiguousarray(image if image.ndim == 3 else image[:, :, None])
        start, count = np.ascontiguousarray(start), len(start)
        found = Alignment(np.empty((count, 2)), np.empty(count, np.float32), np.empty(count, np.bool_))
        for number, model in enumerate(self._models):
            which, places = self._all[number] if marks is None else self._those_of(number, marks)
            align_marks(picture, start, which, places, *model, *found)
        return found


def _model(reference: Floats32, origin: Floats, radius: float, dark: bool) -> _Model:
    """The model of marks (N, 2), px, of one size. Arguments as of `MarkerTemplates`."""
    extent = PATCH_RADII * radius + PATCH_MARGIN_PX
    reach = int(np.ceil(extent))
    axis = np.arange(-reach, reach + 1)
    grid_y, grid_x = np.meshgrid(axis, axis, indexing="ij")
    disc = np.hypot(grid_x, grid_y) <= extent
    pixels, count = int(disc.sum()), len(origin)
    # 16 bits, because reading the weights of all marks takes most of the time.
    weights = np.empty((PHASES, PHASES, count, 5, pixels), np.int16)
    terms = np.empty((PHASES, PHASES, count, 15), np.float32)
    scaled = np.array([grid_x[disc], grid_y[disc]]) / radius
    # The border is replicated, as in `read_patch`.
    spline = spline_filter(np.pad(reference.astype(np.float64), reach, mode="edge"))
    at_y, at_x = origin[:, 1:] + grid_y[disc] + reach, origin[:, :1] + grid_x[disc] + reach
    # From one phase before the first to one after the last, for the slopes.
    steps = (np.arange(-1, PHASES + 1) + 0.5) / PHASES - 0.5
    shifted = [
        [map_coordinates(spline, [at_y - y, at_x - x], prefilter=False, mode="nearest") for x in steps]
        for y in steps
    ]
    for y, x in np.ndindex(PHASES, PHASES):
        slope_x = (shifted[y + 1][x + 2] - shifted[y + 1][x]) * (PHASES / 2)
        slope_y = (shifted[y + 2][x + 1] - shifted[y][x + 1]) * (PHASES / 2)
        exact, gram, variance = _normal_equations(shifted[y + 1][x + 1], slope_x, slope_y, scaled, dark)
        unit = np.maximum(np.abs(exact).max(axis=2), TINY) / np.iinfo(np.int16).max
        weights[y, x] = np.rint(exact / unit[:, :, None])
        terms[y, x, :, :9] = gram.reshape(count, 9)
        terms[y, x, :, 9] = variance / max(pixels - 6, 1)
        terms[y, x, :, 10:] = unit
    phases = PHASES * PHASES * count
    widths = disc.sum(axis=1)
    return _Model(weights.reshape(phases, 5, pixels), terms.reshape(phases, 15), widths, radius)


def _normal_equations(
    template: Floats, slope_x: Floats, slope_y: Floats, disc: Floats, dark: bool
) -> tuple[Floats, Floats, Floats]:
    """Terms of the least-squares problem for templates (N, p) at one phase.

    disc : (2, p), x and y of the pixels, in radii.
    Returns weights (N, 5, p): products with a patch give gain and shift x, y times gain, and the two
    coefficients of the illumination's slope in an orthonormal basis, whose first vector is constant; Gram
    matrices (N, 3, 3) of gain and shifts; variances (N,) of a coordinate at unit noise and gain.
    """
    lit = template if dark else np.ones_like(template)
    plane, _ = np.linalg.qr(np.stack([np.ones_like(lit), lit * disc[0], lit * disc[1]], axis=2))
    basis = np.stack([template, slope_x, slope_y], axis=1)
    basis -= (basis @ plane) @ plane.transpose(0, 2, 1)
    gram = basis @ basis.transpose(0, 2, 1)
    ridge = RIDGE * np.trace(gram, axis1=1, axis2=2) + RIDGE
    inverse = np.linalg.inv(gram + ridge[:, None, None] * np.eye(3))
    weights = np.concatenate([inverse @ basis, plane[:, :, 1:].transpose(0, 2, 1)], axis=1)
    return weights, gram, 0.5 * (inverse[:, 1, 1] + inverse[:, 2, 2])


@helper
def nearest_phase(x: float, y: float, width: int, height: int) -> Any:
    """The nearest phase to a point, per axis: PHASES times the pixel plus the phase."""
    # Comparisons with NaN are false, so NaN becomes a point inside the image, too.
    inside_x = min(x, width - 1.0) if x > 0.0 else 0.0
    inside_y = min(y, height - 1.0) if y > 0.0 else 0.0
    return int(inside_x * PHASES + PHASES / 2), int(inside_y * PHASES + PHASES / 2)


@helper
def read_patch(image: Bytes, left: int, top: int, widths: Indices, patch: Floats32) -> float:
    """Fill `patch` with the grey levels of a disc around a pixel; the border is replicated.

    widths : of the disc's rows, px. Returns the sum of squares about the mean.
    """
    height, width, channels = image.shape
    flat, reach, first = image.reshape(-1), widths.size // 2, 0
    inside = left >= reach and top >= reach and left + reach < width and top + reach < height
    for row in range(widths.size):
        count, begin, y = widths[row], left - widths[row] // 2, top - reach + row
        line = patch[first : first + count]
        if inside:
            to_gray(flat[(y * width + begin) * channels :], channels, line)
        else:
            y = min(max(y, 0), height - 1)
            for column in range(count):
                x = min(max(begin + column, 0), width - 1)
                to_gray(flat[(y * width + x) * channels :], channels, line[column : column + 1])
        first += count
    total = squares = 0.0
    for p in range(patch.size):
        total, squares = total + patch[p], squares + patch[p] * patch[p]
    return squares - total * total / patch.size


@helper
def to_gray(pixels: Bytes, channels: int, levels: Floats32) -> None:
    """Fill `levels` with grey levels minus 128; BGR is converted as in OpenCV."""
    blue, green, red, half = np.int32(3735), np.int32(19235), np.int32(9798), np.int32(16384)
    if channels == 1:
        for x in range(levels.size):
            levels[x] = np.float32(pixels[x]) - np.float32(128)
        return
    for x in range(levels.size):
        level = blue * np.int32(pixels[3 * x]) + green * np.int32(pixels[3 * x + 1])
        level += red * np.int32(pixels[3 * x + 2]) + half
        levels[x] = np.float32(level >> np.int32(15)) - np.float32(128)


@kernel(
    "void(Array(uint8, 3, 'C', readonly=True), float64[:, ::1], int64[::1], int64[::1], int16[:, :, ::1],"
    "float32[:, ::1], int64[::1], float64, float64[:, ::1], float32[::1], boolean[::1])",
)
def align_marks(
    image: Bytes,
    start: Floats,
    marks: Indices,
    places: Indices,
    weights: Levels,
    terms: Floats32,
    widths: Indices,
    radius: float,
    position: Floats,
    stderr: Floats32,
    seen: Flags,
) -> None:
    """Align `marks`; fill `position` (n, 2), `stderr` (n,) and `seen` (n,).

    image : (H, W, 3) BGR or (H, W, 1). start : (n, 2). places : indices of the marks in the model (see
    `_Model`). Steps are limited to a radius along each axis.
    """
    height, width, _ = image.shape
    longest, count = np.float32(radius), weights.shape[0] // (PHASES * PHASES)
    patch = np.empty(weights.shape[2], np.float32)
    for number in range(len(marks)):
        n, place = marks[number], places[number]
        x, y = start[n, 0], start[n, 1]
        seen_left, seen_top, varies = -1, -1, 0.0
        phase_x, phase_y = nearest_phase(x, y, width, height)
        before_x, before_y = -1, -1
        for _ in range(MAX_STEPS + 1):
            left, top = phase_x // PHASES, phase_y // PHASES
            which = (phase_x % PHASES + phase_y % PHASES * PHASES) * count + place
            # A step of less than a pixel often needs the same patch at another phase.
            if left != seen_left or top != seen_top:
                seen_left, seen_top = left, top
                varies = read_patch(image, left, top, widths, patch)
            gain, shift_x, shift_y, r_squared, rest = fit_template(
                weights[which], terms[which], patch, varies
            )
            seen[n] = gain > MIN_GAIN and r_squared > MIN_R_SQUARED
            safe = max(gain, MIN_GAIN)
            now_x = (phase_x + 0.5) / PHASES - 0.5 + min(max(shift_x / safe, -longest), longest)
            now_y = (phase_y + 0.5) / PHASES - 0.5 + min(max(shift_y / safe, -longest), longest)
            next_x, next_y = nearest_phase(now_x, now_y, width, height)
            if next_x == before_x and next_y == before_y:
                # Two phases lead to each other: average them, so that the result does not depend on the
                # start.
                x, y = (x + now_x) / 2, (y + now_y) / 2
                break
            x, y = now_x, now_y
            if not seen[n] or (next_x == phase_x and next_y == phase_y):
                break
            before_x, before_y, phase_x, phase_y = phase_x, phase_y, next_x, next_y
        position[n, 0], position[n, 1] = x, y
        noise = rest * terms[which, 9] / (safe * safe)
        stderr[n] = np.sqrt(noise + np.float32(SAMPLING_ERROR_PX * SAMPLING_ERROR_PX))


@helper
def fit_template(weight: Levels, term: Floats32, patch: Floats32, varies: float) -> Any:
    """Gain, shift x and y times gain, r_squared, and the residual sum of squares of a patch.

    varies : the patch's sum of squares about its mean.
    """
    gain = shift_x = shift_y = slope_x = slope_y = np.float32(0)
    for p in range(patch.size):
        gain += np.float32(weight[0, p]) * patch[p]
        shift_x += np.float32(weight[1, p]) * patch[p]
        shift_y += np.float32(weight[2, p]) * patch[p]
        slope_x += np.float32(weight[3, p]) * patch[p]
        slope_y += np.float32(weight[4, p]) * patch[p]
    gain, shift_x, shift_y = gain * term[10], shift_x * term[11], shift_y * term[12]
    slope_x, slope_y = slope_x * term[13], slope_y * term[14]
    explained = gain * (term[0] * gain + term[1] * shift_x + term[2] * shift_y)
    explained += shift_x * (term[3] * gain + term[4] * shift_x + term[5] * shift_y)
    explained += shift_y * (term[6] * gain + term[7] * shift_x + term[8] * shift_y)
    contrast = varies - slope_x * slope_x - slope_y * slope_y
    rest = max(contrast - explained, float(TINY))
    return gain, shift_x, shift_y, explained / (explained + rest), rest
