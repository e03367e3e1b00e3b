"""Evaluate candidates: errors on the fitted simulator, times on the recording."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from tactflow.bench.lockstep import TimedResult, on_recording, take_turns, with_params
from tactflow.bench.quantities import Tally, rms
from tactflow.bench.scenes import Rendered
from tactflow.bench.score import PipelineScore
from tactflow.bench.timing import Times
from tactflow.engine.graph import Pipeline
from tactflow.tune.recording import Recording

ERRORS: Final = {
    "center": "centre of the contact, mean",
    "dots": "displacement of the dots, RMS",
    "flow": "mean flow in the contact, mean",
}
"""Kinds of error, px of the camera image before downsampling."""
SOUND: Final = {
    "missed_half_depth": (3.0, "% of contacts at half depth missed:"),
    "false_contacts": (2.0, "% of idle frames called contact:"),
    "wrong_percent": (0.5, "% of dots confused with others:"),
    "lost_percent": (2.0, "% of dots lost:"),
    "hull_iou": (-0.15, "overlap of the outline with the truth:"),
}
"""Quantity of the bench -> tolerated difference from the best candidate, and its description. A pipeline
outside a tolerance is unsound. Chosen by hand."""
CHECKS: Final = {
    "agreement": "contact decisions equal to those of the most expensive candidate, %",
    "distance": "distance of the centre from that of the most expensive candidate, median, px",
}
"""Comparisons on the recording, without truth."""
BLOCK: Final = 10
"""Consecutive frames per bootstrap block, because neighbours share a contact. Chosen by hand."""
DRAWS: Final = 200
"""Bootstrap draws: they give the ends of a 90 % interval to a tenth of its width."""
INTERVAL: Final = (5.0, 95.0)
"""Percentiles of an interval's ends."""
FLOW: Final = frozenset({"stages.field", "stages.flow_in_mask.method"})
"""Settings that change nothing but the mean flow."""


@dataclass
class Interval:
    """A value and its 90 % interval."""

    value: float = math.nan
    low: float = math.nan
    high: float = math.nan

    @property
    def likely(self) -> float:
        """What four of five draws stay below. The upper end is an expensive bound: 2.3 times the CPU time on
        a gel without dots."""
        return (self.value + self.high) / 2


@dataclass(eq=False)
class Trial:
    """A pipeline that is tried, and what was measured.

    settings : values that differ from the user's file, as `stages.preprocess.downsample` -> value.
    errors : by kind (`ERRORS`), px of the camera image. quantities : errors by their names in the bench,
    processed pixels. ms : median CPU time of a frame with contact. failure : error message if it does not
    run. unsound : the quantity that exceeds its tolerance (`SOUND`), or "". checks : by name (`CHECKS`).
    """

    name: str
    settings: Mapping[str, Any]
    pipeline: Pipeline
    errors: dict[str, Interval] = field(default_factory=dict[str, Interval])
    quantities: dict[str, float] = field(default_factory=dict[str, float])
    ms: Interval = field(default_factory=Interval)
    failure: str | None = None
    unsound: str = ""
    checks: dict[str, float] = field(default_factory=dict[str, float])

    @property
    def error(self) -> Interval:
        """The largest error; infinite if none is known."""
        return max(self.errors.values(), key=lambda error: error.value, default=Interval(math.inf))

    @property
    def usable(self) -> bool:
        """Whether the pipeline runs, is sound, and has an error."""
        return self.failure is None and not self.unsound and math.isfinite(self.error.value)


def judge(trials: Sequence[Trial], recordings: Sequence[Rendered]) -> None:
    """Set the errors, times and failures of trials on simulated recordings, in turns."""
    pipelines = {trial.name: trial.pipeline for trial in trials}
    tallies = {name: Tally() for name in pipelines}
    times: dict[str, Times] = {name: defaultdict(list) for name in pipelines}
    scales = dict.fromkeys(pipelines, 1.0)
    failures: dict[str, str] = {}
    for rendered in recordings:
        scores = {name: PipelineScore(rendered, tally) for name, tally in tallies.items()}

        def observe(name: str, result: TimedResult, scores: Mapping[str, PipelineScore] = scores) -> str:
            if result.mapping is not None:
                scales[name] = 1.0 / math.sqrt(abs(float(np.linalg.det(result.mapping.matrix[:2, :2]))))
            return scores[name].add(result)

        ready = {
            n: on_recording(_on_sensor(p), rendered.path) for n, p in pipelines.items() if n not in failures
        }
        took, failed = take_turns(ready, observe)
        failures |= failed
        for name, kinds in took.items():
            for kind, samples in kinds.items():
                times[name][kind] += samples
    for trial in trials:
        trial.failure = failures.get(trial.name)
        if trial.failure is None:
            trial.quantities = tallies[trial.name].errors()
            _set_errors(trial, tallies[trial.name], scales[trial.name])
            _set_time(trial, times[trial.name])


