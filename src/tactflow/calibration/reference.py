"""The reference of a force calibration: a CSV of time and force, and the offset of its clock."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from scipy.optimize import nnls

from tactflow.engine.errors import ConfigError
from tactflow.sources.files import images_of
from tactflow.system.files import expanded
from tactflow.system.spelling import joined
from tactflow.vision.arrays import Floats

NAMES: Final = {
    "t": ("t", "time", "t_s", "time_s"),
    "frame": ("frame",),
    "file": ("file", "picture"),
    "fx": ("fx", "fx_n", "force_x"),
    "fy": ("fy", "fy_n", "force_y"),
    "fz": ("fz", "fz_n", "force_z", "force", "force_n"),
}
"""Column -> the headers that name it, in any case of letters."""
FEWEST_SAMPLES: Final = 10
"""Lines of a CSV at least. Chosen by hand."""
STEADY: Final = 0.02
"""Range of the force, N, up to which it counts as constant: less than a kitchen scale resolves."""
MAX_OFFSET: Final = 2.0
"""How far the two clocks may differ, s: two programs started by hand one after the other. Chosen by hand."""
LEAST_EXPLAINED: Final = 0.7
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
    time: Floats
    by_frame: bool
    force: Floats

    def seconds(self, frames: Floats, times: Floats) -> Floats:
        """(N,): its time, s. frames, times : (M,) number and time of each frame that was seen, growing."""
        return np.interp(self.time, frames, times) if self.by_frame else self.time

    def later(self, seconds: float) -> Reference:
        """The same forces some seconds later; unchanged if they belong to frames."""
        return self if self.by_frame else replace(self, time=self.time + seconds)

    @property
    def sideways(self) -> bool:
        """Whether it has fx and fy."""
        return bool(np.isfinite(self.force[:, :2]).all())


def read_reference(path: Path, source: str = "") -> Reference:
    """Read a CSV with a header: `t` (s) or `frame`, and `fz` (N); `fx` and `fy` if they were measured.

    For a folder of pictures, `file` names the picture of each line instead: a line without one has no force.
    `NAMES` lists other headers that are understood. Further columns are ignored.

    source : the recording or folder. Raises ConfigError for a file that is not such a CSV, has too few lines,
    names another picture, or has a constant force.

    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "a.csv"
    >>> _ = path.write_text("time, Force" + "".join(chr(10) + f"{i / 10}, {i}" for i in range(20)))
    >>> read_reference(path).force[3].tolist()
    [nan, nan, 3.0]
    """
    (_, header), *lines = csv_lines(path) or [(1, [])]
    columns = _columns(path, header)
    rows = [(number, row) for number, row in lines if any(cell.strip() for cell in row)]
    if len(rows) < FEWEST_SAMPLES:
        raise ConfigError(f"{path}: required {FEWEST_SAMPLES} lines of force or more, found {len(rows)}")
    table = {
        name: np.array([_number(f"{path}, line {number}: {name}", row, column) for number, row in rows])
        for name, column in columns.items()
        if name != "file"
    }
    if not {"t", "frame"} & {*table}:
        column = columns["file"]
        names = [(line, row[column].strip() if column < len(row) else "") for line, row in rows]
        table["frame"] = _frames_of_files(path, names, source)
    clock = "t" if "t" in table else "frame"
    back = np.flatnonzero(np.diff(table[clock]) <= 0)
    if len(back):
        line = rows[back[0] + 1][0]
        raise ConfigError(
            f"{path}, line {line}: {clock} does not grow; required one line for each moment, in order"
        )
    steady = float(np.ptp(table["fz"]))
    if steady < STEADY:
        raise ConfigError(
            f"{path}: fz is {table['fz'][0]:g} N all along (to {steady:.3f} N); is the gauge connected?"
        )
    unknown = np.full(len(rows), np.nan)
    force = np.stack([table.get(name, unknown) for name in ("fx", "fy", "fz")], axis=1)
    return Reference(path.name, table[clock], clock == "frame", force)


def csv_lines(path: Path) -> list[tuple[int, list[str]]]:
    """Number and cells of every line of a CSV, blank ones too.

    Raises ConfigError if it cannot be read, or is no CSV.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file, skipinitialspace=True)
            return [(reader.line_num, row) for row in reader]
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror or error}") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise ConfigError(f"{path}: is not a CSV file: {error}") from None


def _columns(path: Path, header: Sequence[str]) -> dict[str, int]:
    """Name -> index of the known columns."""
    found = [cell.strip().lower() for cell in header]
    columns = {
        name: found.index(word) for name, words in NAMES.items() for word in words[::-1] if word in found
    }
    missing = [] if {"t", "frame", "file"} & {*columns} else ["t (s) or frame"]
    missing += [] if "fz" in columns else ["fz (N)"]
    missing += [f"{name} (N)" for name in ("fx", "fy") if name not in columns and {"fx", "fy"} & {*columns}]
    if missing:
        raise ConfigError(
            f"{path}: the first line must name the columns, separated by commas; "
            f"missing {joined(missing)}, found {', '.join(filter(None, found[:8])) or 'nothing'}"
        )
    return columns


def _frames_of_files(path: Path, names: Sequence[tuple[int, str]], source: str) -> Floats:
    """(N,): the numbers of the frames that are named by their pictures in the folder `source`.

    names : line of the CSV and picture.
    """
    folder = expanded(source)
    pictures = images_of(folder) if folder.is_dir() else []
    numbers = {picture.name: float(number) for number, picture in enumerate(pictures)}
    for line, name in names:
        if name not in numbers:
            raise ConfigError(
                f"{path}, line {line}: file: {source or 'the source'} has no picture {name!r}; for a "
                "recording that is not a folder of pictures, give t (s) or frame instead"
            )
    return np.array([numbers[name] for _, name in names])


