"""Presses of a ball, prepared for a fit of the slopes, and the errors of a fit on each of them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.calibration.presses import Press, Session
from tactflow.vision.arrays import Floats
from tactflow.vision.depth.slopes import COLOUR_TERMS, PLACE_TERMS, SlopeModel, colour_terms, place_terms
from tactflow.vision.depth.surface import Rest, Surface, colour_change, half_resolution
from tactflow.vision.depth.surroundings import Window, surroundings
from tactflow.vision.types import Scale

CLINGS: Final = 0.5**0.5
"""Part of the radius of a contact up to which a deep gel clings to the ball (Hertz), so that the surface is
the ball's; a thin layer clings to all of it. The radius is at most that of the ball: with slopes of more than
45 degrees, caps on digit_fots and wedge_ball were 14 and 7 % too deep."""
SMOOTHED: Final = 0.02
"""Standard deviation of the Gaussian blur of the colours for the fit, in radii of the ball. Noise biases
slopes towards 0: without the blur a box under `mixed` has errors of 8 % instead of 4. On wedge_ball 0.07
makes balls 1.5 % smaller than 0.03."""
DARK: Final = 20.0
"""Grey level below which the light of a channel does not reach the surface, so that only the two others show
the slope. Colours are not blurred there, since noise regularises what is undetermined: with the blur, cables
under `dark_channel` have errors of 5.6 % instead of 3.8."""
TURNS: Final = 3
"""Iterations of fit and centres; later ones move centres by less than 0.05 px on wedge_ball."""
RINGS: Final = (0.25, 0.5, 0.75, 1.0)
"""Inner and outer limit of two rings around the middle of a press, in parts of `reach`: how the slope grows
from one to the other tells the shape."""
EDGE_SLOPE_RATIO: Final = 0.7
"""Slope over that of the ball at the edge where the gel leaves it: on a half-space it is 0.7 at 1.05 radii of
the contact (Hertz); a thin layer is flat outside, and the blurred step has half of it at the edge."""
EDGE_RINGS: Final = 16
"""Rings within `reach` on which the slope is averaged to find the edge: about a pixel at half resolution."""
CORE_SHRINKAGE: Final = 0.8
"""Relative decrease of the radius of a core with the fraction of the slope at its border, per unit of the
fraction: 0.6 to 1.0 for balls on seven sensors."""
HIGHEST_CORE: Final = 0.95
"""Highest fraction at the border of a core: above, noise opens the ring of steep slopes."""
FEWEST_PIXELS: Final = 12
"""Least number of pixels at half resolution inside a contact to judge its depth. Chosen by hand."""
RIM: Final = 6
"""Width of the border of a press's window where roundness is not required, pixels at half resolution. Chosen
by hand."""


def reach(press: Press, scale: Scale, ball_radius: float) -> float:
    """Distance from the middle of a press within which the surface is certainly that of the ball, mm."""
    return CLINGS * min(press.radius * math.sqrt(scale.x * scale.y), ball_radius)


class Misfit(NamedTuple):
    """Fitted normals against those of the ball.

    angle : mean between them, degrees; 180 where the press shows no ball. explained : share of the sum of
    squares of their horizontal parts that the fit explains after scaling, 0 to 1. gain : the scaling factor.
    """

    angle: float
    explained: float
    gain: float


@dataclass(frozen=True, eq=False, slots=True)
class Sample:
    """A press, prepared: pixels (m) in its window at half resolution, in mm.

    x, y : (m,), positions, mm. terms : (m, 114) float32. hidden : (m,) bool. inner : (m,) bool, not too near
    the border of the window. start : center (x, y) of the outline, mm. reach : see `reach`. ball_radius : mm.
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
        """(k, 2): horizontal part of the fitted normals at some pixels."""
        return np.asarray(self.terms[chosen] @ weights.T.astype(np.float32), np.float64)

    def center(self, start: Floats, weights: Floats) -> Floats:
        """(2,), mm: the median of the estimates of the ball's centre from single pixels."""
        center = start
        for _ in range(TURNS):
            ball = self.on_ball(center)
            if not ball.any():
                return center
            places = np.stack([self.x[ball], self.y[ball]], axis=1)
            center = np.median(places - self.ball_radius * self.normals(weights, ball), axis=0)
        return center

    def true_normals(self, center: Floats, ball: NDArray[np.bool_]) -> Floats:
        """(k, 2): horizontal part of the normals of the ball at some pixels."""
        places = np.stack([self.x[ball], self.y[ball]], axis=1)
        return np.asarray((places - center) / self.ball_radius)

    def information(self, center: Floats) -> Floats:
        """(114, 114): Gram matrix of the terms over the pixels where the surface is the ball."""
        terms = self.terms[self.on_ball(center)].astype(np.float64)
        return np.asarray(terms.T @ terms)

    def explained_alone(self, center: Floats) -> float:
        """Share of the normals of the ball that a fit of the colours of this press alone explains, 0 to 1.

        Like `Misfit.explained`, but nothing else is known of the sensor: the least that a ball must show.
        """
        ball = self.on_ball(center)
        if np.count_nonzero(ball) < FEWEST_PIXELS:
            return 0.0
        true = self.true_normals(center, ball)
        true -= true.mean(axis=0)
        terms = self.terms[ball][:, :COLOUR_TERMS].astype(np.float64)
        terms -= terms.mean(axis=0)
        left = true - terms @ np.linalg.lstsq(terms, true, rcond=None)[0]
        return 1 - float((left**2).sum() / (true**2).sum())

    def growth(self, center: Floats, weights: Floats) -> float:
        """Exponent with which the fitted slope grows with the distance from the middle: 1 for a ball.

        It is 0 for a cone, and large for a punch. NaN where a contact is too small to show it.
        """
        ball = self.on_ball(center)
        away = np.stack([self.x[ball], self.y[ball]], axis=1) - center
        distance = np.hypot(away[:, 0], away[:, 1])
        outward = np.sum(self.normals(weights, ball) * away, axis=1)
        rings = [
            (distance >= inner * self.reach) & (distance < outer * self.reach)
            for inner, outer in zip(RINGS[::2], RINGS[1::2], strict=True)
        ]
        if min(np.count_nonzero(ring) for ring in rings) < FEWEST_PIXELS:
            return math.nan
        slopes = [float((outward[ring] / distance[ring]).mean()) for ring in rings]
        places = [float(distance[ring].mean()) for ring in rings]
        if min(slopes) <= 0:
            return math.nan
        return math.log(slopes[1] / slopes[0]) / math.log(places[1] / places[0])

    def profile(self, center: Floats, weights: Floats) -> tuple[Floats, Floats]:
        """Mean distance from the middle, mm, and median fitted slope of rings around it, (k,) each.

        The slope is the horizontal part of the normals, outwards. The rings reach up to the border of the
        window.
        """
        shown = ~self.hidden
        away = np.stack([self.x[shown], self.y[shown]], axis=1) - center
        distance = np.hypot(away[:, 0], away[:, 1])
        outward = np.sum(self.normals(weights, shown) * away, axis=1) / np.maximum(distance, 1e-9)
        ring = (distance / self.reach * EDGE_RINGS).astype(np.int64)
        rings = [ring == number for number in np.flatnonzero(np.bincount(ring) >= FEWEST_PIXELS)]
        slopes = np.array([np.median(outward[members]) for members in rings])
        return np.array([distance[members].mean() for members in rings]), slopes

    def edge(self, center: Floats, weights: Floats) -> float:
        """Distance from the middle at which the gel leaves the ball, mm; see `EDGE_SLOPE_RATIO`.

        NaN where the slope does not fall so far in the window of the press.
        """
        places, slopes = self.profile(center, weights)
        ratios = slopes / np.minimum(places / self.ball_radius, 1.0)
        past = np.flatnonzero((ratios < EDGE_SLOPE_RATIO) & (places > self.reach / 2))
        if not past.size:
            return math.nan
        last = slice(max(past[0] - 1, 0), past[0] + 1)
        return float(np.interp(-EDGE_SLOPE_RATIO, -ratios[last], places[last]))

    def misfit(self, center: Floats, weights: Floats) -> Misfit:
        """Compare the fitted normals with those of the ball."""
        ball = self.on_ball(center)
        found, true = self.normals(weights, ball), self.true_normals(center, ball)
        product, square = float((found * true).sum()), float((found**2).sum())
        if product <= 0:
            return Misfit(180.0, 0.0, math.inf)
        cosine = np.sum(upright(found) * upright(true), axis=1)
        angle = float(np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean())
        return Misfit(angle, product**2 / (square * float((true**2).sum())), product / square)


