"""The reference of a force calibration: a CSV of time and force, and how its clock differs from ours."""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tactflow.engine.errors import ConfigError

Double = NDArray[np.float64]

NAMES: Final = {
    "t": ("t", "time", "t_s", "time_s"),
    "frame": ("frame",),
    "fx": ("fx", "fx_n", "force_x"),
    "fy": ("fy", "fy_n", "force_y"),
    "fz": ("fz", "fz_n", "force_z", "force", "force_n"),
}
"""What a column may be called, in any case of letters."""
FEWEST_SAMPLES: Final = 10
"""Lines of a CSV at least. Chosen by hand."""
STEADY: Final = 0.02
"""Range of the force, N, up to which it is said to be constant: less than a kitchen scale tells apart."""
MOST_OFFSET: Final = 2.0
"""How far the two clocks may differ, s: two programs started by hand one after the other. Chosen by hand."""
FOLLOWS: Final = 0.7
"""Share of the force's variance that the contact must explain for the two to belong together. By hand: the
right CSVs of wedge_grasp reach 0.92 to 0.98, exchanged ones up to 0.94, as one grasp resembles another."""
OVERLAP: Final = 0.5
"""Part of the frames with contact that must have a force beside them. Chosen by hand."""


@dataclass(frozen=True, eq=False, slots=True)
class Reference:
    """Forces over time.

    name : of the file. time : (N,) float64, growing; s, or the numbers of frames if `by_frame`.
    force : (N, 3) float64, x, y, z, N; NaN in columns that the file does not have.
    """

    name: str
    time: Double
    by_frame: bool
    force: Double

    def seconds(self, frames: Double, times: Double) -> Double:
        """(N,): its time, s. frames, times : (M,) number and time of each frame that was seen, growing."""
        return np.interp(self.time, frames, times) if self.by_frame else self.time

    @property
    def sideways(self) -> bool:
        """Whether it has fx and fy."""
        return bool(np.isfinite(self.force[:, :2]).all())


