"""Measure the error of the grip force on objects and days unknown to the calibration.

    python lab/force.py [--data ../shared/data] [--keep FOLDER]

Grasps of a Wedge without dots, in two sessions on different days with different objects. Every grasp is
judged by a calibration (as `tactflow calibrate force` makes it) from the grasps of the other objects, and by
one from the other day, whose objects are others, too. Columns: RMS error, N; R2; share of errors within one
and within two stated standard errors, %; the same for a ridge regression on the same features; frames. Frames
count in which a contact is found; how many of those with 0.75 N or more have none is said beside, and how
often contact and force agree on each day. Worst object first.
"""

from __future__ import annotations

import argparse
import logging
import pickle
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

import tactflow
from tactflow.calibration.force import fit_force
from tactflow.calibration.force_samples import Watched, Watcher, align
from tactflow.calibration.reference import Reference, read_reference
from tactflow.engine.errors import ConfigError
from tactflow.message.result import Result
from tactflow.system.terminal import show, table
from tactflow.vision.arrays import Floats
from tactflow.vision.types import Scale

SESSIONS = ("wedge_grip", "wedge_grasp")
"""Folders of recordings, by day. Recordings that are in both count for the first."""
GEL_WIDTH_MM = 18.6
"""Of the gel, mm. It only gives the stiffnesses their unit."""
MIN_TOUCH_FORCE_N = 0.75
"""Minimum force at which a contact should be found, N."""
RIDGE_PENALTY = 1.0
"""Weight of the squared coefficients of features between 0 and 1."""


@dataclass(frozen=True, eq=False)
class Grasp:
    """A recording."""

    name: str
    day: str
    watched: Watched
    reference: Reference

    @property
    def thing(self) -> str:
        """What is grasped."""
        return self.name.rpartition("_")[0]

    @cached_property
    def offset(self) -> float:
        """Of the frames' clock against the gauge's, s; 0 where it cannot be estimated."""
        try:
            found = align(self.name, self.watched, self.reference, self.watched.change_at_rest)
        except ConfigError:
            return 0.0
        return found.offset.seconds

    def force(self) -> Floats:
        """(n,): that of each frame, N, by the gauge's clock as `calibrate force` estimates it."""
        seconds = self.reference.seconds(self.watched.frames, self.watched.times)
        return np.interp(self.watched.times - self.offset, seconds, self.reference.force[:, 2])

    def missed(self) -> Floats:
        """Forces of `MIN_TOUCH_FORCE_N` or more, N, in frames in which no contact is found."""
        force = self.force()
        return force[(force >= MIN_TOUCH_FORCE_N) & ~self.watched.touched]

    def usable(self) -> bool:
        """Whether `calibrate force` takes it."""
        try:
            align(self.name, self.watched, self.reference, self.watched.change_at_rest)
        except ConfigError as problem:
            logging.warning("%s is in no fit, but judged: %s", self.name, problem)
            return False
        return True

    def features(self, change_at_rest: float) -> Floats:
        """(n, k): what the force is linear in, of all frames."""
        known = dict(self.watched.press)
        known["root_change"] = np.maximum(known["root_change"] - change_at_rest, 0)
        return np.stack(list(known.values()), axis=1)


def watch(path: Path) -> Watched:
    """What `tactflow calibrate force` sees of a recording."""
    settings = {"stages.preprocess.rotate": 0, "stages.preprocess.downsample": 2, "sinks.view": None}
    pipeline = replace(tactflow.load("markerless", source=str(path), settings=settings), skipping=False)
    watcher = Watcher()
    for result in tactflow.stream(pipeline, images=True):
        assert result.image is not None
        mm = GEL_WIDTH_MM / result.image.shape[1]
        watcher.add(Result(result.frame, {**result, "scale": Scale(mm, mm, (0.0, 0.0), (0.0, 0.0))}))
    return watcher.watched()


def read(data: Path, keep: Path | None) -> list[Grasp]:
    """All recordings with a force. keep : folder in which their features are cached, or None."""
    grasps: dict[str, Grasp] = {}
    for day in SESSIONS:
        for path in sorted((data / day).glob("*.avi")):
            if path.stem in grasps:
                continue
            kept = None if keep is None else keep / f"{path.stem}.pickle"
            if kept is not None and kept.exists():
                watched = pickle.loads(kept.read_bytes())
            else:
                watched = watch(path)
                if kept is not None:
                    kept.parent.mkdir(parents=True, exist_ok=True)
                    kept.write_bytes(pickle.dumps(watched))
            grasps[path.stem] = Grasp(path.stem, day, watched, read_reference(path.with_suffix(".csv")))
    return list(grasps.values())


