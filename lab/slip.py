"""Judge the motion of objects on the gel: on simulated scenes whose truth is known, and on real grasps.

    python -m lab.slip                      # the simulator
    python -m lab.slip --data RECORDINGS    # RECORDINGS/gels/franka_mini, with franka_slip.csv

Simulated: how often slip is reported in slipping and in other frames, and in which of the latter; RMS errors
of translation and rotation since the touch; shares of errors within one and two standard errors. The scenes
without slip have 12,000 frames. Frames in which the gel under an object is only dragged along, or released,
are left out.

Real: `franka_slip.csv` has the authors' labels of whole recordings, slip or wiggle. `slips.json` has the
frames [from, to] in which the picture of the object visibly moves against the dots, labelled by eye in 25
recordings of each class. Nothing is fitted to either, so that every object is unknown.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import tactflow
from tactflow.sim import Scene
from tactflow.sim.gel import displacement
from tactflow.sim.recipes import SCENES
from tactflow.vision.arrays import Floats
from tactflow.vision.geometry import PixelMapping

ROLLS = ("roll", "tumble")
"""Scenes in which the contact moves without sliding: its motion is not compared."""
STILL = 0.1
"""Motion over the gel in a frame, px, above which a contact being pressed or released counts as neither
slipping nor sticking: the simulated gel follows an object only once it is pressed."""
LATE = 0.1
"""How late slip may be reported, and for how long after it ended, s."""
MARKS = Path(__file__).with_name("slips.json")


class Row(NamedTuple):
    """Counts of a scene: slipping frames, and those of them with a report; other frames, and the indices of
    those with a report; errors (n, 3) of translation, px, and rotation, degrees; standard errors."""

    slipping: int
    found: int
    others: int
    false: list[int]
    errors: Floats
    stated: Floats


def over_gel(scene: Scene, seq: int, mapping: PixelMapping) -> Floats | None:
    """Position of the first indenter's centre on the gel at rest, px, and its rotation there, degrees, (3,);
    None without an indenter."""
    presses = scene.presses(seq)
    if not presses:
        return None
    press = presses[0]
    ahead = np.array([math.cos(press.angle), math.sin(press.angle)])
    under = rest = np.array([press.x, press.y]) + np.array([0 * ahead, ahead])
    for _ in range(9):
        rest = under - displacement(presses, rest)
    x, y = mapping.to_processed(scene.camera.to_raw(rest))[0]
    across, down = rest[1] - rest[0]
    return np.array([x, y, -math.degrees(math.atan2(down, across))])


def simulated(name: str, frames: int) -> Row:
    """Measure a scene."""
    spec = f"{name}?frames={frames}"
    scene = tactflow.open_scene(spec)
    slipping = found = others = 0
    false: list[int] = []
    errors, stated = [], []
    start, slipped, before, mapping = np.zeros(3), -math.inf, None, None
    for result in tactflow.stream(source=f"sim:{spec}", settings={"stages.slip": {}}):
        # One object for all frames, by which the scene remembers its pixels: each result has a copy.
        mapping = mapping or result["mapping"]
        truth, slip = scene.truth(result.seq, mapping), result.slip
        true = over_gel(scene, result.seq, mapping)
        moves = before is not None and true is not None and math.dist(true[:2], before[:2]) > STILL
        slipped = result.t if truth.slipping or (moves and name not in ROLLS) else slipped
        before = true
        reported = slip is not None and slip.slipping
        if truth.slipping:
            slipping, found = slipping + 1, found + reported
        elif result.t - slipped > LATE:
            others += 1
            false += [result.seq] * reported
        if true is None or slip is None or slip.translation is None or slip.translation_stderr is None:
            continue
        if slip.since == result.seq:
            start = true
        else:
            missed = np.array([*slip.translation, slip.rotation]) - (true - start)
            missed[2] = (missed[2] + 180) % 360 - 180
            errors.append(missed)
            stated.append([*slip.translation_stderr, slip.rotation_stderr])
    parts = (np.array(part, np.float64).reshape(-1, 3) for part in (errors, stated))
    return Row(slipping, found, others, false, *parts)


def report_simulated(frames: int) -> None:
    """Print a line for each scene, and the totals."""
    print("| scene | reported of slipping | reported of others | px | degrees | within one, two |")
    print("| --- | --- | --- | --- | --- | --- |")
    every = []
    for name, recipe in SCENES.items():
        if recipe.programme is None or recipe.settings.get("markers") == (0, 0):
            continue
        row = simulated(name, frames)
        every.append(row)
        known = ""
        if len(row.errors) and name not in ROLLS:
            x, y, turn = np.sqrt(np.mean(row.errors**2, axis=0)).tolist()
            known = f"{math.hypot(x, y):.2f} | {turn:.2f} | {within([row])}"
        other = f"{len(row.false)} of {row.others} {row.false or ''}"
        print(f"| {name} | {row.found} of {row.slipping} | {other} | {known or '| |'} |", flush=True)
    quiet = [row for row in every if not row.slipping]
    false, others = sum(len(row.false) for row in quiet), sum(row.others for row in quiet)
    print(f"Scenes without slip: reported in {false} of {others} frames.")
    print(
        f"Scenes with slip, errors within one, two standard errors: {within(r for r in every if r.slipping)}"
    )


def within(rows: Iterable[Row]) -> str:
    """Shares of errors of translation and rotation within one and two standard errors."""
    ratio = np.concatenate([np.abs(row.errors) / np.maximum(row.stated, 1e-9) for row in rows])
    return ", ".join(f"{100 * np.mean(ratio < bound):.0f} %" for bound in (1, 2))


def reported_frames(path: Path) -> tuple[list[int], float]:
    """Frames of a recording in which slip is reported; frames per second."""
    settings: dict[str, Any] = {"stages.preprocess.rotate": 0, "stages.preprocess.downsample": 1}
    settings["stages.slip"] = {}
    results = [(r.seq, r.t, r.slip) for r in tactflow.stream(source=str(path), settings=settings)]
    rate = (results[-1][0] - results[0][0]) / max(results[-1][1] - results[0][1], 1e-9)
    return [seq for seq, _, slip in results if slip is not None and slip.slipping], rate


def report_real(data: Path) -> None:
    """Print in how many recordings of each class slip is reported, per object, and how labels are met."""
    with (data / "gels" / "franka_slip.csv").open() as file:
        classes = {row["recording"]: row["slipped"] == "1" for row in csv.DictReader(file)}
    marks: dict[str, list[list[int]]] = json.loads(MARKS.read_text())
    objects: dict[str, dict[bool, list[bool]]] = defaultdict(lambda: {True: [], False: []})
    onsets: list[float | None] = []
    quiet = false = 0
    for recording, slipped in classes.items():
        frames, rate = reported_frames(data / "gels" / "franka_mini" / f"{recording}.avi")
        objects[recording.split("-")[0]][slipped].append(bool(frames))
        if recording not in marks:
            continue
        late = math.ceil(LATE * rate)
        spans = [(first - late, last + late) for first, last in marks[recording]]
        inside = [[seq for seq in frames if first <= seq <= last] for first, last in spans]
        onsets += [
            (seqs[0] - mark[0]) / rate if seqs else None
            for seqs, mark in zip(inside, marks[recording], strict=True)
        ]
        false += len(frames) - len({seq for seqs in inside for seq in seqs})
        quiet += not spans and not frames
    objects["all"] = {kind: [t for by in objects.values() for t in by[kind]] for kind in (True, False)}
    for name, by in objects.items():
        print(f"{name}: {sum(by[True])} of {len(by[True])} slip, {sum(by[False])} of {len(by[False])} wiggle")
    known = [onset for onset in onsets if onset is not None]
    near = sum(abs(onset) <= LATE for onset in known)
    print(
        f"marks: {len(known)} of {len(onsets)} motions found, {near} within {LATE} s of their start, "
        f"median {np.median(known):+.2f} s; frames reported outside of them: {false}; recordings without "
        f"motion and without a report: {quiet} of {sum(not spans for spans in marks.values())}"
    )


def main() -> None:
    """Measure on the simulator, or on the recordings of a folder."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder of the recordings")
    parser.add_argument("--frames", type=int, default=270, help="of each simulated scene")
    arguments = parser.parse_args()
    if arguments.data is None:
        report_simulated(arguments.frames)
    else:
        report_real(arguments.data)


if __name__ == "__main__":
    main()
