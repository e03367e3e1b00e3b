"""Newtons without a force gauge: known weights, or the readings of a kitchen scale, one after the other.

A load counts as soon as it lies still. It is told by the change of the light and by the displacement of the
dots; between two loads nothing touches the gel.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from tactflow.calibration.force import Fit, fit_aligned
from tactflow.calibration.force_samples import (
    Aligned,
    FieldSamples,
    Moment,
    Watched,
    Watcher,
    features_of_press,
)
from tactflow.calibration.reference import TimeOffset, csv_lines
from tactflow.engine.errors import ConfigError
from tactflow.message.result import Result

GRAVITY: Final = 9.80665e-3
"""N per g."""
HOLD_SECONDS: Final = 1.0
"""How long a load must lie still, s: longer than the gel takes to settle, short enough for a hand."""
RELEASE_SECONDS: Final = 0.15
"""Time without contact after which a load is off the gel, s: a light one is missed in single frames, and a
hand takes longer to put on the next."""
SETTLING: Final = 0.05
"""Largest change of what the gel shows within that time, relative: half of the error that is wanted."""
WANTED_ERROR: Final = 0.1
"""Error on loads left out, relative to the largest load, at which the person may stop."""
FEWEST_LOADS: Final = 3
"""Loads that a fit needs: one is left out, and two show whether the gel stiffens."""
MOST_LOADS: Final = 6
"""Loads after which a live session ends in any case."""
REST_FRAMES: Final = 50
"""Frames at rest that are used, spread over the session: so many show the noise, and how the gel recovers."""
COLUMNS: Final[Mapping[str, float]] = {"g": GRAVITY, "fz": 1.0, "kg": 1000 * GRAVITY}
"""Header of a CSV of loads -> N per unit."""


def read_weights(words: Sequence[str]) -> list[float]:
    """Forces of loads in their order, N: from grams, or from a CSV with a column `g`, `kg` or `fz` (N).

    Raises ConfigError for anything else.

    >>> [round(force, 2) for force in read_weights(["100", "500"])]
    [0.98, 4.9]
    """
    if len(words) == 1 and words[0].endswith(".csv"):
        return _read_csv(Path(words[0]))
    return [_force(word, GRAVITY, "--weights") for word in words]


def _read_csv(path: Path) -> list[float]:
    (_, header), *rows = [line for line in csv_lines(path) if line[1]] or [(1, [])]
    names = [cell.strip().lower() for cell in header]
    found = [name for name in COLUMNS if name in names]
    if not found:
        raise ConfigError(
            f"--weights: {path}: the first line must name a column {', '.join(COLUMNS)}, then one line for "
            "each load, in the order in which they were put on"
        )
    if not rows:
        raise ConfigError(f"--weights: {path}: required one line for each load, found none")
    column, unit = names.index(found[0]), COLUMNS[found[0]]
    return [
        _force(row[column] if column < len(row) else "", unit, f"--weights: {path}, line {line}")
        for line, row in rows
    ]


def _force(word: str, unit: float, what: str) -> float:
    try:
        value = float(word)
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        raise ConfigError(f"{what}: required a number above 0, got {word!r}")
    return value * unit


class LoadFinder:
    """Finds loads in frames, which are added one after the other: one for each time that the gel is touched.

    Attributes
    ----------
    loads : (first, last) frame of each load, between which it lies still.
    lasts : whether the last load is still on the gel.
    """

    def __init__(self) -> None:
        self.loads: list[tuple[int, int]] = []
        self.lasts = False
        self._recent: list[Moment] = []

    def add(self, touched: bool, moment: Moment) -> None:
        """Look at a frame."""
        if not touched:
            if self._recent and moment.time - self._recent[-1].time > RELEASE_SECONDS:
                self.lasts, self._recent = False, []
            return
        self._recent.append(moment)
        while moment.time - self._recent[0].time > HOLD_SECONDS:
            self._recent.pop(0)
        if not self.lasts and (settled := self._settled()):
            self.lasts = True
            self.loads.append((settled[0].number, settled[-1].number))

    def _settled(self) -> list[Moment]:
        """The second half of the time to hold, if it shows the same as the first; else none."""
        first, last = self._recent[0].time, self._recent[-1].time
        step = (last - first) / max(len(self._recent) - 1, 1)
        # Half a frame less will do: times of frames are not exact.
        if last - first + 1.5 * step < HOLD_SECONDS:
            return []
        parts = [
            [moment for moment in self._recent if (2 * moment.time > first + last) is after]
            for after in (False, True)
        ]
        early, late = (float(np.mean([moment.level for moment in part])) for part in parts)
        return parts[1] if abs(late - early) <= SETTLING * max(early, late) else []


def align_loads(watched: Watched, loads: Sequence[tuple[int, int]], forces: Sequence[float]) -> Aligned:
    """The frames of loads, with their forces, and some at rest.

    loads : see `LoadFinder`. forces : of each, N; NaN leaves a load out.
    """
    used = [(load, force) for load, force in zip(loads, forces, strict=True) if math.isfinite(force)]
    numbers = np.full(len(watched.times), -1)
    force = np.zeros(len(watched.times))
    for number, ((first, last), newtons) in enumerate(used):
        numbers[first : last + 1], force[first : last + 1] = number, newtons
    loaded = numbers >= 0
    known = np.column_stack([np.full((len(force), 2), np.nan), force])
    rest = np.flatnonzero(~watched.touched & ~loaded)
    chosen = np.sort(np.r_[np.flatnonzero(loaded), rest[:: max(1, len(rest) // REST_FRAMES)]])
    field = None
    if watched.field is not None:
        chosen = chosen[np.isfinite(watched.field[chosen]).all(axis=(1, 2))]
        groups = np.where(loaded, numbers, len(used))[chosen]
        field = FieldSamples(watched.field[chosen], known[chosen], groups, loaded[chosen])
    return Aligned(
        name="loads",
        offset=TimeOffset(0.0, 0.0),
        press=features_of_press(watched, watched.change_at_rest)[loaded],
        drag=np.stack(list(watched.drag.values()), axis=1)[loaded],
        force=known[loaded],
        presses=numbers[loaded],
        change_unloaded=watched.change[rest] - watched.change_at_rest,
        field=field,
        pictures=True,
    )


def fit_loads(watched: Watched, loads: Sequence[tuple[int, int]], forces: Sequence[float]) -> Fit:
    """Fit the force to loads; see `align_loads`. Raises ConfigError for fewer than `FEWEST_LOADS`."""
    count = sum(map(math.isfinite, forces))
    if count < FEWEST_LOADS:
        raise ConfigError(
            f"calibrate force --weights: required {FEWEST_LOADS} loads or more, found {count}; each must lie "
            f"still for {HOLD_SECONDS:g} s, and be taken off before the next"
        )
    aligned = align_loads(watched, loads, forces)
    return fit_aligned([aligned], tuple(watched.press), watched.change_at_rest, sideways=False)


class Weighed(NamedTuple):
    """What a session with known loads shows. loads : see `LoadFinder`. forces : of each, N; NaN: unknown."""

    watched: Watched
    loads: Sequence[tuple[int, int]]
    forces: Sequence[float]


class WeightGuide:
    """Finds loads in results, and says what to do next, and when it is enough.

    `state` may be read from any thread, as the live page does.

    Parameters
    ----------
    forces : of the loads, N, in the order in which they are put on; empty if they are read from a scale.
    say : shows a line.
    fits : whether to fit the loads, and say how good that is.

    Attributes
    ----------
    live : whether a person is told what to do, as opposed to a recording.
    is_enough : whether all loads were put on.
    """

    def __init__(self, forces: Sequence[float], say: Callable[[str], None], fits: bool = True) -> None:
        self._forces, self._say, self._fits = forces, say, fits
        self._watcher, self._finder = Watcher(), LoadFinder()
        self._error = ""
        self._shown = (0, False)
        self.live = True
        self.is_enough = False
        self.state: Mapping[str, Any] = {}
        self._tell()

    def __call__(self, result: Result) -> bool:
        """Look at one result with its pictures; returns whether all loads were put on."""
        moment = self._watcher.add(result)
        if moment is not None:
            self._finder.add(result.contact is not None, moment)
        shown = len(self._finder.loads), self._finder.lasts
        if shown != self._shown:
            if shown[0] > self._shown[0]:
                self._judge()
            self._shown = shown
            self._tell()
        return self.is_enough

    def finish(self, ask: Callable[[float], float]) -> Weighed:
        """All loads. ask : gives the force, N, of a load that lay still at a time, s, if they are
        read from a scale; NaN leaves it out.

        Raises ConfigError if a recording does not show as many loads as there are weights.
        """
        times = [self._watcher.time(last) for _, last in self._finder.loads]
        # A person who puts them on as told may end earlier.
        forces = self._forces[: len(times)] if self.live else self._forces
        if self._forces and len(forces) != len(times):
            found = ", ".join(f"{time:.1f} s" for time in times) or "none"
            weights = "1 weight" if len(forces) == 1 else f"{len(forces)} weights"
            raise ConfigError(
                f"--weights: got {weights}, and found {len(times)} loads that lie still for "
                f"{HOLD_SECONDS:g} s ({found}); each must be taken off before the next"
            )
        return self._weighed(forces or [ask(time) for time in times])

    def _weighed(self, forces: Sequence[float]) -> Weighed:
        return Weighed(self._watcher.watched(), self._finder.loads, forces)

    def _judge(self) -> None:
        """Estimate the error so far, and whether all loads were put on."""
        done = len(self._finder.loads)
        self.is_enough = done >= (len(self._forces) or MOST_LOADS)
        if self._fits and FEWEST_LOADS <= done <= len(self._forces):
            errors = fit_loads(*self._weighed(self._forces[:done])).entry.pressing
            share = errors.rmse / errors.range[1]
            words = f"RMS error on loads left out {errors.rmse:.2f} N, {100 * share:.0f} % of the largest"
            enough = f": enough for up to {errors.range[1]:.1f} N{'' if self.is_enough else ', Ctrl-C ends'}"
            self._error = f"{words}{enough if share <= WANTED_ERROR else ''}."

    def _tell(self) -> None:
        """Say what to do next."""
        done = len(self._finder.loads)
        if self.is_enough:
            now = "All loads are measured."
        elif self._finder.lasts:
            now = "Take it off."
        elif self._forces:
            now = f"Put {self._forces[done] / GRAVITY:.0f} g on the gel, and let go."
        else:
            now = "Press with a steady load, and write down what the scale reads."
        last = f"Load {done} is measured. {self._error}".strip() if self._finder.lasts else ""
        if last or not self.is_enough:
            self._say(f"{last} {now}".strip())
        self.state = {
            "now": now,
            "done": done,
            "good": done,
            "wanted": len(self._forces) or MOST_LOADS,
            "next": None,
            "lasts": self._finder.lasts,
            "presses": [],
            "noun": "loads",
            "note": last,
        }