def prepared(session: Session, scale: Scale, radii: Floats) -> list[Sample]:
    """Prepare the presses of a session. radii : (n,), mm, of the ball of each press."""
    width = SMOOTHED * float(np.median(radii))
    across, down = width / scale.x, width / scale.y

    def smoothed(image: NDArray[np.uint8]) -> NDArray[np.float32]:
        # Rounding to grey levels would add as much noise as a camera has.
        return np.asarray(cv2.GaussianBlur(image.astype(np.float32), (0, 0), across, sigmaY=down), np.float32)

    rests = Rest(session.untouched), Rest(smoothed(session.untouched))
    pairs = zip(session.presses, radii.tolist(), strict=True)
    return [_prepare(press, smoothed(press.image), rests, scale, radius) for press, radius in pairs]


def _prepare(
    press: Press, smoothed: NDArray[np.float32], rests: tuple[Rest, Rest], scale: Scale, ball_radius: float
) -> Sample:
    """smoothed : the picture of the press. rests : the untouched gel, as it is and smoothed."""
    rest = rests[0]
    window = surroundings(press.mask, rest.window).window
    half, smooth = half_resolution(press.image), half_resolution(smoothed)
    gain = rest.around(half, press.mask).gain
    change = colour_change(smooth, rests[1], window, gain)
    dark = smooth[window.part].min(axis=2) < DARK
    change[dark] = colour_change(half, rest, window, gain)[dark]
    place = place_terms((rest.window.right, rest.window.bottom))[(slice(None), *window.part)]
    terms = place.reshape(PLACE_TERMS, 1, -1) * colour_terms(change)
    rows, columns = np.mgrid[window.part]
    hidden = press.hidden[window.whole]
    inner = np.zeros(change.shape[:2], np.bool_)
    inner[RIM:-RIM, RIM:-RIM] = True
    return Sample(
        # The centre of a pixel at half resolution lies between two of the processed frame.
        x=((2.0 * columns + 0.5 - scale.origin[0]) * scale.x).ravel(),
        y=((2.0 * rows + 0.5 - scale.origin[1]) * scale.y).ravel(),
        terms=np.ascontiguousarray(terms.reshape(PLACE_TERMS * COLOUR_TERMS, -1).T),
        hidden=(hidden[::2, ::2] | hidden[1::2, ::2] | hidden[::2, 1::2] | hidden[1::2, 1::2]).ravel(),
        inner=inner.ravel(),
        start=np.array(scale.point(press.center)),
        reach=reach(press, scale, ball_radius),
        window=window,
        ball_radius=ball_radius,
    )


