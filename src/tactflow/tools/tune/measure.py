"""Evaluate candidates: errors on the fitted simulator, times on the recording."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from tactflow.engine.graph import Pipeline
from tactflow.tools.bench.lockstep import TimedResult, on_recording, take_turns, with_params
from tactflow.tools.bench.quantities import Tally, rms
from tactflow.tools.bench.scenes import Rendered
from tactflow.tools.bench.score import PipelineScore
from tactflow.tools.bench.timing import TURN_FRAMES, Times
from tactflow.tools.tune.recording import Recording

ERROR_KINDS: Final = {
    "center": "centre of the contact, mean",
    "dots": "displacement of the dots, RMS",
    "flow": "mean flow in the contact, mean",
}
"""Kinds of error, px of the camera image before downsampling."""
SOUNDNESS_TOLERANCES: Final = {
    "missed_half_depth": (3.0, "% of contacts at half depth missed:"),
    "false_contacts": (2.0, "% of idle frames called contact:"),
    "wrong_percent": (0.5, "% of dots confused with others:"),
    "lost_percent": (2.0, "% of dots lost:"),
    "hull_iou": (-0.15, "overlap of the outline with the truth:"),
}
"""Quantity of the bench -> tolerated difference from the best candidate, and its description. A pipeline
outside a tolerance is unsound. Chosen by hand."""
MAX_DISAGREEMENT_PERCENT: Final = 10.0
"""Frames of the recording, %, in which a pipeline may disagree with the most expensive one about contact: the
simulator lacks the sensor's light, wrinkles and stains. All differ at the ends of presses. Chosen by hand."""
FLOW_SETTINGS: Final = frozenset({"stages.field", "stages.flow_in_mask", "stages.flow_in_mask.method"})
"""Settings that change nothing but the mean flow."""


@dataclass(eq=False)
class Trial:
    """A pipeline that is tried, and what was measured.

    Attributes
    ----------
    settings : values that differ from the user's file, as `stages.preprocess.downsample` -> value.
    errors : by kind (`ERROR_KINDS`), px of the camera image.
    quantities : errors by their names in the bench, processed pixels.
    ms : median CPU time of a frame with contact, on the recording; infinite if not measured.
    fault : why it cannot be chosen, or "".
    """

    name: str
    settings: Mapping[str, Any]
    pipeline: Pipeline
    errors: dict[str, float] = field(default_factory=dict[str, float])
    quantities: dict[str, float] = field(default_factory=dict[str, float])
    ms: float = math.inf
    fault: str = ""

    @property
    def error(self) -> float:
        """The largest error; infinite if none is known."""
        return max(self.errors.values(), default=math.inf)

    @property
    def usable(self) -> bool:
        """Whether the pipeline runs, is sound, and has an error."""
        return not self.fault and math.isfinite(self.error)


def judge(
    trials: Sequence[Trial],
    recordings: Sequence[Rendered],
    block: int = TURN_FRAMES,
    limit_s: float = math.inf,
) -> dict[str, float]:
    """Set the errors and faults of trials on simulated recordings, in turns.

    block, limit_s : as for `take_turns`. Returns the name of each trial without a fault -> median CPU time of
    a frame with contact, ms, on the last recording.
    """
    ms: dict[str, float] = {}
    tallies = {trial.name: Tally() for trial in trials}
    scales = dict.fromkeys(tallies, 1.0)
    for rendered in recordings:
        scores = {name: PipelineScore(rendered, tally) for name, tally in tallies.items()}

        def observe(name: str, result: TimedResult, scores: Mapping[str, PipelineScore] = scores) -> str:
            if result.mapping is not None:
                scales[name] = 1.0 / math.sqrt(abs(float(np.linalg.det(result.mapping.matrix[:2, :2]))))
            return scores[name].add(result)

        running = [trial for trial in trials if not trial.fault]
        ready = {t.name: on_recording(_on_sensor(t.pipeline), rendered.path) for t in running}
        times, failures = take_turns(ready, observe, block, limit_s)
        for trial in running:
            trial.fault = failures.get(trial.name, "")
        ms = {trial.name: _busy_ms(times[trial.name]) for trial in running if not trial.fault}
    for trial in trials:
        if not trial.fault:
            trial.quantities = tallies[trial.name].errors()
            trial.errors = _errors(tallies[trial.name], scales[trial.name])
    return ms


def _on_sensor(pipeline: Pipeline) -> Pipeline:
    """The pipeline without the geometry of `preprocess`, except for downsampling."""
    if "preprocess" not in pipeline.nodes:
        return pipeline
    params = pipeline.nodes["preprocess"].params
    kept = params.model_dump(include={"downsample", "method"}, exclude_unset=True)
    return with_params(pipeline, "preprocess", type(params)(**kept))


def _errors(tally: Tally, scale: float) -> dict[str, float]:
    """The errors by kind. scale : px of the camera image per processed pixel."""
    values = tally.values
    per_frame = {
        "center": np.array(values["center_error"]).ravel(),
        "dots": np.array([rms(errors) for errors in values["displacement_rms"] if len(errors)]),
        "flow": np.array(values["flow_error"]).ravel(),
    }
    return {
        kind: scale * float(rms(errors) if kind == "dots" else np.mean(errors))
        for kind, errors in per_frame.items()
        if len(errors)
    }


def _busy_ms(times: Times) -> float:
    """Median time of frames with contact, or of all but references if there are none, ms."""
    return 1e3 * float(np.median(times.get("contact") or times["idle"]))


def mark_unsound(trials: Sequence[Trial]) -> None:
    """Mark trials that are worse than the best by more than `SOUNDNESS_TOLERANCES`, and those with another
    mean flow where none could be compared with the truth."""
    running = [trial for trial in trials if not trial.fault]
    for key, (tolerance, description) in SOUNDNESS_TOLERANCES.items():
        known = [trial for trial in running if key in trial.quantities]
        sign = math.copysign(1.0, tolerance)
        best = min((sign * trial.quantities[key] for trial in known), default=0.0)
        for trial in known:
            value = trial.quantities[key]
            if not trial.fault and sign * value - best > abs(tolerance):
                trial.fault = f"{description} {value:.3g} (best {sign * best:.3g})"
    if not any("flow" in trial.errors for trial in trials):
        for trial in trials:
            if trial.settings.keys() & FLOW_SETTINGS and trial.usable:
                trial.fault = "its mean flow could not be judged: too few dots in the contact"


def measure_on_recording(trials: Sequence[Trial], recording: Recording) -> None:
    """Set the times and faults of the usable trials on the recording, in turns.

    trials : most expensive first.
    """
    running = [trial for trial in trials if trial.usable]
    decisions: dict[str, list[bool]] = {trial.name: [] for trial in running}

    def observe(name: str, result: TimedResult) -> str:
        touching = result.contact is not None
        decisions[name].append(touching)
        return "contact" if touching else "idle"

    times, failures = take_turns(
        {trial.name: on_recording(trial.pipeline, recording.path) for trial in running}, observe
    )
    for trial in running:
        trial.fault = failures.get(trial.name, "")
    running = [trial for trial in running if not trial.fault]
    for trial in running:
        trial.ms = _busy_ms(times[trial.name])
        other = 100.0 * float(np.not_equal(decisions[trial.name], decisions[running[0].name]).mean())
        if other > MAX_DISAGREEMENT_PERCENT:
            trial.fault = f"finds other contacts than {running[0].name} in {other:.0f} % of the recording"
