"""Which colour of the gel is which slope, learned from presses of a ball.

Where the ball touches, the surface is the ball: at a distance d from the middle of a ball of radius R the
horizontal part of the unit normal is d / R, towards the middle. The outline gives the middle to some pixels
only, so fit and centres take turns: with a model, each pixel of a press says where the middle would be, and
the median of them is the press's new centre. What they lie off in common shows as a slope of the unchanged
colour, which has none.

Around the ball nothing is known of the slope but that it is the same all around and points to the middle: a
gel that is pressed by a ball is as round as the ball. Colours that a shadow or a reflection gives one side
alone would break this, and with it the heights, which are integrals of the slopes: so it is part of the fit.
On wedge_ball it halves the RMS distance of the heights from the ball.

All of it is linear in the coefficients: a ridge regression with a few hundred unknowns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.calibration.file import PhotometricEntry
from tactflow.calibration.presses import Press, Session, usual_radius
from tactflow.engine.errors import ConfigError
from tactflow.vision.arrays import Floats
from tactflow.vision.depth.slopes import COLOUR_TERMS, PLACE_TERMS, SlopeModel, colour_terms, place_terms
from tactflow.vision.depth.surface import Rest, Surface, colour_change
from tactflow.vision.depth.surroundings import Window, surroundings
from tactflow.vision.types import Scale

FEWEST_PRESSES: Final = 8
"""Presses that a fit needs at least; 20 or more are advised. Chosen by hand."""
SPREAD: Final = 0.15
"""Part of the picture's width and height that the presses must span at least. Chosen by hand."""
INNER: Final = 0.85
"""Part of a contact's radius inside which the surface is the ball for sure, and part of the ball's radius up
to which its colours tell slopes apart. Chosen on wedge_ball."""
TOO_LARGE: Final = 1.25
"""Radius of a contact over that of the ball that no ball can make; what outlines add to it is less."""
ROUND: Final = 0.05
"""Weight of a pixel around the contact, where the surface is round, to one inside of it. Chosen on
wedge_ball: 0.03 leaves 0.033 mm RMS and 0.1 flattens the ball."""
RIDGE: Final = 1e-6
"""Ridge penalty, as a part of a coefficient's own weight. Chosen by hand."""
PLACE_RIDGE: Final = 1e-3
"""The same of coefficients that change with the place, so that a colour means much the same where nothing was
pressed. Chosen on the simulator: after 8 presses normals under `mixed` are 55 degrees off with 1e-6, 13 with
1e-4, 7 with 1e-3; with 1e-2 heights of a box are off by 9 % after 26 presses, instead of 7."""
SMOOTHED: Final = 0.02
"""Standard deviation of the Gaussian over which colours are averaged to be learned, in radii of the ball.
Noise makes learned slopes too small: without it a box under `mixed` has errors of 8 % instead of 4. On
wedge_ball 0.07 makes balls 1.5 % smaller than 0.03."""
DARK: Final = 20.0
"""Grey level below which a channel's light does not reach the surface, so that the slope shows in the two
others alone. There colours are learned with their noise, which draws to the mean what it leaves open: with
averages there, too, cables under `dark_channel` have errors of 5.6 % instead of 3.8."""
TURNS: Final = 3
"""How often fit and centres take turns; later ones move centres by less than 0.05 px on wedge_ball."""
OUTLIER: Final = 4.0
"""Robust standard deviations above the median misfit at which a press is rejected. Chosen by hand."""
LEAST_SCATTER: Final = 0.1
"""Standard deviation of the misfits that is assumed at least, degrees. Chosen by hand."""
ROUNDS: Final = 2
"""How often presses are judged: the second time by what was learned without the bad ones, beside which good
ones look bad too."""
FEWEST_PIXELS: Final = 12
"""Pixels at half resolution inside a contact that a sphere can be fitted to. Chosen by hand."""
EDGE: Final = 0.1
"""Half the width of the ring that counts as the rim of a contact, relative to its radius. Chosen by hand."""
RIM: Final = 6
"""Pixels at half resolution along the border of a press's window that roundness is not asked of. Chosen by
hand."""


@dataclass(frozen=True, eq=False, slots=True)
class Photometry:
    """A fit. model : of the slopes. found : numbers for the calibration file. centers : (n, 2) float64, px,
    of the presses. kept : (n,) bool, which presses were not rejected. misfit : (n,) float64, mean angle
    between the normals of each press and its ball, degrees."""

    model: SlopeModel
    found: PhotometricEntry
    centers: Floats
    kept: NDArray[np.bool_]
    misfit: Floats