def press_errors(
    session: Session, model: SlopeModel, scale: Scale, ball_radius: float | Sequence[float]
) -> list[list[float]]:
    """Errors of a model on each press of a ball.

    session : what `PressFinder` found. ball_radius : mm, of all presses or of each.

    Returns (n, 3): mean angle of the normals, degrees; relative error of the depth from the middle to the rim
    of the contact, since the gel around it is not known, NaN where a contact is too small; share of the
    normals that is explained, see `Misfit`.
    """
    radii = np.broadcast_to(np.asarray(ball_radius, np.float64), len(session.presses))
    samples = prepared(session, scale, radii)
    return errors_on(session, samples, range(len(samples)), flat(model), scale)


def errors_on(
    session: Session, samples: Sequence[Sample], chosen: Iterable[int], weights: Floats, scale: Scale
) -> list[list[float]]:
    """The same for chosen presses, from coefficients (2, 114). samples : of all presses of the session."""
    rest, surface = Rest(session.untouched), Surface(SlopeModel(shaped(weights)), scale)
    errors = []
    for number in chosen:
        press, sample = session.presses[number], samples[number]
        heights = surface.heights(press.image, rest, press.mask)[sample.window.part]
        errors.append(_errors(sample, weights, heights))
    return errors


def _errors(sample: Sample, weights: Floats, heights: NDArray[np.float32]) -> list[float]:
    """A row of `press_errors`."""
    center = sample.center(sample.start, weights)
    angle, explained, _ = sample.misfit(center, weights)
    found = heights.ravel().astype(np.float64)
    distance = np.hypot(sample.x - center[0], sample.y - center[1])
    ball = distance < sample.reach
    if np.count_nonzero(ball) < FEWEST_PIXELS:
        return [angle, np.nan, explained]
    cap = np.sqrt(sample.ball_radius**2 - distance[ball] ** 2)
    rise = cap - cap.mean()
    return [angle, float(rise @ found[ball] / (rise @ rise)) - 1, explained]


