"""Judge slip as an event, and the motion of objects on the gel: on simulated scenes, and on real grasps.

    python -m lab.slip                      # the simulator
    python -m lab.slip --data RECORDINGS    # also RECORDINGS/gels/franka_mini, with franka_slip.csv

Simulated: in how many slipping and other frames slip is reported, and in which of the latter; how late the
first report of each slip is; RMS errors of translation and rotation since the touch; shares of errors within
one and two standard errors. The scenes without slip have 12,000 frames. Frames in which the gel under an
object is only dragged along, or released, are left out.

Real: `franka_slip.csv` has the authors' labels of whole recordings, slip or wiggle; two cameras see a grasp.
`slips.json` and `slips_shaken.json` have the frames [from, to] in which the picture of the object visibly
moves against the dots, labelled by eye, in recordings of slip and in all of wiggle. Reported are: grasps of
slip in which one is found; events outside of the marks, and their time; and jumps of the contact's centre, by
more than 25 px in a frame within the marks of slip, that belong to an event. The constants for objects that
rock, and for what counts as lost, were chosen on these recordings.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
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
LATE = 0.15
"""How late slip may be reported, and for how long after it ended, s: the window of the speed, and the two
frames by which a report outlasts it."""
JUMP_PX = 25.0
"""Motion of a contact's centre in a frame, px, that counts as a jump."""
MARKS = Path(__file__).with_name("slips.json")
SHAKEN_MARKS = Path(__file__).with_name("slips_shaken.json")


class Row(NamedTuple):
    """Counts of a scene: slipping frames, and those of them with a report; other frames, and the indices of
    those with a report; delay of the first report of each slip, s, infinite without one; errors (n, 3) of
    translation, px, and rotation, degrees; standard errors."""

    slipping: int
    found: int
    others: int
    false: list[int]
    delays: list[float]
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
    delays: list[float] = []
    starts: dict[int | None, Floats] = {}
    slipped, before, mapping, began = -math.inf, None, None, None
    for result in tactflow.stream(source=f"sim:{spec}", settings={"stages.slip": {}}):
        # One object for all frames, by which the scene remembers its pixels: each result has a copy.
        mapping = mapping or result["mapping"]
        truth, slip = scene.truth(result.seq, mapping), result.slip
        true = over_gel(scene, result.seq, mapping)
        moves = before is not None and true is not None and math.dist(true[:2], before[:2]) > STILL
        slipped = result.t if truth.slipping or (moves and name not in ROLLS) else slipped
        before = true
        reported = slip is not None and slip.slipping
        if truth.slipping and began is None:
            began = result.t
            delays.append(math.inf)
        began = began if truth.slipping else None
        if began is not None and reported and math.isinf(delays[-1]):
            delays[-1] = result.t - began
        if truth.slipping:
            slipping, found = slipping + 1, found + reported
        elif result.t - slipped > LATE:
            others += 1
            false += [result.seq] * reported
        if true is None or slip is None or slip.translation is None or slip.translation_stderr is None:
            continue
        if slip.since == result.seq:
            starts[slip.since] = true
        elif slip.since in starts:
            missed = np.array([*slip.translation, slip.rotation]) - (true - starts[slip.since])
            missed[2] = (missed[2] + 180) % 360 - 180
            errors.append(missed)
            stated.append([*slip.translation_stderr, slip.rotation_stderr])
    parts = (np.array(part, np.float64).reshape(-1, 3) for part in (errors, stated))
    return Row(slipping, found, others, false, delays, *parts)


