"""Fit the force on the gel to recordings made while a force gauge was read.

`tactflow.vision.force` explains the features that the force is linear in. Stiffnesses are never negative, so
that the fit stays plausible a little outside of its range. The errors are cross-validated: each object in
turn is left out, or each recording or press where there are too few of the others.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from tactflow.calibration.file import ForceEntry, LeftOut, LinearForceEntry
from tactflow.calibration.reference import Reference, TimeOffset, time_offset
from tactflow.engine.errors import ConfigError
from tactflow.message.result import Result
from tactflow.vision.arrays import Floats
from tactflow.vision.force import BY_CHANGE, BY_DEPTH, BY_SHEAR, LightChange, Seen, seen

NEEDED: Final = {"contact": "hull", "untouched": "untouched", "scale": "scale"}
"""Ports that a pipeline must have -> the stage that gives them; heights need `depth`, shear a flow."""
FEWEST_PRESSES: Final = 4
"""Presses that a fit needs at least; ten or more are advised. Chosen by hand."""
FEWEST_GROUPS: Final = 3
"""With at least this many objects, or else recordings, the fit is cross-validated over them. By hand."""
GAP: Final = 3
"""Frames without a contact that do not end a press: a light one flickers. Chosen by hand."""
UNLOADED: Final = 0.01
"""Force over the greatest of a recording, up to which nothing presses: the noise of a gauge."""
FALSE_FORCES: Final = 0.01
"""Share of the frames at rest whose change of light exceeds the limit for a force without a contact."""
FEWEST_AT_REST: Final = 20
"""Frames at rest from which this limit can be learned: fewer do not show how the light varies."""
RATIOS: Final = np.concatenate([[0.0], np.logspace(-3, 1, 41)])
"""Candidates for the ratio of the relative to the absolute part of the standard error, per N."""


@dataclass(frozen=True, eq=False, slots=True)
class Watched:
    """Features of the contacts in a recording, frame by frame; n frames.

    frames, times : (n,) float64, number and time (s). press : feature -> (n,) float64, of `BY_DEPTH` where
    heights are known, else of `BY_CHANGE`, which includes the change at rest; 0 where nothing touches.
    drag : feature -> (n,) complex128, x + i y; NaN where the flow is not known. touched : (n,) bool.
    change : (n,) float64, of the light of the whole gel, touched or not, mm^2. change_at_rest : see
    `ForceModel`.
    """

    frames: Floats
    times: Floats
    press: dict[str, Floats]
    drag: dict[str, NDArray[np.complex128]]
    touched: NDArray[np.bool_]
    change: Floats
    change_at_rest: float


class Watcher:
    """Collects the features of results with pictures, from a pipeline with a scale (`NEEDED`) that skips
    nothing."""

    def __init__(self) -> None:
        self._frames: list[tuple[int, float]] = []
        self._contacts: list[Seen | None] = []
        self._changes: list[float] = []
        self._light: LightChange | None = None

    def add(self, result: Result) -> None:
        """Add one result."""
        scale, unmarked, contact = result.scale, result.get("unmarked", result.image), result.contact
        if scale is None or unmarked is None:
            return
        if self._light is None or self._light.untouched is not result["untouched"]:
            self._light = LightChange(result["untouched"])
        change = scale.area(self._light(unmarked))
        self._frames.append((result.seq, result.t))
        self._contacts.append(
            None if contact is None else seen(contact, scale, result.depth, change, result.flow)
        )
        self._changes.append(change)

    def watched(self) -> Watched:
        """The features of all results. Raises ConfigError if there were none."""
        if not self._frames:
            raise ConfigError("calibrate force: the source has no frames")
        frames, times = np.array(self._frames, float).T
        contacts = [contact or Seen({}, {}) for contact in self._contacts]
        touched = np.array([contact is not None for contact in self._contacts])
        changes = np.array(self._changes)
        at_rest = changes[~touched]
        by_depth = any("volume" in contact.press for contact in contacts)
        unknown = (math.nan, math.nan)
        return Watched(
            frames=frames,
            times=times,
            press={
                name: np.array([contact.press.get(name, 0.0) for contact in contacts])
                for name in (BY_DEPTH if by_depth else BY_CHANGE)
            },
            drag={
                name: np.array([complex(*contact.drag.get(name, unknown)) for contact in contacts])
                for name in BY_SHEAR
            },
            touched=touched,
            change=changes,
            change_at_rest=float(np.median(at_rest)) if len(at_rest) else 0.0,
        )


@dataclass(frozen=True, eq=False, slots=True)
class Aligned:
    """The n frames of a recording that have both a contact and a force.

    name : of the recording. offset : of its time against the reference's. press : (n, k) float64.
    drag : (n, 2) complex128. force : (n, 3) float64, N. presses : (n,) int, which press a frame belongs to.
    change_unloaded : (m,), of the whole gel in frames without a contact and without a force, less that at
        rest, mm^2.
    """

    name: str
    offset: TimeOffset
    press: Floats
    drag: NDArray[np.complex128]
    force: Floats
    presses: NDArray[np.intp]
    change_unloaded: Floats


def align(name: str, watched: Watched, reference: Reference, change_at_rest: float) -> Aligned:
    """Interpolate the force at the frames of a recording. change_at_rest : of the sensor, see `ForceModel`.

    Raises ConfigError if nothing touches, or the reference is of another recording.
    """
    if not watched.touched.any():
        raise ConfigError(
            f"{name}: nothing touches the gel in {len(watched.times)} frames; the first must show it "
            "untouched"
        )
    known = dict(watched.press)
    if "root_change" in known:
        known["root_change"] = np.maximum(known["root_change"] - change_at_rest, 0)
    press = np.stack(list(known.values()), axis=1)
    seconds = reference.seconds(watched.frames, watched.times)
    offset = time_offset(reference, seconds, watched.times, press)
    now = watched.times - offset.seconds
    known_force = (now >= seconds[0]) & (now <= seconds[-1])
    chosen = watched.touched & known_force
    force = np.stack([np.interp(now, seconds, part) for part in reference.force.T], axis=1)
    began = np.flatnonzero(chosen)
    numbers = np.cumsum((np.diff(began, prepend=began[0]) > GAP).astype(np.intp))
    drag = np.stack(list(watched.drag.values()), axis=1)
    unloaded = np.abs(force[:, 2]) <= UNLOADED * float(np.abs(force[:, 2]).max())
    at_rest = watched.change[~watched.touched & known_force & unloaded] - change_at_rest
    return Aligned(name, offset, press[chosen], drag[chosen], force[chosen], numbers, at_rest)


class Fit(NamedTuple):
    """entry : for the calibration file; without `drag` where the flow does not explain fx and fy. offsets :
    recording -> that of its clock. turned : direction of the gauge's x axis in the picture, degrees,
    counter-clockwise; None without fx and fy. mirrored : whether its y axis is mirrored relative to the
    picture's."""

    entry: ForceEntry
    offsets: dict[str, TimeOffset]
    turned: float | None = None
    mirrored: bool = False


