"""Align marks with their templates, which are cut from the reference frame."""

from __future__ import annotations

from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, spline_filter

from tactflow.vision.arrays import Bytes, Flags, Floats, Floats32, Indices
from tactflow.vision.compiled import kernel
from tactflow.vision.markers.spots import SAME_SIZE_RATIO

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

MIN_GAIN: Final = 0.2
"""Minimum contrast of a visible mark, relative to its template, and lower bound of the divisor of a step:
that of a fainter mark would be all noise. Chosen by hand."""

MIN_R_SQUARED: Final = 0.5
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
            align_marks(
                picture,
                start,
                which,
                places,
                *model,
                *found,
                MIN_GAIN,
                MIN_R_SQUARED,
                SAMPLING_ERROR_PX,
                MAX_STEPS,
            )
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
    # The border is replicated, as in `_patches`.
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


def _nearest_phase(at: Floats, width: int, height: int) -> Indices:
    """(n, 2) int64: the nearest phase to points (n, 2): PHASES times the pixel plus the phase."""
    inside = np.clip(np.nan_to_num(at), 0, [width - 1.0, height - 1.0])
    return (inside * PHASES + PHASES / 2).astype(np.int64)


def _patches(levels: Floats32, corner: Indices, widths: Indices) -> Floats:
    """(n, p) float64: grey levels minus 128 of a disc around pixels (n, 2); the border is replicated."""
    reach = len(widths) // 2
    rows = np.repeat(np.arange(len(widths)) - reach, widths)
    columns = np.concatenate([np.arange(width) - width // 2 for width in widths])
    y = np.clip(corner[:, 1:] + rows, 0, levels.shape[0] - 1)
    x = np.clip(corner[:, :1] + columns, 0, levels.shape[1] - 1)
    return np.asarray(levels[y, x], np.float64)


@kernel
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
    min_gain: float,
    min_r_squared: float,
    sampling_error: float,
    max_steps: int,
) -> None:
    """Align `marks`; fill `position` (n, 2), `stderr` (n,) and `seen` (n,).

    image : (H, W, 3) BGR or (H, W, 1). start : (n, 2). places : indices of the marks in the model (see
    `_Model`). Steps are limited to a radius along each axis. min_gain, min_r_squared : of a visible mark.
    sampling_error : px, of a picture without noise. max_steps : after the first one.
    """
    height, width, channels = image.shape
    gray = image[:, :, 0] if channels == 1 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    levels, count = gray.astype(np.float32) - 128, len(weights) // PHASES**2
    phase = _nearest_phase(start[marks], width, height)
    before, going = np.full_like(phase, -1), np.arange(len(marks))
    position[marks] = start[marks]
    for _ in range(max_steps + 1):
        those, here = marks[going], phase[going]
        which = (here % PHASES) @ [1, PHASES] * count + places[going]
        term, patch = terms[which].astype(np.float64), _patches(levels, here // PHASES, widths)
        sums = np.einsum("nkp,np->nk", weights[which].astype(np.float64), patch) * term[:, 10:]
        gram = term[:, :9].reshape(-1, 3, 3)
        explained = np.einsum("ni,nij,nj->n", sums[:, :3], gram, sums[:, :3])
        varies = (patch**2).sum(axis=1) - patch.sum(axis=1) ** 2 / patch.shape[1]
        rest = np.maximum(varies - (sums[:, 3:] ** 2).sum(axis=1) - explained, TINY)
        safe = np.maximum(sums[:, 0], min_gain)
        seen[those] = (sums[:, 0] > min_gain) & (explained / (explained + rest) > min_r_squared)
        stderr[those] = np.sqrt(rest * term[:, 9] / safe**2 + sampling_error**2)
        moved = (here + 0.5) / PHASES - 0.5 + np.clip(sums[:, 1:3] / safe[:, None], -radius, radius)
        following = _nearest_phase(moved, width, height)
        # Two phases that lead to each other are averaged, so that the result does not depend on the start.
        returns = (following == before[going]).all(axis=1)
        position[those] = np.where(returns[:, None], (position[those] + moved) / 2, moved)
        stays = returns | ~seen[those] | (following == here).all(axis=1)
        before[going], phase[going] = here, following
        going = going[~stays]
