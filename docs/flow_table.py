"""The tables of flow.md: how well the mean flow of the gel in a contact is known, and how much of it sticks.

python docs/flow_table.py          runs the default pipeline on the nominal scenes; three minutes
python docs/flow_table.py stick    the stick ratio, from true outlines; half a minute
python docs/flow_table.py honest   errors against their standard errors, from true outlines; a minute
python docs/flow_table.py onset    when slip is said of what slips; three minutes
python docs/flow_table.py false    slip that is said of what sticks or rolls, 20 000 frames; ten minutes
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

import tactflow
from tactflow.bench import metrics
from tactflow.bench.lockstep import LockstepPipeline, Outcome
from tactflow.bench.motion import SlipScore, seen_markers
from tactflow.bench.pipelines import on_recording
from tactflow.bench.scenes import FULL, NOMINAL, Rendered, render_all
from tactflow.bench.score import FlowScore
from tactflow.bench.timing import BLOCK, CopyUnit
from tactflow.config.load import load_pipeline
from tactflow.sim import Truth, open_scene
from tactflow.vision.flow import FieldModel, SlipTest, flow_in_mask, flow_of_field
from tactflow.vision.flow.in_mask import UNKNOWN
from tactflow.vision.geometry import Preprocessor
from tactflow.vision.types import Flow, Markers, MarkerStatus, Slip

PIPELINE = Path(__file__).resolve().parents[1] / "pipeline.yaml"
STICKING = ("press", "bright", "box", "twist", "two", "cable", "roll")
"""Scenes in which nothing slips."""
SLIPPING = ("stick_slip", "stick_slip?markers=16x12", "stick_slip?markers=26x20")
SEEDS = (11, 12)
DRAGGED = ("slide", "stick_slip")
"""Scenes in which contacts slip altogether, twice in each recording."""
ONSET_SEEDS = (7, 11, 12, 13)
KINDS = (
    *(*STICKING, *DRAGGED, "mixed", "bright_cable", "bent_cable", "edge", "ring", "screw"),
    *("strong_shear", "dense", "sparse", "finger"),
)
"""Scenes for standard errors: what moves the gel, and with it the dots."""
KIND_SEEDS = range(21, 27)
APART = 20
"""Frames between two that are looked at: one contact's errors are alike."""
STILL = (*STICKING, "mixed", "dense", "edge", "sparse", "border")
"""Scenes for slip that is not there."""
STILL_FRAMES = 1650
LEAST = 0.1
"""Stick ratio below which a contact is about to slide as a whole."""


@dataclass
class Row:
    """Scores of one scene.

    limit : with the true outline and the true positions of the markers. found : of the default pipeline.
    plain : mean over the markers inside the outline found. stated : px, standard errors of `found`.
    cost : of the stages field and flow_in_mask, medians of their calls, copies of a raw frame.
    """

    limit: FlowScore = field(default_factory=FlowScore)
    found: FlowScore = field(default_factory=FlowScore)
    plain: FlowScore = field(default_factory=FlowScore)
    stated: list[float] = field(default_factory=list)
    cost: float | None = None

    def add(self, outcome: Outcome, truth: Truth) -> None:
        """One frame."""
        if not truth.touching or outcome.markers is None or outcome.contact_mask is None:
            return
        self.limit.add(from_truth(truth), truth)
        self.found.add(outcome.flow, truth)
        self.plain.add(flow_in_mask(outcome.markers, outcome.contact_mask, dilate=0.3), truth)
        if outcome.flow is not None and outcome.flow.stderr is not None:
            self.stated.append(float(np.hypot(*outcome.flow.stderr)))

    def text(self, name: str) -> str:
        """One line of the table."""
        limit, found, plain = (score.errors() for score in (self.limit, self.found, self.plain))
        cells = [
            *(_number(errors.get("flow_rms")) for errors in (limit, found)),
            _number(metrics.percentile(self.stated, 50)),
            *(_number(found.get(key), 0) for key in ("flow_within_one", "flow_within_two")),
            _number(plain.get("flow_rms")),
            _number(self.cost, 1),
        ]
        return f"| {name} | " + " | ".join(cells) + " |"


def from_truth(truth: Truth) -> Flow | None:
    """The flow by the true outline and the true positions of the markers that can be seen."""
    seen = np.where(truth.visible, MarkerStatus.TRACKED, MarkerStatus.LOST).astype(np.uint8)
    markers = Markers(truth.origin, truth.position, seen, np.full(len(seen), 1e-3))
    mask: NDArray[np.uint8] = np.uint8(255) * truth.contact_mask
    found = FieldModel(truth.origin, (mask.shape[1], mask.shape[0]))(markers)
    return None if found is None else flow_of_field(found, markers, mask)


def measure(rendered: Rendered, unit: CopyUnit) -> Row:
    """Run the default pipeline on one scene. unit : measured along the way."""
    pipeline = LockstepPipeline(on_recording(load_pipeline(PIPELINE), rendered.path), None)
    row = Row()
    while outcomes := pipeline.block(BLOCK):
        unit.take(BLOCK)
        for outcome in outcomes:
            if outcome.mapping is not None:
                row.add(outcome, rendered.truths(outcome.mapping)[outcome.frame.seq])
    times = pipeline.stages_ms()
    row.cost = (times["field"] + times["flow_in_mask"]) / unit.copy_ms
    return row