def fit_force(watched: Mapping[str, Watched], references: Mapping[str, Reference]) -> Fit:
    """Fit the force to recordings.

    watched, references : recording -> the features of its contacts, and the readings of the gauge.

    Raises ConfigError for too few presses, a reference of another recording, or heights in some recordings
    only.
    """
    names = {tuple(recording.press) for recording in watched.values()}
    if len(names) > 1:
        raise ConfigError("calibrate force: heights are known in some of the recordings only")
    at_rest = float(np.median([recording.change_at_rest for recording in watched.values()]))
    aligned = [align(name, watched[name], references[name], at_rest) for name in watched]
    first = np.cumsum([0, *(int(recording.presses.max()) + 1 for recording in aligned)])
    presses = np.concatenate([part.presses + start for part, start in zip(aligned, first, strict=False)])
    if first[-1] < FEWEST_PRESSES:
        raise ConfigError(
            f"calibrate force: required {FEWEST_PRESSES} presses or more (ten are better, by all that the "
            f"sensor will meet), found {first[-1]} in {len(aligned)} recordings"
        )
    left_out, groups = _left_out(aligned, presses)
    force = np.concatenate([part.force for part in aligned])
    features = np.concatenate([part.press for part in aligned])
    offsets = {part.name: part.offset for part in aligned}
    (features_of_press,) = names
    by_depth = features_of_press != BY_CHANGE
    entry = ForceEntry(
        press=_learn(features_of_press, features, force[:, 2], groups),
        change_at_rest=at_rest,
        least_change=None if by_depth else _least_change(aligned),
        recordings={part.name: part.offset.seconds for part in aligned},
        presses=int(first[-1]),
        left_out=left_out,
    )
    if not all(references[name].sideways for name in watched):
        return Fit(entry, offsets)
    drag = np.concatenate([part.drag for part in aligned])
    known = np.isfinite(drag).all(axis=1)
    if len(np.unique(groups[known])) < 2:
        raise ConfigError(
            "calibrate force: the CSV has fx and fy, but the flow of the contact is not known; add the "
            "stages tracker and flow_in_mask, or leave these columns out"
        )
    drag, sideways, groups = drag[known], force[known, 0] + 1j * force[known, 1], groups[known]
    turn, mirrored = _turn(drag, sideways)
    sideways = (sideways.conj() if mirrored else sideways) * turn
    # The same stiffness for x and y: both are samples of one fit.
    both = [np.concatenate([part.real, part.imag]) for part in (*drag.T, sideways)]
    learned = _learn(BY_SHEAR, np.stack(both[:-1], axis=1), both[-1], np.tile(groups, 2))
    entry = entry.model_copy(update={"drag": learned if learned.r2 > 0 else None})
    # y points down, so that a positive angle of a complex number is clockwise as seen.
    return Fit(entry, offsets, -float(np.degrees(np.angle(turn))), mirrored)


