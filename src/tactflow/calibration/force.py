"""The force on the gel, learned from recordings beside which a gauge was read.

What the force is linear in, and why, says `tactflow.vision.force`. Stiffnesses are never negative, so that
what lies a little outside of the fit cannot become absurd. The errors are those of forces that the fit has
not seen: each recording in turn is left out, or each press where there are too few recordings.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tactflow.calibration.collecting import collect
from tactflow.calibration.file import ForceEntry, LinearForceEntry
from tactflow.calibration.reference import Reference, nonnegative, time_offset
from tactflow.engine.contract import Sink
from tactflow.engine.errors import ConfigError
from tactflow.engine.frame import Tick
from tactflow.engine.graph import Pipeline
from tactflow.ports import Unmarked, Untouched
from tactflow.vision.force import BY_CHANGE, BY_DEPTH, BY_SHEAR, Seen, seen, total_change
from tactflow.vision.types import Contact, Depth, Flow, Scale

Double = NDArray[np.float64]

FEWEST_PRESSES: Final = 4
"""Presses that a fit needs at least; ten or more are advised. Chosen by hand."""
FEWEST_RECORDINGS: Final = 3
"""Recordings from which on whole ones are left out to judge the fit. Chosen by hand."""
GAP: Final = 3
"""Frames without a contact that do not end a press: a light one flickers. Chosen by hand."""
LEVELS: Final = 20
"""Levels of the force at which hysteresis is looked at. Chosen by hand."""
RATIOS: Final = np.concatenate([[0.0], np.logspace(-3, 1, 41)])
"""Relative over absolute part of the standard error that are tried, per N."""


@dataclass(frozen=True, eq=False, slots=True)
class Watched:
    """What was seen in a recording, frame by frame; n frames.

    frames, times : (n,) float64, number and time (s). press : feature -> (n,) float64, those of `BY_DEPTH`
    where heights are known, else of `BY_CHANGE`; 0 where nothing touches; the change with what is there at
    rest too. drag : feature -> (n,) complex128,
    x + i y; NaN where the flow is not known. touched : (n,) bool. change_at_rest : see `ForceModel`.
    """

    frames: Double
    times: Double
    press: dict[str, Double]
    drag: dict[str, NDArray[np.complex128]]
    touched: NDArray[np.bool_]
    change_at_rest: float


class _Moment(NamedTuple):
    """A frame. found : what is seen of the contact, None without one. change : see `ForceModel`."""

    seq: int
    t: float
    found: Seen | None
    change: float


class _Watch(Sink):
    """Keeps what is seen of each contact."""

    def __init__(self, params: Any) -> None:
        super().__init__(params)
        self.moments: list[_Moment] = []

    def write(
        self,
        tick: Tick,
        unmarked: Unmarked,
        untouched: Untouched,
        scale: Scale,
        contact: Contact | None,
        depth: Depth | None,
        flow: Flow | None,
    ) -> None:
        """Look at one frame."""
        change = scale.area(total_change(unmarked, untouched))
        found = None if contact is None else seen(contact, scale, depth, change, flow)
        self.moments.append(_Moment(tick.frame.seq, tick.frame.t, found, change))


def watch(pipeline: Pipeline, calibration: Path) -> Watched:
    """Run a pipeline on its source, and see what tells of the force.

    Parameters
    ----------
    pipeline : with the stages `hull`, `untouched` and `scale`; heights need `depth`, force sideways a flow.
    calibration : the file, with a scale.

    Raises
    ------
    ConfigError : the pipeline lacks a stage, or its source has no frames.
    TactflowError : a stage or the source failed, as where the calibration does not fit.
    """
    needed = {"contact": "hull", "untouched": "untouched", "scale": "scale"}
    watched: Any = collect(pipeline, _Watch, {}, needed, calibration)
    moments: list[_Moment] = watched.moments
    if not moments:
        raise ConfigError("calibrate force: the source has no frames")
    at_rest = float(np.median([m.change for m in moments if m.found is None] or [0.0]))
    touched = np.array([moment.found is not None for moment in moments])
    by_depth = any(moment.found is not None and "volume" in moment.found.press for moment in moments)
    names = BY_DEPTH if by_depth else BY_CHANGE
    press = {name: np.zeros(len(moments)) for name in names}
    drag = {name: np.full(len(moments), complex(math.nan, math.nan)) for name in BY_SHEAR}
    for i, moment in enumerate(moments):
        if moment.found is None:
            continue
        for name, values in press.items():
            values[i] = moment.found.press.get(name, 0.0)
        for name, (x, y) in moment.found.drag.items():
            drag[name][i] = complex(x, y)
    frames, times = (np.array([getattr(moment, name) for moment in moments], float) for name in ("seq", "t"))
    return Watched(frames, times, press, drag, touched, at_rest)


@dataclass(frozen=True, eq=False, slots=True)
class Aligned:
    """A recording and its reference on one clock, frames with contact and a force only; n of them.

    name, offset : of the recording, and of its time against the reference's, s. press : (n, k) float64.
    drag : (n, 2) complex128. force : (n, 3) float64, N. presses : (n,) int, which press a frame belongs to.
    """

    name: str
    offset: float
    press: Double
    drag: NDArray[np.complex128]
    force: Double
    presses: NDArray[np.intp]


def align(name: str, watched: Watched, reference: Reference, change_at_rest: float) -> Aligned:
    """Put the force beside the frames. change_at_rest : of the sensor, see `ForceModel`.

    Raises
    ------
    ConfigError : nothing touches, or the reference is of another recording.
    """
    if not watched.touched.any():
        raise ConfigError(
            f"{name}: nothing touches the gel in {len(watched.times)} frames; the first must show it "
            "untouched"
        )
    known = dict(watched.press)
    if "change" in known:
        known["change"] = np.maximum(known["change"] - change_at_rest, 0)
    press = np.stack(list(known.values()), axis=1)
    seconds = reference.seconds(watched.frames, watched.times)
    offset = time_offset(reference, seconds, watched.times, press)
    now = watched.times - offset
    chosen = watched.touched & (now >= seconds[0]) & (now <= seconds[-1])
    force = np.stack([np.interp(now, seconds, part) for part in reference.force.T], axis=1)
    began = np.flatnonzero(chosen)
    numbers = np.cumsum((np.diff(began, prepend=began[0]) > GAP).astype(np.intp))
    drag = np.stack(list(watched.drag.values()), axis=1)
    return Aligned(name, offset, press[chosen], drag[chosen], force[chosen], numbers)


class Fit(NamedTuple):
    """entry : for the calibration file; without `drag` where the flow explains nothing of fx and fy. turned :
    how the gauge's x axis lies in the picture, degrees, counter-clockwise as seen; None without fx and fy.
    mirrored : whether its y axis lies on the other side of it than the picture's."""

    entry: ForceEntry
    turned: float | None
    mirrored: bool


