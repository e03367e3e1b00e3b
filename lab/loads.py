"""Measure the error of forces in three directions, by dots, under loads unknown to the calibration.

    python -m lab.loads [--data ../shared/data]

Pictures of a FingerVision under weights at angles. Every load (weight and angles) is judged by a calibration
from the others, as `tactflow calibrate force` makes it; so are all loads with one angle about an axis; and
upright weights by a calibration from the other five, as `--weights` makes it. Columns for each component: RMS
error, N; R2; share of errors within one and within two stated standard errors, %; RMS error and R2 of a
linear regression on the mean displacement of the dots alone.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

import tactflow
from lab.force import r2, rmse
from tactflow.calibration.force import fit_force
from tactflow.calibration.force_samples import Watched, Watcher
from tactflow.calibration.reference import Reference
from tactflow.message.result import Result
from tactflow.system.terminal import show, table
from tactflow.vision.arrays import Flags, Floats
from tactflow.vision.force import Seen
from tactflow.vision.types import Scale

MM_PER_PX = 0.1
"""Any value: it only gives the weights their unit."""
GAUGE = ("fx_N", "fz_N", "fy_N")
"""Columns of the labels that are x and y of the picture and the press."""
NAMES = ("fx", "fz (across)", "fy (presses)")
"""The components by the names of the labels."""


class Loads(NamedTuple):
    """n pictures. watched : what `calibrate force` sees. force : (n, 3), N. labels : name -> (n,)."""

    watched: Watched
    force: Floats
    labels: Mapping[str, Floats]

    def part(self, chosen: Flags) -> tuple[dict[str, Watched], dict[str, Reference]]:
        """The arguments of `fit_force` for some pictures; the pictures at rest are always among them."""
        chosen = chosen | ~self.force.any(axis=1)
        seen = self.watched
        assert seen.field is not None
        part = replace(
            seen,
            frames=seen.frames[chosen],
            times=seen.times[chosen],
            press={name: values[chosen] for name, values in seen.press.items()},
            drag={name: values[chosen] for name, values in seen.drag.items()},
            touched=seen.touched[chosen],
            change=seen.change[chosen],
            field=seen.field[chosen],
        )
        known = Reference("labels.csv", seen.frames[chosen], True, self.force[chosen])
        return {"loads": part}, {"loads": known}


def read(folder: Path) -> Loads:
    """The pictures of a folder and their labels."""
    settings = {"stages.preprocess.rotate": 0, "stages.preprocess.downsample": 1, "sinks": {}}
    pipeline = replace(tactflow.load("default", source=str(folder), settings=settings), skipping=False)
    watcher = Watcher(pictures=True)
    for result in tactflow.stream(pipeline, images=True):
        scale = Scale(MM_PER_PX, MM_PER_PX, (0.0, 0.0), (0.0, 0.0))
        watcher.add(Result(result.frame, {**result, "scale": scale}))
    with (folder / "labels.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    labels = {name: np.array([float(row[name]) for row in rows]) for name in rows[0] if name != "file"}
    return Loads(watcher.watched(), np.stack([labels[name] for name in GAUGE], axis=1), labels)


def judge(loads: Loads, groups: Floats, judged: Flags, sideways: bool = True) -> dict[str, Floats]:
    """Judge each group of pictures by a fit to the others.

    groups : (n,). judged : (n,), which pictures. Returns "force", "said", "stated" and "by_mean", by a
    regression on the mean displacement: (m, 3), N, of the m judged pictures.
    """
    field = loads.watched.field
    assert field is not None
    force = loads.force if sideways else np.where([False, False, True], loads.force, np.nan)
    loads = loads._replace(force=force)
    said, stated, by_mean = (np.full(force.shape, np.nan) for _ in range(3))
    mean = np.column_stack([field.mean(axis=1), np.ones(len(force))])
    for group in np.unique(groups[judged]):
        held = judged & (groups == group)
        fit = fit_force(*loads.part(judged & ~held))
        model = fit.entry.model(fit.field)
        for index in np.flatnonzero(held):
            found = model.force(Seen({}, {}), field[index])
            said[index], stated[index] = np.array([found.value, found.stderr], float)
        others = judged & ~held
        by_mean[held] = mean[held] @ np.linalg.lstsq(mean[others], force[others], rcond=None)[0]
    return {
        "force": force[judged],
        "said": said[judged],
        "stated": stated[judged],
        "by_mean": by_mean[judged],
    }


def lines(title: str, found: Mapping[str, Floats]) -> list[str]:
    """A table, one row for each component."""
    rows = [[title, "RMSE, R2", "one, two", "of mean displacement"]]
    for name, force, said, stated, by_mean in zip(
        NAMES, *(values.T for values in found.values()), strict=True
    ):
        if not np.isfinite(force).all():
            continue
        within = [100 * np.mean(np.abs(said - force) < k * stated) for k in (1, 2)]
        rows.append(
            [
                f"{name}, {force.min():.1f} to {force.max():.1f} N",
                f"{rmse(force, said):.2f} {r2(force, said):.3f}",
                f"{within[0]:.0f} {within[1]:.0f}",
                f"{rmse(force, by_mean):.2f} {r2(force, by_mean):.3f}",
            ]
        )
    return ["", *table(rows)]


def main() -> None:
    """Judge all ways of leaving out."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    args = parser.parse_args()
    loads = read(args.data / "fingervision_force")
    loaded = loads.force.any(axis=1)
    load = np.unique(loads.force, axis=0, return_inverse=True)[1].reshape(-1)
    tilted = loads.force[:, :2].any(axis=1)
    show(lines("load left out", judge(loads, load, loaded)))
    for name in ("angle_1_deg", "angle_2_deg"):
        # Upright weights one by one: they all have the same angle.
        angles = np.where(tilted, loads.labels[name], 1000 + load)
        show(lines(f"{name} left out", judge(loads, angles, loaded)))
    show(lines("upright weight left out", judge(loads, load, loaded & ~tilted, sideways=False)))


if __name__ == "__main__":
    main()