def read_reference(path: Path) -> Reference:
    """Read a CSV with a header: `t` (s) or `frame`, and `fz` (N); `fx` and `fy` if they were measured.

    Other names that are known: `NAMES`. Other columns do not matter.

    Raises
    ------
    ConfigError : it cannot be read, lacks a column, or has lines that are no numbers, a time that does not
        grow, too few lines, or a constant force.

    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "a.csv"
    >>> _ = path.write_text("time, Force" + "".join(chr(10) + f"{i / 10}, {i}" for i in range(20)))
    >>> read_reference(path).force[3].tolist()
    [nan, nan, 3.0]
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = list(csv.reader(file, skipinitialspace=True))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror or error}") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise ConfigError(f"{path}: is no CSV file: {error}") from None
    columns = _columns(path, rows[0] if rows else [])
    chosen: list[str] = ["t" if "t" in columns else "frame"]
    chosen += [name for name in ("fx", "fy", "fz") if name in columns]
    table = np.full((len(rows), 4), np.nan)
    places = [{"t": 0, "frame": 0, "fx": 1, "fy": 2, "fz": 3}[name] for name in chosen]
    filled = [number for number in range(1, len(rows)) if any(cell.strip() for cell in rows[number])]
    for number in filled:
        table[number, places] = [_number(path, number + 1, name, rows[number], columns) for name in chosen]
    table = table[filled]
    if len(table) < FEWEST_SAMPLES:
        raise ConfigError(f"{path}: required {FEWEST_SAMPLES} lines of force or more, found {len(table)}")
    back = np.flatnonzero(np.diff(table[:, 0]) <= 0)
    if len(back):
        raise ConfigError(
            f"{path}, line {filled[back[0] + 1] + 1}: {chosen[0]} does not grow; required one line for each "
            "moment, in order"
        )
    steady = float(np.ptp(table[:, 3]))
    if steady < STEADY:
        raise ConfigError(
            f"{path}: fz is {table[0, 3]:g} N all along (to {steady:.3f} N); is the gauge connected?"
        )
    return Reference(path.name, table[:, 0], chosen[0] == "frame", table[:, 1:])


def _columns(path: Path, header: list[str]) -> dict[str, int]:
    """Name -> place of the columns that are known."""
    said = [cell.strip().lower() for cell in header]
    columns = {
        name: said.index(word) for name, words in NAMES.items() for word in words[::-1] if word in said
    }
    missing = [] if "t" in columns or "frame" in columns else ["t (s) or frame"]
    missing += [] if "fz" in columns else ["fz (N)"]
    missing += ["fy (N)"] if "fx" in columns and "fy" not in columns else []
    missing += ["fx (N)"] if "fy" in columns and "fx" not in columns else []
    if missing:
        found = ", ".join(filter(None, said[:8])) or "nothing"
        raise ConfigError(
            f"{path}: the first line must name the columns, separated by commas; "
            f"missing {' and '.join(missing)}, found {found}"
        )
    return columns


def _number(path: Path, line: int, name: str, row: list[str], columns: dict[str, int]) -> float:
    text = row[columns[name]] if columns[name] < len(row) else ""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ConfigError(
            f"{path}, line {line}: {name}: required a number, got {text.strip()!r}; leave out lines without "
            "a measurement"
        )
    return value


def nonnegative(features: Double, aim: Double) -> Double:
    """(k,) coefficients >= 0 of the least-squares fit aim = features @ coefficients, without a constant.

    features : (N, k), k at most 3. aim : (N,). All subsets of the features are tried, which is exact.

    >>> nonnegative(np.array([[1.0, 1.0], [2.0, 1.0], [3.0, 1.0]]), np.array([1.0, 3.0, 5.0])).tolist()
    [1.5714285714285714, 0.0]
    """
    matrix, right = features.T @ features, features.T @ aim
    best, least = np.zeros(features.shape[1]), 0.0
    for chosen in range(1, 1 << features.shape[1]):
        part = [k for k in range(features.shape[1]) if chosen >> k & 1]
        solved = np.linalg.lstsq(matrix[np.ix_(part, part)], right[part], rcond=None)[0]
        # The sum of squares less that of `aim` itself.
        rest = float(solved @ matrix[np.ix_(part, part)] @ solved - 2 * solved @ right[part])
        if (solved >= 0).all() and rest < least:
            best, least = np.zeros(features.shape[1]), rest
            best[part] = solved
    return best


def time_offset(reference: Reference, seconds: Double, times: Double, features: Double) -> float:
    """By how much the time of the frames is ahead of the reference's, s.

    It is the shift at which the force follows the contact best, to a fraction of a frame. A gel that answers
    late shifts it too: from one recording the two cannot be told apart.

    Parameters
    ----------
    seconds : (M,) times of the reference. times : (N,) of the frames. features : (N, k), what the force is
        linear in, 0 where nothing touches.

    Raises
    ------
    ConfigError : no shift of up to `MOST_OFFSET` makes the two overlap, or the force follow the contact.
    """
    step = float(np.median(np.diff(times))) if len(times) > 1 else 1.0
    shifts = np.arange(-math.ceil(MOST_OFFSET / step), math.ceil(MOST_OFFSET / step) + 1) * step
    explained = np.array([_explained(reference, seconds, times - shift, features) for shift in shifts])
    if not np.isfinite(explained).any():
        raise ConfigError(
            f"{reference.name}: its time runs from {seconds[0]:.6g} to {seconds[-1]:.6g} s, that of the "
            f"frames from {times[0]:.6g} to {times[-1]:.6g} s, and they may differ by {MOST_OFFSET:g} s; it "
            "is of another recording, or counts from another moment: say by how much with --offset"
        )
    best = int(np.nanargmax(explained))
    if explained[best] < FOLLOWS:
        raise ConfigError(
            f"{reference.name}: the force does not follow the contact, which explains "
            f"{100 * max(explained[best], 0):.0f} % of its variance at the best shift ({shifts[best]:.2f} s; "
            f"required {100 * FOLLOWS:.0f} %); it is of another recording, or its sign is "
            "turned (fz > 0 presses)"
        )
    if not 0 < best < len(shifts) - 1:
        return float(shifts[best])
    before, at, after = explained[best - 1 : best + 2]
    bend = before - 2 * at + after
    # The top of the parabola through the three.
    part = 0.5 * (before - after) / bend if np.isfinite(bend) and bend < 0 else 0.0
    return float(shifts[best] + part * step)


def _explained(reference: Reference, seconds: Double, times: Double, features: Double) -> float:
    """Share of the force's variance that the features explain; NaN where too few frames have a force."""
    there = (times >= seconds[0]) & (times <= seconds[-1])
    touched = features.any(axis=1)
    if np.count_nonzero(there & touched) < max(OVERLAP * np.count_nonzero(touched), 1):
        return math.nan
    force = np.interp(times[there], seconds, reference.force[:, 2])
    spread = float(((force - force.mean()) ** 2).sum())
    if spread == 0:
        return math.nan
    left = force - features[there] @ nonnegative(features[there], force)
    return 1 - float(left @ left) / spread