def fit_force(watched: Mapping[str, Watched], references: Mapping[str, Reference]) -> Fit:
    """Learn the force from recordings.

    watched, references : recording -> what was seen in it, and what the gauge said.

    Raises
    ------
    ConfigError : too few presses, a reference of another recording, or heights in some recordings only.
    """
    names = {tuple(one.press) for one in watched.values()}
    if len(names) > 1:
        raise ConfigError("calibrate force: heights are known in some of the recordings only")
    at_rest = float(np.median([one.change_at_rest for one in watched.values()]))
    aligned = [align(name, watched[name], references[name], at_rest) for name in watched]
    numbered = _numbered(aligned)
    presses = int(numbered.max()) + 1
    if presses < FEWEST_PRESSES:
        raise ConfigError(
            f"calibrate force: required {FEWEST_PRESSES} presses or more (ten are better, by all that the "
            f"sensor will meet), found {presses} in {len(aligned)} recordings"
        )
    left_out: Literal["recording", "press"] = "recording" if len(aligned) >= FEWEST_RECORDINGS else "press"
    groups = numbered if left_out == "press" else _recordings(aligned)
    force = np.concatenate([one.force for one in aligned])
    press = np.concatenate([one.press for one in aligned])
    entry = ForceEntry(
        press=_learn(next(iter(names)), press, force[:, 2], groups, numbered),
        change_at_rest=at_rest,
        recordings={one.name: one.offset for one in aligned},
        presses=presses,
        left_out=left_out,
    )
    if not all(references[name].sideways for name in watched):
        return Fit(entry, None, False)
    drag = np.concatenate([one.drag for one in aligned])
    known = np.isfinite(drag).all(axis=1)
    if len(np.unique(groups[known])) < 2:
        raise ConfigError(
            "calibrate force: the CSV has fx and fy, but the flow of the contact is not known; add the "
            "stages tracker and flow_in_mask, or leave these columns out"
        )
    sideways = force[known, 0] + 1j * force[known, 1]
    turn, mirrored = _turn(drag[known], sideways)
    sideways = (sideways.conj() if mirrored else sideways) * turn
    # The same stiffness for x and y: both are samples of one fit.
    both = [np.concatenate([part.real, part.imag]) for part in (*drag[known].T, sideways)]
    learned = _learn(BY_SHEAR, np.stack(both[:-1], axis=1), both[-1], np.tile(groups[known], 2), None)
    # y points down, so that a positive angle of a complex number is clockwise as seen.
    turned = -float(np.degrees(np.angle(turn)))
    return Fit(entry.model_copy(update={"drag": learned if learned.r2 > 0 else None}), turned, mirrored)