@dataclass(frozen=True, eq=False, slots=True)
class _Sample:
    """A press, prepared: pixels (m) in its window at half resolution, in mm.

    x, y : (m,), places, mm. terms : (m, 114) float32. hidden : (m,) bool. inner : (m,) bool, not too near the
    border of the window. start : (x, y) of the outline, mm. reach : radius inside which it is the ball, mm.
    ball_radius : mm.
    """

    x: Floats
    y: Floats
    terms: NDArray[np.float32]
    hidden: NDArray[np.bool_]
    inner: NDArray[np.bool_]
    start: Floats
    reach: float
    window: Window
    ball_radius: float

    def on_ball(self, center: Floats) -> NDArray[np.bool_]:
        """(m,): visible pixels where the surface is a ball with this centre."""
        near = np.hypot(self.x - center[0], self.y - center[1]) < self.reach
        return np.asarray(near & ~self.hidden)

    def normals(self, weights: Floats, chosen: NDArray[np.bool_]) -> Floats:
        """(k, 2): horizontal part of the normals at some pixels, by the fit."""
        return np.asarray(self.terms[chosen] @ weights.T.astype(np.float32), np.float64)

    def center(self, start: Floats, weights: Floats) -> Floats:
        """(2,), mm: the median of where pixels of the press say that the middle of the ball is."""
        center = start
        for _ in range(TURNS):
            ball = self.on_ball(center)
            if not ball.any():
                return center
            places = np.stack([self.x[ball], self.y[ball]], axis=1)
            center = np.median(places - self.ball_radius * self.normals(weights, ball), axis=0)
        return center

    def misfit(self, center: Floats, weights: Floats) -> float:
        """Mean angle between the normals of the press and those of the ball, degrees; 180 if it has none."""
        ball = self.on_ball(center)
        if not ball.any():
            return 180.0
        places = np.stack([self.x[ball] - center[0], self.y[ball] - center[1]], axis=1)
        true = _upright(places / self.ball_radius)
        cosine = np.sum(_upright(self.normals(weights, ball)) * true, axis=1)
        return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean())


def fit_photometry(session: Session, scale: Scale, ball_radius: float | Sequence[float]) -> Photometry:
    """Learn slopes from presses of a ball, or of several.

    Presses that fit badly are rejected. The errors come from two fits to one half of the presses each, tried
    on the other half.

    Parameters
    ----------
    session : what `find_presses` found. scale : mm per px. ball_radius : mm, of all presses or of each.

    Raises
    ------
    ConfigError : too few presses, all in one place, or contacts larger than the ball.
    """
    radii = np.broadcast_to(np.asarray(ball_radius, np.float64), len(session.presses))
    check_presses(session, scale, radii)
    samples = _prepared(session, scale, radii)
    kept = np.ones(len(samples), np.bool_)
    for _ in range(ROUNDS):
        weights, starts = _fit(samples, np.flatnonzero(kept))
        fitted = [sample.center(start, weights) for sample, start in zip(samples, starts, strict=True)]
        centers = np.array(fitted)
        misfit = np.array([s.misfit(c, weights) for s, c in zip(samples, centers, strict=True)])
        before, kept = kept, _fitting(misfit)
        if (kept == before).all():
            break
    else:
        weights, _ = _fit(samples, np.flatnonzero(kept))
    good = np.flatnonzero(kept)
    found = PhotometricEntry(
        ball_radius=float(np.median(radii)),
        presses=len(good),
        rejected=len(samples) - len(good),
        steepest=max(samples[i].reach / samples[i].ball_radius for i in good),
        **_held_out(session, samples, good, scale),
    )
    pixels = centers / (scale.x, scale.y) + scale.origin
    return Photometry(SlopeModel(_shaped(weights)), found, pixels, kept, misfit)


def try_photometry(session: Session, model: SlopeModel, scale: Scale, ball_radius: float) -> dict[str, float]:
    """How well a model fits presses of a ball: the errors of `PhotometricEntry`.

    session : what `find_presses` found, at least one press. ball_radius : mm.
    """
    return _summary(press_errors(session, model, scale, ball_radius))