def _number(what: str, row: Sequence[str], column: int) -> float:
    text = row[column] if column < len(row) else ""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ConfigError(
            f"{what}: required a number, got {text.strip()!r}; leave out lines without a measurement"
        )
    return value


def recordings_with_csv(source: str) -> dict[str, Path]:
    """Recording -> its CSV: one with a CSV of the same name beside it, or all such in a folder.

    Raises ConfigError if there is none.
    """
    path = expanded(source)
    if path.is_file() and path.with_suffix(".csv").is_file():
        return {source: path.with_suffix(".csv")}
    pairs: dict[str, Path] = {}
    for file in sorted(path.glob("*.csv")) if path.is_dir() else []:
        recordings = [other for other in path.iterdir() if other.stem == file.stem and other != file]
        if len(recordings) == 1:
            pairs[str(recordings[0])] = file
    if not pairs:
        raise ConfigError(
            f"calibrate force: found no recording with a CSV of the same name beside it in {source}; name "
            "the CSV with --csv"
        )
    return pairs


class TimeOffset(NamedTuple):
    """By how much the time of the frames is ahead of the reference's, and its standard error, s; the error is
    infinite where the best shift is the largest that was tried."""

    seconds: float
    stderr: float


def time_offset(reference: Reference, seconds: Floats, times: Floats, features: Floats) -> TimeOffset:
    """By how much the time of the frames is ahead of the reference's.

    It is the shift, to a fraction of a frame, with which the contact explains the force best, and includes
    any delay of the gel's response. Its standard error is that of least squares, for residuals that are
    correlated and larger under larger forces (Newey and West, Econometrica 55, 1987).

    seconds : (M,) times of the reference. times : (N,) of the frames. features : (N, k), what the force is
    linear in, 0 where nothing touches.

    Raises ConfigError if no shift of up to `MAX_OFFSET` makes the two overlap and correlate.
    """
    step = float(np.median(np.diff(times))) if len(times) > 1 else 1.0
    shifts = np.arange(-math.ceil(MAX_OFFSET / step), math.ceil(MAX_OFFSET / step) + 1) * step
    explained = np.array([_explained(reference, seconds, times - shift, features) for shift in shifts])
    if not np.isfinite(explained).any():
        raise ConfigError(
            f"{reference.name}: its time runs from {seconds[0]:.6g} to {seconds[-1]:.6g} s, that of the "
            f"frames from {times[0]:.6g} to {times[-1]:.6g} s, and they may differ by {MAX_OFFSET:g} s; it "
            "is of another recording, or counts from another moment: say by how much with --offset"
        )
    best = int(np.nanargmax(explained))
    if explained[best] < LEAST_EXPLAINED:
        raise ConfigError(
            f"{reference.name}: the force does not follow the contact, which explains "
            f"{100 * max(explained[best], 0):.0f} % of its variance at the best shift ({shifts[best]:.2f} s; "
            f"required {100 * LEAST_EXPLAINED:.0f} %); it is of another recording, or its sign is "
            "turned (fz > 0 presses)"
        )
    if not 0 < best < len(shifts) - 1:
        return TimeOffset(float(shifts[best]), math.inf)
    before, at, after = explained[best - 1 : best + 2]
    bend = before - 2 * at + after
    if not (np.isfinite(bend) and bend < 0):
        return TimeOffset(float(shifts[best]), math.inf)
    # The vertex of the parabola through the three.
    part = 0.5 * (before - after) / bend
    offset = float(shifts[best] + part * step)
    return TimeOffset(offset, _offset_stderr(reference, seconds, times - offset, features))


def _offset_stderr(reference: Reference, seconds: Floats, times: Floats, features: Floats) -> float:
    """Standard error of the best shift, s. times : of the frames, by the reference's clock."""
    force, residual = _residual(reference, seconds, times, features)
    if len(force) < FEWEST_SAMPLES:
        return math.inf
    step = float(np.median(np.diff(times)))
    # By how much the residual grows for a shift of a second, and the second derivative of the sum of squares:
    # the rate of the force alone would count its noise as information.
    rate = np.gradient(force, step)
    score, information = rate * residual, float(rate @ np.gradient(force - residual, step))
    variance = float(score @ score)
    lags = math.isqrt(len(score))
    correlated = sum(
        2 * (1 - lag / (lags + 1)) * float(score[lag:] @ score[:-lag]) for lag in range(1, lags + 1)
    )
    return math.sqrt(variance + max(correlated, 0.0)) / information if information > 0 else math.inf


def _explained(reference: Reference, seconds: Floats, times: Floats, features: Floats) -> float:
    """Share of the force's variance that the features explain; NaN if too few frames have a force."""
    there = (times >= seconds[0]) & (times <= seconds[-1])
    touched = features.any(axis=1)
    if np.count_nonzero(there & touched) < max(OVERLAP * np.count_nonzero(touched), 1):
        return math.nan
    force, residual = _residual(reference, seconds, times, features)
    spread = float(((force - force.mean()) ** 2).sum())
    return math.nan if spread == 0 else 1 - float(residual @ residual) / spread


def _residual(
    reference: Reference, seconds: Floats, times: Floats, features: Floats
) -> tuple[Floats, Floats]:
    """(n,) each: the force, N, in the frames that have one, and what the features leave of it."""
    there = (times >= seconds[0]) & (times <= seconds[-1])
    force = np.interp(times[there], seconds, reference.force[:, 2])
    return force, np.asarray(force - features[there] @ nnls(features[there], force)[0])