def try_force(entry: ForceEntry, name: str, watched: Watched, reference: Reference) -> float:
    """RMS error of the force z in another recording, N.

    Raises ConfigError if the reference is of another recording, or heights are known in one of the two only.
    """
    if watched.press.keys() != entry.press.stiffness.keys():
        raise ConfigError(
            f"{name}: heights are known here and not in the calibration, or the other way round"
        )
    one = align(name, watched, reference, entry.change_at_rest)
    stiffness = np.array([entry.press.stiffness[feature] for feature in watched.press])
    return float(np.sqrt(np.mean((one.press @ stiffness - one.force[:, 2]) ** 2)))


def _recordings(aligned: Sequence[Aligned]) -> NDArray[np.intp]:
    """(n,) int: the recording that each frame belongs to."""
    return np.repeat(np.arange(len(aligned)), [len(one.press) for one in aligned])


def _numbered(aligned: Sequence[Aligned]) -> NDArray[np.intp]:
    """(n,) int: the press that each frame belongs to, counted through all recordings."""
    first = np.cumsum([0, *(int(one.presses.max()) + 1 for one in aligned)])
    return np.concatenate([one.presses + start for one, start in zip(aligned, first, strict=False)])


def _learn(
    names: Sequence[str], features: Double, force: Double, groups: NDArray[np.intp], presses: Any
) -> LinearForceEntry:
    """Fit one component. features : (n, k). force : (n,). groups : (n,). presses : (n,), or None for no
    hysteresis."""
    # Features differ by orders of magnitude; at equal size the subsets are told apart best.
    size = np.maximum(np.abs(features).max(axis=0), 1e-12)
    features = features / size
    fitted = nonnegative(features, force)
    unseen = np.zeros(len(force))
    for group in np.unique(groups):
        held = groups == group
        unseen[held] = features[held] @ nonnegative(features[~held], force[~held])
    left = force - unseen
    spread = float(((force - force.mean()) ** 2).sum())
    return LinearForceEntry(
        stiffness=dict(zip(names, (fitted / size).tolist(), strict=True)),
        greatest=dict(zip(names, size.tolist(), strict=True)),
        error=list(_error(left, unseen)),
        range=[float(force.min()), float(force.max())],
        rmse=float(np.sqrt(np.mean(left**2))),
        r2=1 - float(left @ left) / spread if spread else 0.0,
        hysteresis=None if presses is None else _hysteresis(features @ fitted, force, presses),
    )


def _error(left: Double, force: Double) -> tuple[float, float]:
    """The absolute and the relative part of the standard error that make errors `left` (n,) most likely.

    force : (n,), N, at which they were made.

    >>> force = np.tile([1.0, 10.0], 500)
    >>> absolute, relative = _error(force * np.random.default_rng(1).normal(0, 0.1, 1000), force)
    >>> absolute < 0.02, round(relative, 1)
    (True, 0.1)
    """
    best, least = (0.0, 0.0), math.inf
    for ratio in RATIOS.tolist():
        form = 1 + (ratio * force) ** 2
        variance = float(np.mean(left**2 / form))
        surprise = len(left) * math.log(max(variance, 1e-30)) + float(np.log(form).sum())
        if surprise < least:
            absolute = math.sqrt(variance)
            best, least = (absolute, ratio * absolute), surprise
    return best


def _hysteresis(predicted: Double, force: Double, presses: NDArray[np.intp]) -> float | None:
    """Mean distance of the force while the prediction grows and while it falls, over the largest force."""
    apart: list[float] = []
    for number in np.unique(presses):
        ours = presses == number
        seen_now, felt = predicted[ours], force[ours]
        top = int(seen_now.argmax())
        up, down = (np.argsort(part, kind="stable") for part in (seen_now[: top + 1], seen_now[top:]))
        low = max(seen_now[: top + 1].min(), seen_now[top:].min())
        if min(len(up), len(down)) < 2 or low >= seen_now[top]:
            continue
        levels = np.linspace(low, seen_now[top], LEVELS)
        growing = np.interp(levels, seen_now[: top + 1][up], felt[: top + 1][up])
        falling = np.interp(levels, seen_now[top:][down], felt[top:][down])
        apart.append(float(np.abs(growing - falling).mean() / felt.max()))
    return float(np.mean(apart)) if apart else None


def _turn(drag: NDArray[np.complex128], force: NDArray[np.complex128]) -> tuple[complex, bool]:
    """The unit number that turns the gauge's axes into the picture's, and whether y must be mirrored first.

    What drags the gel moves it the same way, so the direction of the flow tells how the gauge is mounted.
    """
    moved = drag[:, 0]
    plain, mirror = complex((moved * force.conj()).sum()), complex((moved * force).sum())
    mirrored = abs(mirror) > abs(plain)
    direction = mirror if mirrored else plain
    strength = abs(direction)
    return (direction / strength if strength else 1 + 0j), mirrored