def press_errors(
    session: Session, model: SlopeModel, scale: Scale, ball_radius: float | Sequence[float]
) -> list[list[float]]:
    """Errors of a model on each press of a ball.

    session : what `find_presses` found. ball_radius : mm, of all presses or of each.

    Returns
    -------
    (n, 5): mean angle of the normals, degrees; relative error of the ball's radius; RMS distance of the
    heights from it, mm; relative errors of its depth and its volume, from the middle to the rim of the
    contact: the gel around it is not known. The last four are NaN where a contact is too small.
    """
    weights = model.coefficients.transpose(2, 0, 1).reshape(2, -1).astype(np.float64)
    radii = np.broadcast_to(np.asarray(ball_radius, np.float64), len(session.presses))
    samples = _prepared(session, scale, radii)
    rest, surface = Rest(session.untouched), Surface(model, scale)
    pairs = zip(session.presses, samples, strict=True)
    return [_errors(s, weights, surface.heights(p.image, rest, p.mask)[s.window.part]) for p, s in pairs]


def check_presses(session: Session, scale: Scale, radii: Floats) -> None:
    """Raise ConfigError if the presses cannot give a calibration, with what was found and what to do.

    radii : (n,) float64, mm, of the ball of each press.
    """
    presses = session.presses
    if not (np.isfinite(radii) & (radii > 0)).all():
        raise ConfigError(f"calibrate: required a ball radius > 0 mm, got {radii.min():g}")
    if not presses:
        raise ConfigError(
            f"calibrate: nothing touched the gel in {session.frames} frames; the first frame must show it "
            "untouched, the others presses of the ball"
        )
    if len(presses) < FEWEST_PRESSES:
        raise ConfigError(
            f"calibrate: required {FEWEST_PRESSES} presses of the ball or more (20 are better), found "
            f"{len(presses)} in {session.frames} frames; lift the ball between two presses"
        )
    span = np.ptp([press.center for press in presses], axis=0) / session.mapping.size
    if span.min() < SPREAD:
        # Rounded down, so as not to read as enough.
        wide, high = np.floor(1000 * span) / 10
        raise ConfigError(
            f"calibrate: the presses span {wide:g} % of the picture's width and "
            f"{high:g} % of its height, required {100 * SPREAD:.0f} %; press all over the gel"
        )
    radius = usual_radius(presses) * (scale.x * scale.y) ** 0.5
    ball_radius = float(np.median(radii))
    if radius > TOO_LARGE * ball_radius:
        raise ConfigError(
            f"calibrate: the contacts have a radius of {radius:.2f} mm in the median, which a ball of radius "
            f"{ball_radius:g} mm cannot make; give its radius, not its diameter, in mm, and look at the scale"
        )


def _prepared(session: Session, scale: Scale, radii: Floats) -> list[_Sample]:
    """radii : (n,), mm, of the ball of each press."""
    width = SMOOTHED * float(np.median(radii))
    across, down = width / scale.x, width / scale.y

    def smoothed(image: NDArray[np.uint8]) -> NDArray[np.float32]:
        # Not rounded to grey levels again: that would be as much noise as a camera's.
        return np.asarray(cv2.GaussianBlur(image.astype(np.float32), (0, 0), across, sigmaY=down), np.float32)

    rests = Rest(session.untouched), Rest(smoothed(session.untouched))
    pairs = zip(session.presses, radii.tolist(), strict=True)
    return [_prepare(press, smoothed(press.image), rests, scale, radius) for press, radius in pairs]


def _prepare(
    press: Press, smoothed: NDArray[np.float32], rests: tuple[Rest, Rest], scale: Scale, ball_radius: float
) -> _Sample:
    """smoothed : the picture of the press. rests : the untouched gel, as it is and smoothed."""
    rest = rests[0]
    window = surroundings(press.mask, rest.window).window
    light = rest.around(press.image, press.mask).light
    change = colour_change(smoothed, rests[1], window, light)
    size = (window.width, window.height)
    dark = cv2.resize(smoothed[window.whole], size, interpolation=cv2.INTER_AREA).min(axis=2) < DARK
    change[dark] = colour_change(press.image, rest, window, light)[dark]
    place = place_terms((rest.window.right, rest.window.bottom))[(slice(None), *window.part)]
    terms = place.reshape(PLACE_TERMS, 1, -1) * colour_terms(change)
    rows, columns = np.mgrid[window.part]
    hidden = press.hidden[window.whole]
    inner = np.zeros(change.shape[:2], np.bool_)
    inner[RIM:-RIM, RIM:-RIM] = True
    return _Sample(
        # The centre of a pixel at half resolution lies between two of the processed frame.
        x=((2.0 * columns + 0.5 - scale.origin[0]) * scale.x).ravel(),
        y=((2.0 * rows + 0.5 - scale.origin[1]) * scale.y).ravel(),
        terms=np.ascontiguousarray(terms.reshape(PLACE_TERMS * COLOUR_TERMS, -1).T),
        hidden=(hidden[::2, ::2] | hidden[1::2, ::2] | hidden[::2, 1::2] | hidden[1::2, 1::2]).ravel(),
        inner=inner.ravel(),
        start=np.array(scale.point(press.center)),
        reach=min(INNER * press.radius * (scale.x * scale.y) ** 0.5, INNER * ball_radius),
        window=window,
        ball_radius=ball_radius,
    )