def summary(errors: Sequence[Sequence[float]]) -> dict[str, float]:
    """Numbers of `PhotometricEntry` from the errors of each press."""
    angle, depth, explained = np.transpose(errors)
    return {
        "normal_error": float(np.mean(angle)),
        "depth_stderr": float(np.sqrt(np.nanmean(depth**2))),
        "explained": float(np.median(explained)),
    }


def core_ratio(
    session: Session, samples: Sequence[Sample], chosen: Iterable[int], weights: Floats, scale: Scale
) -> float | None:
    """Radius of the core over that at which the gel leaves the ball, median of the chosen presses.

    None where no press shows both. The other parameters are those of `errors_on`.
    """
    ratios = []
    for number in chosen:
        sample, core = samples[number], session.presses[number].core_radius * math.sqrt(scale.x * scale.y)
        ratios.append(core / sample.edge(sample.center(sample.start, weights), weights))
    known = [ratio for ratio in ratios if math.isfinite(ratio)]
    return float(np.median(known)) if known else None


def fitting_core(ratio: float, core: float) -> float:
    """Fraction of the slope at the border of a core that makes the core fit, see `core` of `difference`.

    ratio : of `core_ratio`, found with the fraction `core`.

    >>> round(fitting_core(1.08, 0.8), 2)
    0.9
    """
    return min(core + (ratio - 1) / CORE_SHRINKAGE, HIGHEST_CORE)


def upright(flat: Floats) -> Floats:
    """(m, 3): unit normals from their horizontal parts (m, 2); longer ones than 1 lie flat."""
    flat = flat / np.maximum(np.hypot(flat[:, 0], flat[:, 1]), 1)[:, None]
    return np.concatenate([flat, np.sqrt(np.maximum(1 - (flat**2).sum(axis=1, keepdims=True), 0))], axis=1)


def flat(model: SlopeModel) -> Floats:
    """(2, 114): the coefficients of a model."""
    return model.coefficients.transpose(2, 0, 1).reshape(2, -1).astype(np.float64)


def shaped(weights: Floats) -> Floats:
    """(6, 19, 2) coefficients, as `SlopeModel` takes them, from (2, 114)."""
    return weights.reshape(2, PLACE_TERMS, COLOUR_TERMS).transpose(1, 2, 0)
