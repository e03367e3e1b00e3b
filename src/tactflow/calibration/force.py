"""Fit the force on the gel to recordings made while a force gauge was read.

`tactflow.vision.force` explains the features of a contact that the force is linear in, and
`tactflow.vision.field_force` the terms of the displacement of the dots. Of the two, the one with the smaller
error on forces left out is kept, for the press and sideways. Stiffnesses of contacts are never negative, so
that the fit stays plausible a little outside of its range. The errors are cross-validated: each object in
turn is left out, or each recording, press or load where there are too few of the others.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.stats import norm, t

from tactflow.calibration.field_force import error_parts, fit_field
from tactflow.calibration.file import AXES, DotsForceEntry, ForceEntry, LeftOut, LinearForceEntry
from tactflow.calibration.force_samples import Aligned, Watched, align
from tactflow.calibration.reference import Reference, TimeOffset
from tactflow.engine.errors import ConfigError
from tactflow.vision.arrays import Floats
from tactflow.vision.field_force import FieldForce
from tactflow.vision.force import BY_CHANGE, BY_SHEAR

FEWEST_PRESSES: Final = 4
"""Presses that a fit needs at least; ten or more are advised. Chosen by hand."""
FEWEST_GROUPS: Final = 3
"""With at least this many objects, or else recordings, the fit is cross-validated over them. By hand."""
FALSE_FORCES: Final = 0.01
"""Share of the frames at rest whose change of light exceeds the limit for a force without a contact."""
FEWEST_AT_REST: Final = 20
"""Frames at rest from which this limit can be learned: fewer do not show how the light varies."""
MOUNTED_STDERRS: Final = 2.0
"""Standard errors from a quarter turn up to which the axes of a gauge count as parallel to the picture's."""


class Fit(NamedTuple):
    """entry : for the calibration file; sideways only what dots or the flow explain. offsets : recording ->
    that of its clock. field : of the force by dots; None if it is worse, or there are no dots. turned :
    direction of the gauge's x axis in the picture, degrees, counter-clockwise; None without fx and fy.
    mirrored : whether its y axis is mirrored relative to the picture's."""

    entry: ForceEntry
    offsets: dict[str, TimeOffset]
    field: FieldForce | None = None
    turned: float | None = None
    mirrored: bool = False


class Turn(NamedTuple):
    """How the axes of a gauge lie in the picture: the unit number that rotates its x + i y into the
    picture's, and whether its y is mirrored first."""

    factor: complex
    mirrored: bool

    def __call__(self, force: Floats) -> Floats:
        """The same forces (n, 3) in the axes of the picture."""
        sideways = force[:, 0] + 1j * force[:, 1]
        turned = (sideways.conj() if self.mirrored else sideways) * self.factor
        return np.column_stack([turned.real, turned.imag, force[:, 2]])


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
    count = sum(part.count for part in aligned)
    if count < FEWEST_PRESSES:
        raise ConfigError(
            f"calibrate force: required {FEWEST_PRESSES} presses or more (ten are better, by all that the "
            f"sensor will meet), found {count} in {len(aligned)} recordings"
        )
    (features_of_press,) = names
    sideways = all(references[name].sideways for name in watched)
    return fit_aligned(aligned, features_of_press, at_rest, sideways)


def fit_aligned(
    aligned: Sequence[Aligned], features_of_press: Sequence[str], at_rest: float, sideways: bool
) -> Fit:
    """Fit the force to frames with known forces. sideways : whether fx and fy were measured. See `fit_force`.

    Raises ConfigError if neither contacts nor dots show the force.
    """
    left_out, groups, field_groups = _left_out(aligned)
    turn = _turn(aligned, groups, field_groups) if sideways else None
    press, drag = _by_contact(aligned, features_of_press, groups, turn)
    dots, field = _by_dots(aligned, field_groups, turn)
    if press is None and "z" not in dots:
        raise ConfigError("calibrate force: neither contacts nor dots are seen in two or more presses")
    if press is not None and "z" in dots and press.rmse <= dots["z"].rmse:
        del dots["z"]
    by_flow = math.inf if drag is None else 2 * drag.rmse**2
    if "x" in dots and by_flow <= dots["x"].rmse ** 2 + dots["y"].rmse ** 2:
        del dots["x"], dots["y"]
    entry = ForceEntry(
        press=None if "z" in dots else press,
        drag=drag,
        dots=dots,
        change_at_rest=at_rest,
        least_change=None if tuple(features_of_press) != BY_CHANGE else _least_change(aligned),
        recordings={part.name: part.offset.seconds for part in aligned},
        presses=sum(part.count for part in aligned),
        left_out=left_out,
    )
    offsets = {part.name: part.offset for part in aligned}
    # y points down, so that a positive angle of a complex number is clockwise as seen.
    angle = None if turn is None else -float(np.degrees(np.angle(turn.factor)))
    return Fit(entry, offsets, field if dots else None, angle, turn is not None and turn.mirrored)


