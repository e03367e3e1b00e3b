"""What a recording shows for the fit of the force, beside the readings of a gauge."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tactflow.calibration.reference import Reference, TimeOffset, time_offset
from tactflow.engine.errors import ConfigError
from tactflow.engine.once import Once
from tactflow.message.result import Result
from tactflow.vision.arrays import Flags, Floats
from tactflow.vision.field_force import between_dots, displacement
from tactflow.vision.flow.displacement_field import MIN_MARKERS, FieldModel
from tactflow.vision.force import BY_CHANGE, BY_DEPTH, BY_SHEAR, LightChange, Seen, seen

NEEDED: Final = {"contact": "hull", "untouched": "untouched", "scale": "scale"}
"""Ports that a pipeline must have -> the stage that gives them; heights need `depth`, shear a flow, the force
by dots a `tracker`."""
GAP: Final = 3
"""Frames without a contact that do not end a press: a light one flickers. Chosen by hand."""
UNLOADED: Final = 0.01
"""Force over the greatest of a recording, up to which nothing presses: the noise of a gauge."""


@dataclass(frozen=True, eq=False, slots=True)
class Watched:
    """Features of the contacts in a recording, frame by frame; n frames.

    frames, times : (n,) float64, number and time (s). press : feature -> (n,) float64, of `BY_DEPTH` where
    heights are known, else of `BY_CHANGE`, which includes the change at rest; 0 where nothing touches.
    drag : feature -> (n,) complex128, x + i y; NaN where the flow is not known. touched : (n,) bool.
    change : (n,) float64, of the light of the whole gel, touched or not, mm^2. change_at_rest : see
    `ForceModel`. field : (n, S, 2) float64, mm, see `field_force.displacement`; NaN where it is not known,
    None where it never is, 0 in cells that are not `between_dots`. pictures : whether the frames were taken
    one by one, so that times mean nothing.
    """

    frames: Floats
    times: Floats
    press: dict[str, Floats]
    drag: dict[str, NDArray[np.complex128]]
    touched: NDArray[np.bool_]
    change: Floats
    change_at_rest: float
    field: Floats | None = None
    pictures: bool = False


class Moment(NamedTuple):
    """What the gel shows in a frame. number : of the frame. time : s. level : RMS motion of the dots, mm, or
    without dots the change of the light, mm^2."""

    number: int
    time: float
    level: float


class Watcher:
    """Collects the features of results with pictures, from a pipeline with a scale (`NEEDED`) that skips
    nothing. pictures : see `Watched`."""

    def __init__(self, pictures: bool = False) -> None:
        self.pictures = pictures
        self._frames: list[tuple[int, float]] = []
        self._contacts: list[Seen | None] = []
        self._changes: list[float] = []
        self._fields: list[Floats | None] = []
        self._light: LightChange | None = None
        self._once = Once()

    def add(self, result: Result) -> Moment | None:
        """Add one result. Returns how much the gel shows, None for a result without pictures."""
        scale, unmarked, contact = result.scale, result.get("unmarked", result.image), result.contact
        if scale is None or unmarked is None:
            return None
        if self._light is None or self._light.untouched is not result["untouched"]:
            self._light = LightChange(result["untouched"])
        change = scale.area(self._light(unmarked))
        self._frames.append((result.seq, result.t))
        self._contacts.append(
            None if contact is None else seen(contact, scale, result.depth, change, result.flow)
        )
        self._changes.append(change)
        markers, size = result.markers, (unmarked.shape[1], unmarked.shape[0])
        moved = None
        if markers is not None and len(markers.origin) >= MIN_MARKERS:
            moved = displacement(self._once(FieldModel, markers.origin, size), markers, scale, size)
            if moved is not None:
                moved = np.where(self._once(between_dots, markers.origin, size)[:, None], moved, 0.0)
        self._fields.append(moved)
        level = change if moved is None else float(_motion(moved))
        return Moment(len(self._frames) - 1, result.t, level)

    def time(self, index: int) -> float:
        """When a frame was taken, s."""
        return self._frames[index][1]

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
            field=_stacked(self._fields),
            pictures=self.pictures,
        )


def _stacked(fields: list[Floats | None]) -> Floats | None:
    """(n, S, 2) from n displacements (S, 2), with NaN for each None; None if there are none."""
    known = next((field for field in fields if field is not None), None)
    if known is None:
        return None
    unknown = np.full_like(known, np.nan)
    return np.stack([unknown if field is None else field for field in fields])


@dataclass(frozen=True, eq=False, slots=True)
class FieldSamples:
    """The m frames of a recording that have both a displacement field and a force.

    moved : (m, S, 2) float64, mm. force : (m, 3) float64, N. loads : (m,) int, which press, or which of
    several constant loads, a frame belongs to, or the one before it. loaded : (m,) bool, whether there is a
    force.
    """

    moved: Floats
    force: Floats
    loads: NDArray[np.intp]
    loaded: Flags


@dataclass(frozen=True, eq=False, slots=True)
class Aligned:
    """The n frames of a recording that have both a contact and a force.

    name : of the recording. offset : of its time against the reference's. press : (n, k) float64.
    drag : (n, 2) complex128. force : (n, 3) float64, N. presses : (n,) int, which press a frame belongs to.
    change_unloaded : (m,), of the whole gel in frames without a contact and without a force, less that at
        rest, mm^2. field : None without dots. pictures : see `Watched`.
    """

    name: str
    offset: TimeOffset
    press: Floats
    drag: NDArray[np.complex128]
    force: Floats
    presses: NDArray[np.intp]
    change_unloaded: Floats
    field: FieldSamples | None = None
    pictures: bool = False

    @property
    def count(self) -> int:
        """Number of presses, or of loads."""
        by_dots = 0 if self.field is None else len(np.unique(self.field.loads[self.field.loaded]))
        return max(len(np.unique(self.presses)), by_dots)


def align(name: str, watched: Watched, reference: Reference, change_at_rest: float) -> Aligned:
    """Interpolate the force at the frames of a recording. change_at_rest : of the sensor, see `ForceModel`.

    Raises ConfigError if nothing touches, or the reference is of another recording, or has times for pictures
    that were taken one by one.
    """
    if watched.pictures and not reference.by_frame:
        raise ConfigError(
            f"{name}: pictures that were taken one by one have no times; name them in {reference.name} in a "
            "column file or frame instead of t"
        )
    if not watched.touched.any() and watched.field is None:
        raise ConfigError(
            f"{name}: nothing touches the gel in {len(watched.times)} frames; the first must show it "
            "untouched"
        )
    press = features_of_press(watched, change_at_rest)
    seconds = reference.seconds(watched.frames, watched.times)
    offset = TimeOffset(0.0, 0.0)
    if not watched.pictures:
        shown = press
        if watched.field is not None and not watched.touched.any():
            shown = np.nan_to_num(_motion(watched.field))[:, None]
        offset = time_offset(reference, seconds, watched.times, shown)
    now = watched.times - offset.seconds
    known_force = (now >= seconds[0]) & (now <= seconds[-1])
    if watched.pictures:
        known_force &= np.isin(watched.frames, reference.time)
    force = np.stack([np.interp(now, seconds, part) for part in reference.force.T], axis=1)
    size = np.sqrt(np.nansum(np.square(force), axis=1))
    loaded = size > UNLOADED * size[known_force].max(initial=0.0)
    chosen = watched.touched & known_force & (loaded | (not watched.pictures))
    drag = np.stack(list(watched.drag.values()), axis=1)
    at_rest = watched.change[~watched.touched & known_force & ~loaded] - change_at_rest
    numbers = _constant_loads(force) if watched.pictures else _runs(loaded)
    field = None
    if watched.field is not None:
        seen_field = known_force & np.isfinite(watched.field).all(axis=(1, 2))
        field = FieldSamples(
            watched.field[seen_field], force[seen_field], _dense(numbers[seen_field]), loaded[seen_field]
        )
    presses = _dense(numbers[chosen]) if watched.pictures else _runs(watched.touched & known_force)[chosen]
    return Aligned(
        name, offset, press[chosen], drag[chosen], force[chosen], presses, at_rest, field, watched.pictures
    )


def features_of_press(watched: Watched, change_at_rest: float) -> Floats:
    """(n, k), what the press is linear in, without the change at rest."""
    known = dict(watched.press)
    if "root_change" in known:
        known["root_change"] = np.maximum(known["root_change"] - change_at_rest, 0)
    return np.stack(list(known.values()), axis=1)


def _motion(field: Floats) -> Floats:
    """(...,), mm, RMS of displacement fields (..., S, 2)."""
    return np.asarray(np.sqrt(np.square(field).sum(axis=-1).mean(axis=-1)))


def _constant_loads(force: Floats) -> NDArray[np.intp]:
    """(n,) int: equal for frames of equal force (n, 3)."""
    return np.unique(np.nan_to_num(force), axis=0, return_inverse=True)[1].reshape(-1)


def _runs(there: Flags) -> NDArray[np.intp]:
    """(n,) int: number of the run of true frames that a frame belongs to or follows, from 0; runs that less
    than `GAP` frames part are one."""
    found = np.flatnonzero(there)
    if not len(found):
        return np.zeros(len(there), np.intp)
    starts = found[np.diff(found, prepend=found[0] - GAP - 1) > GAP]
    return np.maximum(np.searchsorted(starts, np.arange(len(there)), side="right") - 1, 0)


def _dense(numbers: NDArray[np.intp]) -> NDArray[np.intp]:
    """The same groups, numbered from 0 without gaps."""
    return np.unique(numbers, return_inverse=True)[1].reshape(-1)
