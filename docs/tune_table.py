"""The table of tune.md: what `tactflow tune` chooses, against trying everything with the truth known.

    python docs/tune_table.py [SENSOR ...]

Six simulated sensors unlike the default one. Each is recorded once for `tune`, which sees no truth; then all
candidates are judged on other recordings of the same sensor with their truth. The budget is 1.5 times the
least true error. Takes one to four minutes of a core for each sensor, most for `dense`: pipelines are started
more than a hundred times, which takes half a second with 520 dots. What is done is told on stderr.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

import cv2

from tactflow.bench.scenes import Case
from tactflow.bench.timing import CopyUnit
from tactflow.config.shipped import find_pipeline
from tactflow.tune.measure import Found, judge, mark_unsound, on_sensor
from tactflow.tune.recording import take
from tactflow.tune.search import DEFAULT, ROUNDS, Goal, Search, Tuned
from tactflow.tune.sensor import Fitted, Look
from tactflow.tune.space import Candidate, candidates

WHITE = (1.0, 1.0, 1.0)
SENSORS = {
    "dense": ("default", Look((800, 600), "markers=26x20&shear=0.6", 2.0, 0.0, 0, WHITE, 1.0)),
    "sparse": ("default", Look((800, 600), "markers=5x5&dot=12", 2.0, 0.0, 0, WHITE, 1.0)),
    "noisy": ("default", Look((800, 600), "markers=10x8", 8.0, 1.0, 70, WHITE, 0.8)),
    "low resolution": ("default", Look((320, 240), "markers=10x8", 2.0, 0.0, 0, WHITE, 1.0)),
    "markerless": ("markerless", Look((640, 480), "markers=none&light=bright", 3.0, 0.0, 0, WHITE, 1.0)),
    "bright dots": ("default", Look((800, 600), "markers=10x8&polarity=bright", 2.0, 0.0, 0, WHITE, 1.0)),
}
"""Name -> the pipeline that tune starts from, and the sensor."""
JUDGED = ROUNDS[-1]
"""Recordings on which everything is judged with its truth: the contacts that tune judges by, made anew."""
ALLOWED = 1.5
"""The budget, in least true errors."""


def exhaustive(file: Path, look: Look, folder: Path) -> list[Found]:
    """Everything, with the truth known."""
    base = Candidate(DEFAULT).load(file)
    rendered = [Fitted(look, case, folder, 9000 + number) for number, case in enumerate(JUDGED)]
    many = [Candidate(DEFAULT), *candidates(base, look.size, None)]
    pipelines = {candidate.name: on_sensor(candidate.load(file)) for candidate in many}
    found = list(judge(pipelines, rendered, folder, CopyUnit(), 0).values())
    for one in rendered:
        one.path.unlink()
    mark_unsound(found)
    return found


def tuned(file: Path, look: Look, budget: float, folder: Path) -> Tuned:
    """What tune says; it sees the recording, and nothing of how it was made."""
    recorded = Fitted(look, Case("press", 120), folder, 77)
    recording = take(str(recorded.path), Candidate(DEFAULT).load(file), folder)
    return Search(file, Goal(max_error=budget), seconds=1800.0, refine=False, say=tell).run(recording, folder)


def row(name: str, folder: Path) -> str:
    """One line of the table."""
    pipeline, look = SENSORS[name]
    file = find_pipeline(pipeline)
    tell(f"{name}: everything")
    found = exhaustive(file, look, folder)
    truth = {one.name: one for one in found}
    budget = ALLOWED * min(one.of("any") for one in found if one.usable)
    best = Goal(max_error=budget).order(found)[0]
    tell(f"{name}: tune, at most {budget:.2f} px")
    result = tuned(file, look, budget, folder)
    if result.chosen is None:
        return f"| {name} | {budget:.2f} | nothing | | | {best.name} | {best.ms.value:.2f} | |"
    chosen = truth[result.chosen.name]
    (said,) = [one for one in result.found if one.name == result.chosen.name]
    regret = 100.0 * (chosen.ms.value / best.ms.value - 1.0)
    within = "yes" if chosen.of("any") <= budget and chosen.usable else "no"
    told = f"{said.of('any'):.2f} | {chosen.of('any'):.2f}, {within}"
    return (
        f"| {name} | {budget:.2f} | {result.chosen.name} | {told} "
        f"| {best.name} | {chosen.ms.value:.2f} / {best.ms.value:.2f} | {regret:+.0f} % |"
    )


def tell(words: str) -> None:
    """Say how far it is."""
    print(f"{time.process_time():6.1f} CPU-s  {words}", file=sys.stderr, flush=True)


def main() -> None:
    """Print the table."""
    cv2.setNumThreads(1)
    print("| sensor | budget, px | chosen | error as told | true error, within | cheapest | ms | regret |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |", flush=True)
    for name in sys.argv[1:] or SENSORS:
        with tempfile.TemporaryDirectory() as folder:
            print(row(name, Path(folder)), flush=True)


if __name__ == "__main__":
    main()