def _on_sensor(pipeline: Pipeline) -> Pipeline:
    """The pipeline without the geometry of `preprocess`, except for downsampling."""
    if "preprocess" not in pipeline.nodes:
        return pipeline
    params = pipeline.nodes["preprocess"].params
    kept = params.model_dump(include={"downsample", "method"}, exclude_unset=True)
    return with_params(pipeline, "preprocess", type(params)(**kept))


def _set_errors(trial: Trial, tally: Tally, scale: float) -> None:
    """Set the errors by kind. scale : px of the camera image per processed pixel."""
    values = tally.values
    per_frame = {
        "center": np.array(values["center_error"]).ravel(),
        "dots": np.array([rms(errors) for errors in values["displacement_rms"] if len(errors)]),
        "flow": np.array(values["flow_error"]).ravel(),
    }
    for kind, errors in per_frame.items():
        if len(errors):
            trial.errors[kind] = _interval(scale * errors, rms if kind == "dots" else np.mean)


def _set_time(trial: Trial, times: Times) -> None:
    """Set the time of frames with contact, or of all but references if there are none."""
    counted = {kind: np.array(samples) * 1e3 for kind, samples in times.items() if kind != "reference"}
    if counted:
        busy = counted.get("contact", np.concatenate(list(counted.values())))
        trial.ms = _interval(busy, np.median, block=1)


def _interval(
    values: NDArray[np.float64], statistic: Callable[[NDArray[np.float64]], Any], block: int = BLOCK
) -> Interval:
    """A statistic of values (N,) and its interval by a block bootstrap with at least five blocks."""
    blocks = np.array_split(values, min(len(values), max(5, len(values) // block)))
    draws = np.random.default_rng(0).integers(0, len(blocks), (DRAWS, len(blocks)))
    drawn = [statistic(np.concatenate([blocks[index] for index in draw])) for draw in draws]
    low, high = np.percentile(drawn, INTERVAL)
    return Interval(float(statistic(values)), float(low), float(high))


def mark_unsound(trials: Sequence[Trial]) -> None:
    """Mark trials that are worse than the best by more than a tolerance of `SOUND`, and those with another
    mean flow where none could be compared with the truth."""
    for key, (tolerance, description) in SOUND.items():
        known = [trial for trial in trials if trial.failure is None and key in trial.quantities]
        sign = math.copysign(1.0, tolerance)
        best = min((sign * trial.quantities[key] for trial in known), default=0.0)
        for trial in known:
            value = trial.quantities[key]
            if not trial.unsound and sign * value - best > abs(tolerance):
                trial.unsound = f"{description} {value:.3g} (best {sign * best:.3g})"
    if not any("flow" in trial.errors for trial in trials):
        for trial in trials:
            if trial.settings.keys() & FLOW and trial.usable:
                trial.unsound = "its mean flow could not be judged: too few dots in the contact"


def measure_on_recording(trials: Sequence[Trial], recording: Recording) -> None:
    """Set the times, checks and failures of trials on the recording, in turns.

    trials : the first that runs, the most expensive, is the baseline of the checks.
    """
    running = [trial for trial in trials if trial.failure is None]
    centers: dict[str, list[NDArray[np.float64] | None]] = {trial.name: [] for trial in running}

    def observe(name: str, result: TimedResult) -> str:
        contact, mapping = result.contact, result.mapping
        center = None if contact is None else np.array(contact.center)
        centers[name].append(center if center is None or mapping is None else mapping.to_raw(center))
        return "idle" if contact is None else "contact"

    ready = {trial.name: on_recording(trial.pipeline, recording.path) for trial in running}
    times, failures = take_turns(ready, observe)
    baseline = None
    for trial in running:
        trial.failure = failures.get(trial.name)
        if trial.failure is None:
            baseline = baseline or centers[trial.name]
            _set_time(trial, times[trial.name])
            trial.checks = _compared(centers[trial.name], baseline)


def _compared(
    centers: Sequence[NDArray[np.float64] | None], baseline: Sequence[NDArray[np.float64] | None]
) -> dict[str, float]:
    """Compare the centres of contacts with those of the baseline, px; None without contact."""
    pairs = list(zip(centers, baseline, strict=True))
    equal = [(here is None) == (there is None) for here, there in pairs]
    checks = {"agreement": 100.0 * float(np.mean(equal))}
    distances = [math.dist(here, there) for here, there in pairs if here is not None and there is not None]
    if distances:
        checks["distance"] = float(np.median(distances))
    return checks