def report_simulated(frames: int) -> None:
    """Print a line for each scene, and the totals."""
    print("| scene | reported of slipping | late, ms | reported of others | px | degrees | within one, two |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
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
        late = ", ".join(f"{1000 * delay:.0f}" for delay in row.delays)
        print(f"| {name} | {row.found} of {row.slipping} | {late} | {other} | {known or '| |'} |", flush=True)
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


class Grasp(NamedTuple):
    """Results of a recording: frames [first, last] of each reported slip; frames in which the centre of the
    contact has jumped; frames per second; duration, s."""

    events: list[list[int]]
    jumps: list[int]
    rate: float
    seconds: float


def grasp(path: Path) -> Grasp:
    """Run the pipeline over a recording."""
    settings: dict[str, Any] = {"stages.preprocess.rotate": 0, "stages.preprocess.downsample": 1}
    settings["stages.slip"] = {}
    events: list[list[int]] = []
    jumps, center, times = [], None, []
    for result in tactflow.stream(source=str(path), settings=settings):
        seq, before = result.seq, center
        times.append(result.t)
        center = None if result.contact is None else result.contact.center
        if before is not None and center is not None and math.dist(before, center) > JUMP_PX:
            jumps.append(seq)
        if result.slip is None or not result.slip.slipping:
            continue
        if events and events[-1][1] >= seq - 1:
            events[-1][1] = seq
        else:
            events.append([seq, seq])
    seconds = max(times[-1] - times[0], 1e-9)
    return Grasp(events, jumps, (len(times) - 1) / seconds, seconds)


def overlap(event: list[int], spans: list[list[int]], late: int) -> bool:
    """Whether an event and one of the spans, widened by some frames, have a frame in common."""
    return any(event[0] <= last + late and event[1] >= first - late for first, last in spans)


def report_real(data: Path) -> None:
    """Print in how many grasps of each class slip is reported, and how the labels of frames are met."""
    with (data / "gels" / "franka_slip.csv").open() as file:
        classes = {row["recording"]: row["slipped"] == "1" for row in csv.DictReader(file)}
    marks: dict[str, list[list[int]]] = json.loads(MARKS.read_text())
    marks |= json.loads(SHAKEN_MARKS.read_text())["frames"]
    found: dict[bool, dict[str, bool]] = {True: {}, False: {}}
    onsets: list[float] = []
    false = {True: 0, False: 0}
    minutes = {True: 0.0, False: 0.0}
    jumps = reported = motions = 0
    for recording, slipped in classes.items():
        result = grasp(data / "gels" / "franka_mini" / f"{recording}.avi")
        name, late = recording.rpartition("-")[0], math.ceil(LATE * result.rate)
        found[slipped][name] = found[slipped].get(name, False) or bool(result.events)
        if recording not in marks:
            continue
        spans = marks[recording]
        wrong = [event for event in result.events if not overlap(event, spans, late)]
        false[slipped] += len(wrong)
        minutes[slipped] += result.seconds / 60
        motions += len(spans)
        for span in spans:
            first = [event[0] for event in result.events if overlap(event, [span], late)]
            onsets += [(first[0] - span[0]) / result.rate] if first else []
        inside = [seq for seq in result.jumps if slipped and overlap([seq, seq], spans, 1)]
        jumps += len(inside)
        reported += sum(
            any(seq - 1 <= last and seq + late >= at for at, last in result.events) for seq in inside
        )
        print(f"{recording}: marks {spans}, events {result.events}, wrong {wrong}", flush=True)
    for slipped, word in ((True, "slip"), (False, "wiggle")):
        print(
            f"{word}: reported in {sum(found[slipped].values())} of {len(found[slipped])} grasps; outside of "
            f"the marks {false[slipped]} events in {minutes[slipped]:.1f} minutes"
        )
    print(f"jumps above {JUMP_PX:.0f} px in marks of slip: {reported} of {jumps} reported")
    print(f"marks: {len(onsets)} of {motions} found, first report {np.median(onsets):+.2f} s (median)")


def main() -> None:
    """Measure on the simulator, and on the recordings of a folder."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder of the recordings")
    parser.add_argument("--frames", type=int, default=270, help="of each simulated scene")
    arguments = parser.parse_args()
    report_simulated(arguments.frames)
    if arguments.data is not None:
        report_real(arguments.data)


if __name__ == "__main__":
    main()
