"""The table of flow.md: how well the mean flow of the gel in a contact is known.

    python docs/flow_table.py

runs the default pipeline on the nominal scenes and prints the table. Takes about three minutes.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.bench import metrics
from tactflow.bench.lockstep import LockstepPipeline, Outcome
from tactflow.bench.pipelines import on_recording
from tactflow.bench.scenes import FULL, NOMINAL, Rendered, render_all
from tactflow.bench.score import FlowScore
from tactflow.config.load import load_pipeline
from tactflow.sim import Truth
from tactflow.vision.flow import FieldModel, flow_in_mask, flow_of_field
from tactflow.vision.types import Flow, Markers, MarkerStatus

PIPELINE = Path(__file__).resolve().parents[1] / "pipeline.yaml"


@dataclass
class Row:
    """Scores of one scene.

    limit : with the true outline and the true positions of the markers. found : of the default pipeline.
    plain : mean over the markers inside the outline found. stated : px, standard errors of `found`.
    """

    limit: FlowScore = field(default_factory=FlowScore)
    found: FlowScore = field(default_factory=FlowScore)
    plain: FlowScore = field(default_factory=FlowScore)
    stated: list[float] = field(default_factory=list)

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
        ]
        return f"| {name} | " + " | ".join(cells) + " |"


def from_truth(truth: Truth) -> Flow | None:
    """The flow by the true outline and the true positions of the markers that can be seen."""
    seen = np.where(truth.visible, MarkerStatus.TRACKED, MarkerStatus.LOST).astype(np.uint8)
    markers = Markers(truth.origin, truth.position, seen, np.full(len(seen), 1e-3))
    mask: NDArray[np.uint8] = np.uint8(255) * truth.contact_mask
    found = FieldModel(truth.origin, (mask.shape[1], mask.shape[0]))(markers)
    return None if found is None else flow_of_field(found, markers, mask)


def measure(rendered: Rendered) -> Row:
    """Run the default pipeline on one scene."""
    pipeline = LockstepPipeline(on_recording(load_pipeline(PIPELINE), rendered.path), None)
    row = Row()
    for outcome in iter(pipeline.step, None):
        if outcome.mapping is not None:
            row.add(outcome, rendered.truths(outcome.mapping)[outcome.frame.seq])
    return row


def _number(value: float | None, digits: int = 3) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


if __name__ == "__main__":
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory() as folder:
        for recording in render_all(tuple(case for case in FULL if case.label in NOMINAL), Path(folder)):
            print(measure(recording).text(recording.case.label), flush=True)
