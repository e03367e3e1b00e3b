"""Time and error of candidates: errors on the fitted simulator, times on the recording."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from tactflow.bench.lockstep import TimedResult, on_recording, take_turns
from tactflow.bench.quantities import Tally, rms
from tactflow.bench.scenes import Rendered
from tactflow.bench.score import PipelineScore
from tactflow.bench.timing import Times
from tactflow.engine.graph import Pipeline
from tactflow.tune.recording import Recording

ANY: Final = "any"
ERRORS: Final = {
    ANY: "largest of the following",
    "center": "contact's centre, mean",
    "dots": "displacement of the dots, RMS",
    "flow": "mean flow in the contact, mean",
}
"""Errors that can be asked for, px of the camera's picture before it shrinks. `ANY` is the largest that a
pipeline has."""
SOUND: Final = {
    "missed_half_depth": (3.0, "% of contacts at half depth missed:"),
    "false_contacts": (2.0, "% of idle frames called contact:"),
    "wrong_percent": (0.5, "% of dots mistaken for others:"),
    "lost_percent": (2.0, "% of dots lost:"),
    "hull_iou": (-0.15, "overlap of the outline with the truth:"),
}
"""By how much a pipeline may be worse than the best candidate in a quantity of the bench and still be sound,
and how that is called. Chosen by hand."""
CHECKS: Final = {
    "agreement": "contact or not, as the most expensive says, %",
    "distance": "centre, distance from the most expensive, median px",
}
"""What the recording itself says of a pipeline, without truth."""
BLOCK: Final = 10
"""Frames in a row that are drawn together for an interval: neighbours share a contact. Chosen by hand."""
DRAWS: Final = 200
"""Draws of the bootstrap: the ends of a 90 % interval are then right to a tenth of its width."""
INTERVAL: Final = (5.0, 95.0)
"""Percentiles between which an interval lies."""


@dataclass
class Interval:
    """A value and its 90 % interval."""

    value: float = math.nan
    low: float = math.nan
    high: float = math.nan


@dataclass
class Found:
    """What is known of a candidate.

    errors : of each of `ERRORS` that it has, px of the camera's picture. quantities : errors by the names of
    the bench, processed pixels. ms : CPU time of a frame with contact, median. failure : why it does not run.
    unsound : what it gets wrong. checks : of `CHECKS`.
    """

    name: str
    errors: dict[str, Interval] = field(default_factory=dict[str, Interval])
    quantities: dict[str, float] = field(default_factory=dict[str, float])
    ms: Interval = field(default_factory=Interval)
    failure: str | None = None
    unsound: str = ""
    checks: dict[str, float] = field(default_factory=dict[str, float])

    def of(self, kind: str) -> float:
        """The error of a kind, inf where there is none."""
        known = self.errors.get(kind)
        return math.inf if known is None or self.failure else known.value

    @property
    def usable(self) -> bool:
        """Whether it runs, and is sound."""
        return self.failure is None and not self.unsound


def judge(
    pipelines: Mapping[str, Pipeline],
    recordings: Sequence[Rendered],
    seed: int,
    late: Callable[[], bool] = lambda: False,
) -> list[Found]:
    """Errors and times of pipelines on simulated recordings, in turns.

    late : whether it is time to stop. The first recording is shown in any case, and to its end.
    """
    tallies = {name: Tally() for name in pipelines}
    times: dict[str, Times] = {name: {} for name in pipelines}
    scales = dict.fromkeys(pipelines, 1.0)
    failures: dict[str, str] = {}
    for number, rendered in enumerate(recordings):
        if number and late():
            break
        scores = {name: PipelineScore(rendered, tally) for name, tally in tallies.items()}

        def see(name: str, result: TimedResult, scores: Mapping[str, PipelineScore] = scores) -> str:
            if result.mapping is not None:
                scales[name] = 1.0 / math.sqrt(abs(float(np.linalg.det(result.mapping.matrix[:2, :2]))))
            return scores[name].add(result)

        ready = {
            n: on_recording(_on_sensor(p), rendered.path) for n, p in pipelines.items() if n not in failures
        }
        took, failed = take_turns(ready, see, late=late if number else lambda: False)
        failures |= failed
        for name, kinds in took.items():
            for kind, samples in kinds.items():
                times[name].setdefault(kind, []).extend(samples)
    return [
        Found(name, failure=failures[name])
        if name in failures
        else _found(name, tallies[name], scales[name], times[name], seed)
        for name in pipelines
    ]


def _on_sensor(pipeline: Pipeline) -> Pipeline:
    """The same pipeline for frames that went through its geometry before: it only shrinks them."""
    node = pipeline.nodes.get("preprocess")
    if node is None:
        return pipeline
    params = node.params.model_dump(exclude_unset=True, by_alias=True)
    kept = {key: params[key] for key in ("downsample", "method") if key in params}
    changed = replace(node, params=node.component.params.model_validate(kept))
    return replace(pipeline, nodes={**pipeline.nodes, node.id: changed})


def _found(name: str, tally: Tally, scale: float, times: Times, seed: int) -> Found:
    found = Found(name, quantities=tally.errors())
    values = tally.values
    per_frame = {
        "center": np.array(values["center_error"]).ravel(),
        "dots": np.array([rms(errors) for errors in values["displacement_rms"] if len(errors)]),
        "flow": np.array(values["flow_error"]).ravel(),
    }
    for kind, errors in per_frame.items():
        if len(errors):
            found.errors[kind] = _interval(scale * errors, rms if kind == "dots" else np.mean, seed)
    if found.errors:
        found.errors[ANY] = max(found.errors.values(), key=lambda interval: interval.value)
    set_time(found, times, seed)
    return found


def set_time(found: Found, times: Times, seed: int) -> None:
    """Time of a frame with contact, or of any but references where no frame has one."""
    counted = {kind: np.array(samples) * 1e3 for kind, samples in times.items() if kind != "reference"}
    if counted:
        busy = counted.get("contact", np.concatenate(list(counted.values())))
        found.ms = _interval(busy, np.median, seed, block=1)


def _interval(
    values: NDArray[np.float64],
    statistic: Callable[[NDArray[np.float64]], Any],
    seed: int,
    block: int = BLOCK,
) -> Interval:
    """A statistic of values (N,), and its interval by a bootstrap of blocks of frames; of five, at least."""
    blocks = np.array_split(values, min(len(values), max(5, len(values) // block)))
    draws = np.random.default_rng(seed).integers(0, len(blocks), (DRAWS, len(blocks)))
    drawn = [statistic(np.concatenate([blocks[index] for index in draw])) for draw in draws]
    low, high = np.percentile(drawn, INTERVAL)
    return Interval(float(statistic(values)), float(low), float(high))


def mark_unsound(found: Sequence[Found]) -> None:
    """Write down what candidates get wrong that others get right."""
    for key, (slack, words) in SOUND.items():
        known = [one for one in found if one.failure is None and key in one.quantities]
        sign = math.copysign(1.0, slack)
        best = min((sign * one.quantities[key] for one in known), default=0.0)
        for one in known:
            value = one.quantities[key]
            if not one.unsound and sign * value - best > abs(slack):
                one.unsound = f"{words} {value:.3g} (best {sign * best:.3g})"


def show_recording(
    pipelines: Mapping[str, Pipeline], recording: Recording, late: Callable[[], bool] = lambda: False
) -> tuple[dict[str, Times], dict[str, dict[str, float]], dict[str, str]]:
    """Show the recording to pipelines, in turns.

    Parameters
    ----------
    pipelines : name -> pipeline; the first is the most expensive one, from which distances are taken.
    late : whether it is time to stop; what was shown until then is compared.

    Returns
    -------
    times : name -> times; empty if the recording was not shown to its end. checks : name -> check of `CHECKS`
    -> value. failures : name -> why.
    """
    centers: dict[str, dict[int, NDArray[np.float64] | None]] = {name: {} for name in pipelines}

    def see(name: str, result: TimedResult) -> str:
        contact, mapping = result.contact, result.mapping
        center = None if contact is None else np.array(contact.center, np.float64)
        if center is not None and mapping is not None:
            center = np.array(mapping.to_raw(center))
        centers[name][result.frame.seq] = center
        return "idle" if contact is None else "contact"

    ready = {name: on_recording(pipeline, recording.path) for name, pipeline in pipelines.items()}
    times, failures = take_turns(ready, see, late=late)
    good = [name for name in pipelines if name not in failures]
    if not good or len(centers[good[0]]) < recording.frames:
        times = {}
    return times, {name: _compared(centers[name], centers[good[0]]) for name in good}, failures


def _compared(
    centers: Mapping[int, NDArray[np.float64] | None], dearest: Mapping[int, NDArray[np.float64] | None]
) -> dict[str, float]:
    """The checks of one pipeline, as far as they can be made. centers : of contacts, by frame, px."""
    pairs = [(centers[seq], dearest[seq]) for seq in centers.keys() & dearest.keys()]
    away = [math.dist(here, there) for here, there in pairs if here is not None and there is not None]
    found: dict[str, float] = {}
    if pairs:
        same = [(here is None) == (there is None) for here, there in pairs]
        found["agreement"] = 100.0 * float(np.mean(same))
    if away:
        found["distance"] = float(np.median(away))
    return found