def from_outlines(spec: str) -> Iterator[tuple[Truth, Slip | None]]:
    """The truth of each frame, and what is said of slip by its outline and dots as trackers have them."""
    scene, test, rng = open_scene(spec), SlipTest(), np.random.default_rng(1)
    preprocess = Preprocessor((800, 600), rotate=90, downsample=2)
    model = FieldModel(scene.truth(0, preprocess).origin, preprocess.mapping.size)
    for index in range(len(scene)):
        truth = scene.truth(index, preprocess)
        markers = seen_markers(truth, rng)
        gel = model(markers)
        if not truth.touching or gel is None:
            test.reset()
            yield truth, None
            continue
        mask: NDArray[np.uint8] = np.uint8(255) * truth.contact_mask
        yield truth, test(gel, mask)


def from_pictures(spec: str) -> Iterator[tuple[Truth, Slip | None]]:
    """The truth of each frame, and what the default pipeline with a stage `slip` says."""
    scene = open_scene(spec)
    for result in tactflow.stream(PIPELINE, source=f"sim:{spec}", settings={"stages.slip": {}}):
        yield scene.truth(result.seq), result.slip


def score(told: Iterator[tuple[Truth, Slip | None]]) -> SlipScore:
    """Contact by contact: when slip was said, and whether there was any."""
    found = SlipScore()
    true: list[bool] = []
    said: list[bool] = []
    for truth, slip in told:
        if truth.touching:
            true.append(truth.slipping)
            said.append(slip is not None and slip.slipping)
        elif true:
            found.add(true, said)
            true, said = [], []
    if true:
        found.add(true, said)
    return found


def print_onsets() -> None:
    """For each slip, how many frames after the true onset it is said."""
    rows: tuple[tuple[str, Callable[..., Iterator[tuple[Truth, Slip | None]]], tuple[str, ...]], ...] = (
        ("default pipeline", from_pictures, DRAGGED),
        ("true outlines", from_outlines, (*DRAGGED, *SLIPPING[1:])),
    )
    for label, how, names in rows:
        for name in names:
            separator = "&" if "?" in name else "?"
            late = [
                frames for seed in ONSET_SEEDS for frames in score(how(f"{name}{separator}seed={seed}")).late
            ]
            print(f"| {label} | {name} | {len(late)} | {', '.join(map(str, late))} |", flush=True)


def print_false_slips() -> None:
    """How many frames of contacts that stick or roll are called slip by the default pipeline."""
    total = SlipScore()
    for name in STILL:
        found = score(from_pictures(f"{name}?frames={STILL_FRAMES}&seed=21"))
        print(f"| {name} | {found.touched} | {found.false} |", flush=True)
        total.touched, total.false = total.touched + found.touched, total.false + found.false
    print(f"| all | {total.touched} | {total.false} |")


def errors_over_stated(spec: str) -> list[float]:
    """Errors of the components of the mean, over their standard error, from the true outline."""
    scene, rng = open_scene(spec), np.random.default_rng(1)
    preprocess = Preprocessor((800, 600), rotate=90, downsample=2)
    model = FieldModel(scene.truth(0, preprocess).origin, preprocess.mapping.size)
    found: list[float] = []
    for index in range(5, len(scene), APART):
        truth = scene.truth(index, preprocess)
        if not truth.touching or truth.contact_flow is None:
            continue
        markers, mask = seen_markers(truth, rng), np.uint8(255) * truth.contact_mask
        gel = model(markers)
        motion = None if gel is None else gel.motion(mask)
        if motion is not None and motion.unknown <= UNKNOWN:
            found += (np.abs(np.subtract(motion.mean, truth.contact_flow)) / motion.stderr).tolist()
    return found


def print_honesty() -> None:
    """Kind of contact, errors, and how many are within one and two of their standard errors, %."""
    ratios = {
        name: [ratio for seed in KIND_SEEDS for ratio in errors_over_stated(f"{name}?seed={seed}")]
        for name in KINDS
    }
    ratios["all"] = [ratio for found in ratios.values() for ratio in found]
    for name, found in ratios.items():
        within = (100 * float(np.mean(np.array(found) < bound)) for bound in (1, 2))
        print(f"| {name} | {len(found)} | " + " | ".join(f"{share:.0f}" for share in within) + " |")


def stick_ratios(spec: str) -> NDArray[np.float64]:
    """(n, 2): true and found share of the contact that sticks, of frames in which it is `LEAST` at least."""
    return np.array(
        [
            (truth.stick_ratio, slip.stick_ratio)
            for truth, slip in from_outlines(spec)
            if slip is not None and truth.stick_ratio is not None and truth.stick_ratio >= LEAST
        ]
    )


def print_stick_ratios() -> None:
    """The table of the stick ratio."""
    for name in (*STICKING, *SLIPPING):
        separator = "&" if "?" in name else "?"
        true, found = np.concatenate([stick_ratios(f"{name}{separator}seed={seed}") for seed in SEEDS]).T
        lowest = _number(metrics.percentile(found.tolist(), 10), 2)
        print(
            f"| {name} | {len(true)} | {true.mean():.2f} | {found.mean():.2f} | {lowest} "
            f"| {np.sqrt(np.mean((found - true) ** 2)):.2f} |",
            flush=True,
        )


def _number(value: float | None, digits: int = 3) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


if __name__ == "__main__":
    cv2.setNumThreads(1)
    others = {
        "stick": print_stick_ratios,
        "honest": print_honesty,
        "onset": print_onsets,
        "false": print_false_slips,
    }
    if sys.argv[1:]:
        others[sys.argv[1]]()
        sys.exit()
    copies = CopyUnit()
    with tempfile.TemporaryDirectory() as folder:
        for recording in render_all(tuple(case for case in FULL if case.label in NOMINAL), Path(folder)):
            print(measure(recording, copies).text(recording.case.label), flush=True)