def _least_change(aligned: Sequence[Aligned]) -> float | None:
    """Change of the whole gel beyond that at rest that is a force, though no contact is found, mm^2; None
    where the recordings show too few frames at rest to tell."""
    at_rest = np.concatenate([part.change_unloaded for part in aligned])
    if len(at_rest) < FEWEST_AT_REST:
        return None
    return max(float(np.quantile(at_rest, 1 - FALSE_FORCES)), 0.0)


def _left_out(aligned: Sequence[Aligned], presses: NDArray[np.intp]) -> tuple[LeftOut, NDArray[np.intp]]:
    """What is left out in turn to cross-validate the fit, and the group of each frame, (n,)."""
    names = [Path(part.name).stem for part in aligned]
    # The names of recordings of one object differ in a number at the end.
    objects = [name.rstrip("0123456789").rstrip("_- ") for name in names]
    ways: list[tuple[LeftOut, list[str]]] = [("object", objects), ("recording", names)]
    for left_out, labels in ways:
        kinds, numbers = np.unique(labels, return_inverse=True)
        if len(kinds) >= FEWEST_GROUPS:
            return left_out, np.repeat(numbers, [len(part.press) for part in aligned])
    return "press", presses


def try_force(entry: ForceEntry, name: str, watched: Watched, reference: Reference) -> float:
    """RMS error of the force z in another recording, N.

    Raises ConfigError if the reference is of another recording, or heights are known in one of the two only.
    """
    if watched.press.keys() != entry.press.stiffness.keys():
        raise ConfigError(
            f"{name}: heights are known here and not in the calibration, or the other way round"
        )
    aligned = align(name, watched, reference, entry.change_at_rest)
    stiffness = np.array([entry.press.stiffness[feature] for feature in watched.press])
    return float(np.sqrt(np.mean((aligned.press @ stiffness - aligned.force[:, 2]) ** 2)))


def _learn(
    names: Sequence[str], features: Floats, force: Floats, groups: NDArray[np.intp]
) -> LinearForceEntry:
    """Fit one component. features : (n, k), which differ by orders of magnitude. groups : (n,), left out in
    turn."""
    size = np.maximum(np.abs(features).max(axis=0), 1e-12)
    features = features / size
    fitted = nnls(features, force)[0]
    predicted = np.zeros(len(force))
    for group in np.unique(groups):
        held = groups == group
        predicted[held] = features[held] @ nnls(features[~held], force[~held])[0]
    residual = force - predicted
    spread = float(((force - force.mean()) ** 2).sum())
    return LinearForceEntry(
        stiffness=dict(zip(names, (fitted / size).tolist(), strict=True)),
        greatest=dict(zip(names, size.tolist(), strict=True)),
        error=_error(residual, predicted),
        range=(float(force.min()), float(force.max())),
        rmse=float(np.sqrt(np.mean(residual**2))),
        r2=1 - float(residual @ residual) / spread if spread else 0.0,
    )


def _error(residual: Floats, force: Floats) -> tuple[float, float]:
    """Maximum likelihood estimate of the absolute and the relative part of the standard error.

    residual, force : (n,), N.

    >>> force = np.tile([1.0, 10.0], 500)
    >>> absolute, relative = _error(force * np.random.default_rng(1).normal(0, 0.1, 1000), force)
    >>> absolute < 0.02, round(relative, 1)
    (True, 0.1)
    """
    forms = 1 + (RATIOS[:, None] * force) ** 2
    variances = np.maximum(np.mean(residual**2 / forms, axis=1), 1e-30)
    best = int(np.argmin(len(residual) * np.log(variances) + np.log(forms).sum(axis=1)))
    absolute = math.sqrt(variances[best])
    return absolute, float(RATIOS[best]) * absolute


def _turn(drag: NDArray[np.complex128], force: NDArray[np.complex128]) -> tuple[complex, bool]:
    """The unit number that rotates the gauge's axes into the picture's, and whether y is mirrored first.

    The gel moves in the direction of the force, so the flow shows how the gauge is mounted.
    """
    moved = drag[:, 0]
    plain, mirror = complex((moved * force.conj()).sum()), complex((moved * force).sum())
    mirrored = abs(mirror) > abs(plain)
    direction = mirror if mirrored else plain
    strength = abs(direction)
    return (direction / strength if strength else 1 + 0j), mirrored
