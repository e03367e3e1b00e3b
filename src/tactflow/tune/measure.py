"""Time and error of candidates: errors on the fitted simulator, times on the recording."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tactflow.bench.lockstep import TimedResult, on_recording, take_turns
from tactflow.bench.quantities import Tally, rms
from tactflow.bench.scenes import Rendered
from tactflow.bench.score import PipelineScore
from tactflow.bench.timing import CopyUnit, Times
from tactflow.engine.graph import Pipeline

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
    "missed_half_depth": 3.0,
    "false_contacts": 2.0,
    "wrong_percent": 0.5,
    "lost_percent": 2.0,
    "hull_iou": -0.15,
}
"""By how much a pipeline may be worse than the best candidate in this and still be sound: percent of frames
or of dots; and for the outline, in overlap with the truth. Chosen by hand."""
BLOCK: Final = 10
"""Frames in a row that are drawn together for an interval: neighbours share a contact. Chosen by hand."""
LEAST_BLOCKS: Final = 5
"""Blocks that an interval is drawn from, at least, where there are so many frames. Chosen by hand."""
DRAWS: Final = 200
"""Draws of the bootstrap. Chosen by hand: ends of a 90 % interval are then right to a tenth of its width."""
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

    error : of each of `ERRORS` that it has, px of the camera's picture. quantities : what the bench's scores
    say, processed pixels. ms : CPU time of a frame with contact, median.
    frames : simulated ones that it was judged on. failure : why it has none. unsound : what it gets wrong.
    checks : what the recording itself says, see `tactflow.tune.checks`.
    """

    name: str
    error: dict[str, Interval] = field(default_factory=dict[str, Interval])
    quantities: dict[str, float] = field(default_factory=dict[str, float])
    ms: Interval = field(default_factory=Interval)
    frames: int = 0
    failure: str | None = None
    unsound: str = ""
    checks: dict[str, float] = field(default_factory=dict[str, float])

    def of(self, kind: str) -> float:
        """The error of a kind, inf where there is none."""
        found = self.error.get(kind)
        return math.inf if found is None or self.failure else found.value

    @property
    def usable(self) -> bool:
        """Whether it runs, and is sound."""
        return self.failure is None and not self.unsound


@dataclass
class _Kept:
    """Errors of one candidate, one number a frame, px of the camera's picture."""

    tally: Tally = field(default_factory=Tally)
    scale: float = 1.0
    times: Times = field(default_factory=Times)


def on_sensor(pipeline: Pipeline) -> Pipeline:
    """The same pipeline for frames that went through its geometry before: it only shrinks them."""
    node = pipeline.nodes.get("preprocess")
    if node is None:
        return pipeline
    params = node.params.model_dump(exclude_unset=True, by_alias=True)
    kept = {key: params[key] for key in ("downsample", "method") if key in params}
    changed = replace(node, params=node.component.params.model_validate(kept))
    return replace(pipeline, nodes={**pipeline.nodes, node.id: changed})


def judge(
    pipelines: Mapping[str, Pipeline],
    recordings: Sequence[Rendered],
    unit: CopyUnit,
    seed: int,
    late: Callable[[], bool] = lambda: False,
) -> dict[str, Found]:
    """Errors, and times, of pipelines on simulated recordings, in turns.

    late : whether it is time to stop. The first recording is judged in any case, and to its end.
    """
    kept = {name: _Kept() for name in pipelines}
    failures: dict[str, str] = {}
    for number, rendered in enumerate(recordings):
        if number and late():
            break
        ends = late if number else lambda: False

        scores = {name: PipelineScore(rendered, kept[name].tally) for name in pipelines}

        def see(name: str, result: TimedResult, scores: Mapping[str, PipelineScore] = scores) -> str:
            if result.mapping is not None:
                kept[name].scale = 1.0 / math.sqrt(abs(float(np.linalg.det(result.mapping.matrix[:2, :2]))))
            return scores[name].add(result)

        ready = {
            name: on_recording(pipeline, rendered.path)
            for name, pipeline in pipelines.items()
            if name not in failures
        }
        times, failed = take_turns(ready, see, unit=unit, late=ends)
        failures.update(failed)
        for name, samples in times.items():
            _add(kept[name].times, samples)
    return {name: _found(name, kept[name], failures.get(name), seed) for name in pipelines}


def _add(times: Times, more: Times) -> None:
    for kind, samples in more.items():
        times[kind] = times.get(kind, []) + samples


def _found(name: str, kept: _Kept, failure: str | None, seed: int) -> Found:
    tally, scale = kept.tally, kept.scale
    found = Found(name, failure=failure)
    if failure is not None:
        return found
    found.quantities = tally.errors()
    found.frames = len(tally.values["false_contacts"]) + len(tally.values["missed_contacts"])
    per_frame = {
        "center": np.array(tally.values["center_error"]).ravel(),
        "dots": np.array([rms(errors) for errors in tally.values["displacement_rms"] if len(errors)]),
        "flow": np.array(tally.values["flow_error"]).ravel(),
    }
    for kind, values in per_frame.items():
        if len(values):
            power = 2.0 if kind == "dots" else 1.0
            found.error[kind] = _interval(scale * values, seed, power)
    if found.error:
        found.error[ANY] = max(found.error.values(), key=lambda one: one.value)
    set_time(found, kept.times, seed)
    return found


def set_time(found: Found, times: Times, seed: int) -> None:
    """Time of a frame with contact, or of any but references where none has one."""
    counted = {kind: np.array(samples) * 1e3 for kind, samples in times.items() if kind != "reference"}
    if not counted:
        return
    busy = counted.get("contact", np.concatenate(list(counted.values())))
    rng = np.random.default_rng([seed, 0x6D73])
    draws = np.median(rng.choice(busy, (DRAWS, len(busy))), axis=1)
    low, high = np.percentile(draws, INTERVAL)
    found.ms = Interval(float(np.median(busy)), float(low), float(high))


def _interval(values: NDArray[np.float64], seed: int, power: float) -> Interval:
    """Mean of values (N,) to a power, rooted, and its interval by a bootstrap of blocks of frames."""
    raised = values**power
    blocks = np.array_split(raised, min(len(raised), max(LEAST_BLOCKS, len(raised) // BLOCK)))
    sums, counts = np.array([block.sum() for block in blocks]), np.array([len(block) for block in blocks])
    drawn = np.random.default_rng([seed, 0x6572]).integers(0, len(blocks), (DRAWS, len(blocks)))
    means = (sums[drawn].sum(axis=1) / counts[drawn].sum(axis=1)) ** (1 / power)
    low, high = np.percentile(means, INTERVAL)
    return Interval(float(raised.mean() ** (1 / power)), float(low), float(high))


def mark_unsound(found: Sequence[Found]) -> None:
    """Write down what candidates get wrong that others get right."""
    for key, slack in SOUND.items():
        values = [f.quantities[key] for f in found if f.failure is None and key in f.quantities]
        if not values:
            continue
        best = min(values) if slack > 0 else max(values)
        for one in found:
            value = one.quantities.get(key)
            if value is None or one.failure or one.unsound:
                continue
            if (value - best) * math.copysign(1.0, slack) > abs(slack):
                one.unsound = f"{WORDS[key]} {value:.3g} (best {best:.3g})"


WORDS: Final = {
    "missed_half_depth": "% of contacts at half depth missed:",
    "false_contacts": "% of idle frames called contact:",
    "wrong_percent": "% of dots mistaken for others:",
    "lost_percent": "% of dots lost:",
    "hull_iou": "overlap of the outline with the truth:",
}
"""Quantity of `SOUND` -> how it is told."""