def _by_contact(
    aligned: Sequence[Aligned], names: Sequence[str], groups: NDArray[np.intp], turn: Turn | None
) -> tuple[LinearForceEntry | None, LinearForceEntry | None]:
    """The fits of the press and sideways to features of contacts; None where there is none.

    groups : (n,), of all frames with a contact, left out in turn.
    """
    if len(np.unique(groups)) < 2:
        return None, None
    force = np.concatenate([part.force for part in aligned])
    press = _learn(names, np.concatenate([part.press for part in aligned]), force[:, 2], groups)
    drag = np.concatenate([part.drag for part in aligned])
    known = np.isfinite(drag).all(axis=1)
    if turn is None or len(np.unique(groups[known])) < 2:
        return press, None
    # The same stiffness for x and y: both are samples of one fit.
    x, y, _ = turn(force[known]).T
    features = np.concatenate([drag[known].real, drag[known].imag])
    learned = _learn(BY_SHEAR, features, np.concatenate([x, y]), np.tile(groups[known], 2))
    return press, learned if learned.r2 > 0 else None


def _by_dots(
    aligned: Sequence[Aligned], groups: NDArray[np.intp], turn: Turn | None
) -> tuple[dict[Literal["x", "y", "z"], DotsForceEntry], FieldForce | None]:
    """The fit to the displacement of the dots: component -> its errors, and the terms; none without dots.

    groups : (n,), of all frames with a field, left out in turn. Errors are those under load.
    """
    fields = [part.field for part in aligned if part.field is not None]
    if len(np.unique(groups)) < FEWEST_GROUPS or len(fields) < len(aligned):
        return {}, None
    loaded = np.concatenate([part.loaded for part in fields])
    if len(np.unique(groups[loaded])) < 2:
        return {}, None
    force = np.concatenate([part.force for part in fields])
    force = np.column_stack([np.full((len(force), 2), np.nan), force[:, 2]]) if turn is None else turn(force)
    fit = fit_field(np.concatenate([part.moved for part in fields]), force, groups)
    loaded = loaded[fit.kept]
    length = np.sqrt(np.nansum(np.square(fit.predicted[loaded]), axis=1))
    entries = {
        axis: DotsForceEntry(
            **_quality(known[fit.kept][loaded], said[loaded], groups[fit.kept][loaded], length)
        )
        for axis, known, said in zip(AXES, force.T, fit.predicted.T, strict=True)
        if np.isfinite(known).all()
    }
    if "x" in entries and min(entries["x"].r2, entries["y"].r2) <= 0:
        del entries["x"], entries["y"]
    return entries, fit.model


def _least_change(aligned: Sequence[Aligned]) -> float | None:
    """Change of the whole gel beyond that at rest that is a force, though no contact is found, mm^2; None
    where the recordings show too few frames at rest to tell."""
    at_rest = np.concatenate([part.change_unloaded for part in aligned])
    if len(at_rest) < FEWEST_AT_REST:
        return None
    return max(float(np.quantile(at_rest, 1 - FALSE_FORCES)), 0.0)


def _left_out(aligned: Sequence[Aligned]) -> tuple[LeftOut, NDArray[np.intp], NDArray[np.intp]]:
    """What is left out in turn to cross-validate the fit, and the group of each frame with a contact and of
    each with a field."""
    names = [Path(part.name).stem for part in aligned]
    # The names of recordings of one object differ in a number at the end.
    objects = [name.rstrip("0123456789").rstrip("_- ") for name in names]
    presses = [part.presses for part in aligned]
    loads = [np.zeros(0, np.intp) if part.field is None else part.field.loads for part in aligned]
    ways: list[tuple[LeftOut, list[str]]] = [("object", objects), ("recording", names)]
    for left_out, labels in ways:
        kinds, numbers = np.unique(labels, return_inverse=True)
        if len(kinds) >= FEWEST_GROUPS:
            by_press, by_load = (
                np.repeat(numbers, [len(part) for part in parts]) for parts in (presses, loads)
            )
            return left_out, by_press, by_load
    first = np.cumsum([0, *(max(map(len, parts)) + 1 for parts in zip(presses, loads, strict=True))])
    by_press, by_load = (
        np.concatenate([part + start for part, start in zip(parts, first, strict=False)])
        for parts in (presses, loads)
    )
    return "load" if all(part.pictures for part in aligned) else "press", by_press, by_load