def _fitting(misfit: Floats) -> NDArray[np.bool_]:
    """(n,): which presses fit about as well as the others."""
    from scipy.stats import median_abs_deviation

    scatter = float(median_abs_deviation(misfit, scale="normal"))
    return np.asarray(misfit <= np.median(misfit) + OUTLIER * max(scatter, LEAST_SCATTER))


def _fit(samples: Sequence[_Sample], chosen: NDArray[np.intp]) -> tuple[Floats, Floats]:
    """Coefficients (2, 114), and the centres (n, 2), mm, of all samples, from the chosen ones."""
    centers = np.array([sample.start for sample in samples])
    for turn in range(TURNS):
        weights, offset = _solve([(samples[i], centers[i]) for i in chosen])
        if turn < TURNS - 1:
            centers += offset
            centers[chosen] = [samples[i].center(centers[i], weights) for i in chosen]
    return weights, centers


def _solve(presses: Sequence[tuple[_Sample, Floats]]) -> tuple[Floats, Floats]:
    """Coefficients (2, 114) for given centres, and how far all of these lie off in common, (2,) mm.

    The second comes from a constant beside the terms: where no change of colour would have a slope.
    """
    count = PLACE_TERMS * COLOUR_TERMS
    inside = np.zeros((count + 1, count + 1))
    aim = np.zeros((2, count + 1))
    around = np.zeros((2 * count, 2 * count))
    for sample, center in presses:
        dx, dy = sample.x - center[0], sample.y - center[1]
        ball = sample.on_ball(center)
        # A common offset of the centres tilts a small ball's normals more.
        shifted = np.full(np.count_nonzero(ball), 1 / sample.ball_radius, np.float32)
        terms = np.column_stack([sample.terms[ball], shifted])
        inside += terms.T @ terms
        aim += np.stack([dx[ball], dy[ball]]) / sample.ball_radius @ terms
        outer = np.flatnonzero(~sample.hidden & ~ball & sample.inner)
        around += _roundness(sample.terms[outer], dx[outer], dy[outer])
    matrix = np.kron(np.eye(2), inside)
    free = np.flatnonzero(np.arange(2 * count + 2) % (count + 1) < count)
    matrix[np.ix_(free, free)] += ROUND * around
    ridge = np.append(np.repeat([RIDGE, *[PLACE_RIDGE] * (PLACE_TERMS - 1)], COLOUR_TERMS), RIDGE)
    matrix += np.diag(np.tile(ridge, 2) * np.diag(matrix) + 1e-9 * np.trace(matrix) / len(matrix))
    solved = np.linalg.solve(matrix, aim.ravel()).reshape(2, count + 1)
    return solved[:, :count], solved[:, count]


def _roundness(terms: NDArray[np.float32], dx: Floats, dy: Floats) -> Floats:
    """(228, 228): quadratic form that is 0 for normals which point to the middle, the same all around."""
    distance = np.hypot(dx, dy)
    ux, uy = ((part / distance).astype(np.float32)[:, None] for part in (dx, dy))
    across = np.concatenate([-uy * terms, ux * terms], axis=1)
    along = np.concatenate([ux * terms, uy * terms], axis=1)
    # Rings as wide as two pixels at half resolution.
    width = 2 * float(np.abs(np.diff(np.unique(np.round(dx, 6)))).min()) if len(dx) > 1 else 1.0
    ring = (distance / width).astype(np.int64)
    order = np.argsort(ring, kind="stable")
    ring, along = ring[order], along[order]
    first = np.flatnonzero(np.diff(ring, prepend=-1))
    members = np.diff(first, append=len(ring))
    means = np.add.reduceat(along, first, axis=0) / members[:, None].astype(np.float32)
    along -= np.repeat(means, members, axis=0)
    return np.asarray(across.T @ across + along.T @ along, np.float64)