def ridge(features: Floats, force: Floats, tried: Floats) -> Floats:
    """Forces that a ridge regression with a constant says."""
    size = np.abs(features).max(axis=0)
    features, tried = features / size, tried / size
    middle = features.mean(axis=0)
    centred = features - middle
    weights = np.linalg.solve(
        centred.T @ centred + RIDGE_PENALTY * np.eye(len(size)), centred.T @ (force - force.mean())
    )
    return np.asarray(force.mean() + (tried - middle) @ weights)


def judge(grasps: Sequence[Grasp], apart: Callable[[Grasp, Grasp], bool]) -> dict[str, Floats]:
    """Object -> (4, n): force, what we say, its standard error, what ridge says, N, frames with contact.

    Each grasp is tried on those usable ones that are apart from it, and left out if they are too few.
    """
    usable = [grasp for grasp in grasps if grasp.usable()]
    found: dict[str, list[Floats]] = {}
    for grasp in grasps:
        others = {other.name: other for other in usable if apart(grasp, other)}
        try:
            fit = fit_force(
                {name: other.watched for name, other in others.items()},
                {name: other.reference for name, other in others.items()},
            )
        except ConfigError as problem:
            logging.warning("%s is not judged: %s", grasp.name, problem)
            continue
        model = fit.entry.model()
        touched = grasp.watched.touched
        tried = grasp.features(model.change_at_rest)[touched]
        names = list(grasp.watched.press)
        values = np.array([model.press.value(dict(zip(names, row, strict=True))) for row in tried])
        errors = np.array([model.press.stderr(value) for value in values])
        learned = [
            (
                other.features(model.change_at_rest)[other.watched.touched],
                other.force()[other.watched.touched],
            )
            for other in others.values()
        ]
        by_ridge = ridge(*(np.concatenate(part) for part in zip(*learned, strict=True)), tried)
        found.setdefault(grasp.thing, []).append(np.stack([grasp.force()[touched], values, errors, by_ridge]))
    return {thing: np.concatenate(parts, axis=1) for thing, parts in found.items()}


def rmse(force: Floats, said: Floats) -> float:
    """Root mean square error, N."""
    return float(np.sqrt(np.mean((said - force) ** 2)))


def r2(force: Floats, said: Floats) -> float:
    """Share of the variance that is explained."""
    return 1 - float(np.mean((said - force) ** 2) / np.var(force))


def agreeing(grasps: Sequence[Grasp], day: str) -> float:
    """Share of a day's frames, %, with a contact if and only if the force is `MIN_TOUCH_FORCE_N` or more."""
    agrees = [(one.force() >= MIN_TOUCH_FORCE_N) == one.watched.touched for one in grasps if one.day == day]
    return 100 * float(np.concatenate(agrees).mean())


def row(name: str, values: Floats) -> list[str]:
    """The columns of an object. values : (4, n), see `judge`."""
    force, said, stated, by_ridge = values
    within = [100 * np.mean(np.abs(said - force) < k * stated) for k in (1, 2)]
    return [
        name,
        *(f"{rmse(force, one):.2f} {r2(force, one):.2f}" for one in (said, by_ridge)),
        f"{within[0]:.0f} {within[1]:.0f}",
        str(len(force)),
    ]


def main() -> None:
    """Judge both ways of leaving out."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--keep", type=Path, help="folder for what was seen of the recordings")
    args = parser.parse_args()
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    grasps = read(args.data, args.keep)
    for title, apart in (
        ("object left out", lambda one, other: one.thing != other.thing),
        ("object and day left out", lambda one, other: one.day != other.day),
    ):
        found = judge(grasps, apart)
        worst_first = sorted(found, key=lambda thing: -rmse(*found[thing][:2]))
        everything = np.concatenate(list(found.values()), axis=1)
        rows = [row("all", everything), *(row(thing, found[thing]) for thing in worst_first)]
        show(["", *table([[title, "RMSE, R2", "of ridge", "one, two", "frames"], *rows])])
    missed = {grasp.name: grasp.missed() for grasp in grasps}
    worst = max(grasps, key=lambda grasp: missed[grasp.name].max(initial=0))
    pressed = sum(int(np.count_nonzero(grasp.force() >= MIN_TOUCH_FORCE_N)) for grasp in grasps)
    show(
        [
            "",
            f"no contact found in {sum(map(len, missed.values()))} of {pressed} frames with "
            f"{MIN_TOUCH_FORCE_N} N or more, up to {missed[worst.name].max(initial=0):.1f} N ({worst.name})",
            *(
                f"{day}: contact agrees with {MIN_TOUCH_FORCE_N} N in {agreeing(grasps, day):.0f} %"
                for day in SESSIONS
            ),
        ]
    )


if __name__ == "__main__":
    main()