def try_force(
    entry: ForceEntry, name: str, watched: Watched, reference: Reference, field: FieldForce | None = None
) -> float:
    """RMS error of the force z in another recording, N. field : of the force by dots.

    Raises ConfigError if the reference is of another recording, nothing presses, heights are known in one of
    the two only, or dots are needed and not seen.
    """
    nothing = f"{name}: no frame has both a press and a force; it is of another recording, or nothing pressed"
    if entry.press is not None and watched.press.keys() != entry.press.stiffness.keys():
        raise ConfigError(
            f"{name}: heights are known here and not in the calibration, or the other way round"
        )
    aligned = align(name, watched, reference, entry.change_at_rest)
    if entry.press is not None:
        if not len(aligned.force):
            raise ConfigError(nothing)
        stiffness = np.array([entry.press.stiffness[feature] for feature in watched.press])
        return float(np.sqrt(np.mean((aligned.press @ stiffness - aligned.force[:, 2]) ** 2)))
    if field is None or aligned.field is None:
        raise ConfigError(f"{name}: the calibration measures the force by dots, and none are seen here")
    loaded = aligned.field.loaded
    if not loaded.any():
        raise ConfigError(nothing)
    said = np.array([field(moved)[2] for moved in aligned.field.moved[loaded]])
    return float(np.sqrt(np.mean((said - aligned.field.force[loaded, 2]) ** 2)))


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
    return LinearForceEntry(
        stiffness=dict(zip(names, (fitted / size).tolist(), strict=True)),
        greatest=dict(zip(names, size.tolist(), strict=True)),
        **_quality(force, predicted, groups),
    )


def _quality(
    force: Floats, predicted: Floats, groups: NDArray[np.intp], length: Floats | None = None
) -> dict[str, Any]:
    """error, range, rmse and r2 of an entry. force, predicted : (n,), N, the latter by the other groups.
    length : (n,), N, that a part of the error is relative to; default: predicted.

    The spread of few independent errors is uncertain, and so the stated error is the half width of the
    interval that holds 68 % of them (Student). Errors in a group may resemble each other: their sums say how
    many are independent, between the number of groups and that of frames.
    """
    residual = force - predicted
    spread = float(((force - force.mean()) ** 2).sum())
    sums = np.array([residual[groups == group].sum() for group in np.unique(groups)])
    independent = len(residual) * float(residual @ residual) / max(float(sums @ sums), 1e-30)
    independent = max(independent, len(sums))
    # One degree of freedom goes into the ratio of the two parts of the error.
    few = float(t.ppf(norm.cdf(1), independent - 1)) * math.sqrt(independent / (independent - 1))
    absolute, relative = error_parts(residual, predicted if length is None else length)
    return {
        "error": (few * absolute, few * relative),
        "range": (float(force.min()), float(force.max())),
        "rmse": float(np.sqrt(np.mean(residual**2))),
        "r2": 1 - float(residual @ residual) / spread if spread else 0.0,
    }


def _turn(aligned: Sequence[Aligned], groups: NDArray[np.intp], field_groups: NDArray[np.intp]) -> Turn:
    """How the gauge is mounted: the gel moves in the direction of the force.

    The flow of the contacts shows it, or else the mean displacement of the dots. A gauge is usually mounted
    parallel to the picture, and no gel is equally stiff in all directions: a quarter turn is kept unless the
    jackknife over groups contradicts it.

    Raises ConfigError where neither is known.
    """
    moved = np.concatenate([part.drag[:, 0] for part in aligned])
    force = np.concatenate([part.force for part in aligned])
    known = np.isfinite(moved)
    if len(np.unique(groups[known])) < 2:
        fields = [part.field for part in aligned if part.field is not None]
        if not fields:
            raise ConfigError(
                "calibrate force: the CSV has fx and fy, but the flow of the contact is not known; add the "
                "stages tracker and flow_in_mask, or leave these columns out"
            )
        mean = np.concatenate([part.moved.mean(axis=1) for part in fields])
        moved, groups = mean[:, 0] + 1j * mean[:, 1], field_groups
        force, known = np.concatenate([part.force for part in fields]), np.isfinite(moved)
    sideways = force[known, 0] + 1j * force[known, 1]
    plain, mirror = (
        np.array([(moved[known] * other)[groups[known] == group].sum() for group in np.unique(groups[known])])
        for other in (sideways.conj(), sideways)
    )
    mirrored = abs(mirror.sum()) > abs(plain.sum())
    parts = mirror if mirrored else plain
    total = complex(parts.sum())
    if not total:
        return Turn(1 + 0j, False)
    factor = total / abs(total)
    # Angles relative to that of all, so that none wraps around.
    without = np.angle((total - parts) / factor)
    stderr = math.sqrt((len(parts) - 1) * float(np.var(without)))
    quarter = 1j ** round(np.angle(factor) / (math.pi / 2))
    parallel = abs(np.angle(factor / quarter)) <= MOUNTED_STDERRS * stderr
    return Turn(complex(quarter) if parallel else factor, mirrored)