def _upright(flat: Floats) -> Floats:
    """(m, 3): unit normals from their horizontal parts (m, 2); longer ones than 1 lie flat."""
    flat = flat / np.maximum(np.hypot(flat[:, 0], flat[:, 1]), 1)[:, None]
    return np.concatenate([flat, np.sqrt(np.maximum(1 - (flat**2).sum(axis=1, keepdims=True), 0))], axis=1)


def _held_out(
    session: Session, samples: Sequence[_Sample], good: NDArray[np.intp], scale: Scale
) -> dict[str, float]:
    """Errors of presses that the fit has not seen, for `PhotometricEntry`."""
    rest = Rest(session.untouched)
    errors = []
    for learned, others in ((good[::2], good[1::2]), (good[1::2], good[::2])):
        weights, _ = _fit(samples, learned)
        surface = Surface(SlopeModel(_shaped(weights)), scale)
        for i in others:
            press = session.presses[i]
            heights = surface.heights(press.image, rest, press.mask)[samples[i].window.part]
            errors.append(_errors(samples[i], weights, heights))
    return _summary(errors)


def _errors(sample: _Sample, weights: Floats, heights: NDArray[np.float32]) -> list[float]:
    """Of one press: mean angle, relative error of the radius, RMS from the sphere, of depth, of volume.

    The depth is judged by how far the surface falls from the middle of the ball to the rim of the contact,
    and the volume by the mean of that: the gel around the ball is not known.
    """
    ball_radius = sample.ball_radius
    center = sample.center(sample.start, weights)
    angle = sample.misfit(center, weights)
    found = heights.ravel().astype(np.float64)
    dx, dy = sample.x - center[0], sample.y - center[1]
    distance = np.hypot(dx, dy)
    ball = distance < sample.reach
    edge = np.abs(distance - sample.reach) < EDGE * sample.reach
    if np.count_nonzero(ball) < FEWEST_PIXELS or not edge.any():
        return [angle, np.nan, np.nan, np.nan, np.nan]
    radius, rms = fit_sphere(np.stack([dx[ball], dy[ball], found[ball]], axis=1))
    cap = np.sqrt(ball_radius**2 - distance[ball] ** 2)
    rise = cap - cap.mean()
    fall = np.sqrt(ball_radius**2 - distance[edge] ** 2).mean()
    depth = float(rise @ found[ball] / (rise @ rise)) - 1
    volume = float((found[ball].mean() - found[edge].mean()) / (cap.mean() - fall)) - 1
    return [angle, radius / ball_radius - 1, rms, depth, volume]


def _summary(errors: Sequence[Sequence[float]]) -> dict[str, float]:
    """Numbers of `PhotometricEntry` from the errors of each press."""
    angle, radius, rms, depth, volume = np.transpose(errors)
    return {
        "normal_error": float(np.mean(angle)),
        "radius_error": float(np.nanmedian(radius)),
        "sphere_rms": float(np.nanmean(rms)),
        "depth_stderr": float(np.sqrt(np.nanmean(depth**2))),
        "volume_stderr": float(np.sqrt(np.nanmean(volume**2))),
    }


def fit_sphere(points: Floats) -> tuple[float, float]:
    """Radius of the sphere through points (n, 3), by linear least squares, and their RMS distance from it.

    >>> angle = np.linspace(0, 6, 40)
    >>> flat = np.stack([np.cos(angle), np.sin(angle)], axis=1) * np.linspace(0.1, 1.2, 40)[:, None]
    >>> points = np.column_stack([flat, np.sqrt(4 - (flat**2).sum(axis=1))])
    >>> [round(value, 6) for value in fit_sphere(points)]
    [2.0, 0.0]
    """
    matrix = np.column_stack([points, np.ones(len(points))])
    solved = np.linalg.lstsq(matrix, (points**2).sum(axis=1), rcond=None)[0]
    center = solved[:3] / 2
    radius = float(np.sqrt(max(solved[3] + center @ center, 0.0)))
    distance = np.linalg.norm(points - center, axis=1) - radius
    return radius, float(np.sqrt(np.mean(distance**2)))


def _shaped(weights: Floats) -> Floats:
    """(6, 19, 2) coefficients, as `SlopeModel` takes them, from (2, 114)."""
    return weights.reshape(2, PLACE_TERMS, COLOUR_TERMS).transpose(1, 2, 0)
