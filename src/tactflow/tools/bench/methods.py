"""Each stage's methods alone, on the same inputs.

The alternatives are whatever the stage's `method` parameter allows, the classes that the pipelines use in its
place, and all built-in stages, plug-ins and classes in files of the pipelines with the same ports, so a new
one is measured without anything being added here. A method that a shipped pipeline uses is given that
pipeline's parameters. The inputs come from the default pipeline's stages, the same for every alternative;
geometry and flow are given the true contact mask, so that their errors are their own.

A method that is slower than its share of the run is measured on fewer frames.
"""

from __future__ import annotations

import math
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.config.replacements import methods_of, replacements
from tactflow.engine.frame import Absent, Frame
from tactflow.engine.graph import Node, Pipeline
from tactflow.sim import Truth
from tactflow.tools.bench import metrics, score
from tactflow.tools.bench.quantities import Tally
from tactflow.tools.bench.results import BenchResult
from tactflow.tools.bench.scenes import Case, Rendered, rendered
from tactflow.tools.bench.timing import TURN_FRAMES, quiet


def alternatives(pipelines: Mapping[str, Pipeline], stage: str) -> dict[str, Node]:
    """Every way to do a stage's work, the default pipeline's own first.

    A way is named after the stage's `method`; where the stage has none, or another pipeline uses the method
    with other parameters, after the pipeline; others as in `use:`.

    pipelines : name -> pipeline, the default one first. stage : id of the stage.
    """
    ways: dict[str, Node] = {}
    nodes = {name: p.nodes[stage] for name, p in pipelines.items() if stage in p.nodes}
    for name, node in nodes.items():
        known = [(way.component.cls, way.params) for way in ways.values()]
        if (node.component.cls, node.params) not in known:
            method = str(getattr(node.params, "method", name))
            ways[name if method in ways else method] = node
    for node in nodes.values():
        for method in methods_of(node.component):
            ways.setdefault(method, replace(node, params=node.params.changed(method=method)))
    used = [node.component for pipeline in pipelines.values() for node in pipeline.nodes.values()]
    known_classes = {way.component.cls for way in ways.values()}
    for node in list(nodes.values())[:1]:
        for other in replacements(node.component, used):
            if other.cls not in known_classes:
                ways.setdefault(other.name, replace(node, component=other, params=other.params()))
    return ways


@dataclass(frozen=True, slots=True)
class _Inputs:
    """Ports of the default pipeline in one frame, and the truth about it.

    Attributes
    ----------
    clean : (H, W, 3) uint8, the processed frame without markers.
    """

    frame: Frame
    clean: NDArray[np.uint8]
    truth: Truth
    deep: bool
    ports: Mapping[str, Any]

    @property
    def kind(self) -> str:
        """The kind of frame that the time of a method belongs to."""
        if self.frame.reference:
            return "reference"
        return "contact" if self.truth.touching else "idle"


def _run_chain(pipeline: Pipeline, rendered: Rendered) -> Iterator[_Inputs]:
    """Run the default pipeline's stages by hand."""
    process = {
        node.id: node.component.cls(node.params).process
        for node in pipeline.nodes.values()
        if node.component.kind == "stage"
    }
    for index in range(len(rendered)):
        pixels = np.array(rendered.frames[index])
        pixels.flags.writeable = False
        frame = Frame("bench", index, index / rendered.scene.fps, pixels, reference=index == 0)
        clean = process["preprocess"](frame=replace(frame, image=rendered.scene.clean(index))).image.copy()
        image, mapping = process["preprocess"](frame=frame)
        marker_mask = process["marker_mask"](image=image)
        markers = process["tracker"](image=image, frame=frame)
        field = process["field"](image=image, markers=markers)
        truth = rendered.truths(mapping)[index]
        ports = {
            "frame": frame,
            "image": image,
            "marker_mask": marker_mask,
            "unmarked": process["inpaint"](image=image, marker_mask=marker_mask),
            "markers": markers,
            "field": None if isinstance(field, Absent) else field.field,
            "contact_mask": np.where(truth.contact_mask, 255, 0).astype(np.uint8),
        }
        yield _Inputs(frame, clean, truth, rendered.deep(index), ports)


class _Judge:
    """Compares what one method finds with the truth; a function for each stage."""

    def __init__(self) -> None:
        self.tally = Tally()
        self._markers = score.MarkerScore(self.tally)

    def marker_mask(self, inputs: _Inputs, found: Any) -> None:
        score.add_detection(self.tally, metrics.mask_centroids(found), inputs.truth)

    def inpaint(self, inputs: _Inputs, found: Any) -> None:
        mask = inputs.ports["marker_mask"]
        if mask.any():
            self.tally.add(inpaint_mae=np.mean(cv2.absdiff(found, inputs.clean)[mask != 0]))

    def difference(self, inputs: _Inputs, found: Any) -> None:
        if score.add_decision(self.tally, bool(found.touching), inputs.truth, inputs.deep):
            score.add_mask(self.tally, found.contact_mask, inputs.truth)
            score.add_centroid(self.tally, found.contact_mask, inputs.truth)

    def hull(self, inputs: _Inputs, found: Any) -> None:
        if score.add_decision(self.tally, found is not None, inputs.truth, inputs.deep):
            score.add_geometry(self.tally, found, inputs.truth)

    def tracker(self, inputs: _Inputs, found: Any) -> None:
        if found is not None:
            self._markers.add(found, inputs.truth)

    def flow_in_mask(self, inputs: _Inputs, found: Any) -> None:
        score.add_flow(self.tally, found, inputs.truth)


STAGES: Mapping[str, frozenset[str]] = {
    "marker_mask": frozenset({"image"}),
    "inpaint": frozenset({"image", "marker_mask"}),
    "difference": frozenset({"unmarked", "frame"}),
    "hull": frozenset({"contact_mask"}),
    "tracker": frozenset({"image", "frame"}),
    "flow_in_mask": frozenset({"markers", "contact_mask", "field"}),
}
"""The stages whose methods are measured alone, and their inputs. Those that take the true contact are
measured only in frames that show one."""


QUICK_BUDGET_S, FULL_BUDGET_S = 1.5, 3.0
"""CPU time of a method on one scene, s, beyond which it is measured on fewer frames: a few seconds of a quick
run of half a minute, and some minutes of a full one, even if several are as slow as that."""


def measure_methods(
    result: BenchResult, scratch: Path, pipelines: Mapping[str, Pipeline], case: Case
) -> None:
    """Measure every method of every stage on one scene.

    result : rows are added to it. scratch : folder for temporary files.
    pipelines : name -> pipeline; the first is the default one and provides the inputs.
    """
    with rendered(case, scratch) as scene:
        frames = list(_run_chain(next(iter(pipelines.values())), scene))
    for stage, ports in STAGES.items():
        ways = alternatives(pipelines, stage)
        shown = [item for item in frames if item.truth.touching or "contact_mask" not in ports]
        if len(ways) > 1:
            _measure_stage(result, stage, ways, shown, case.label)


def _measure_stage(
    result: BenchResult,
    stage: str,
    ways: Mapping[str, Node],
    frames: Sequence[_Inputs],
    scene: str,
) -> None:
    budget_s = QUICK_BUDGET_S if result.quick else FULL_BUDGET_S
    trials = {name: _Trial(stage, node, frames, budget_s) for name, node in ways.items()}
    with quiet():
        for first in range(0, len(frames), TURN_FRAMES):
            for trial in trials.values():
                trial.run(range(first, min(first + TURN_FRAMES, len(frames))))
    for name, trial in trials.items():
        if trial.failure:
            result.failures[f"{stage}/{name}/{scene}"] = trial.failure
        else:
            errors, left_out = trial.judge.tally.errors(), len(frames) - trial.measured
            result.add(
                stage, name, scene, errors, times=trial.times, frames=trial.measured, left_out=left_out
            )


class _Trial:
    """One method on one scene, until its CPU time is spent.

    A method without memory that is too slow for all frames gets every n-th one; one with memory gets the
    first ones, because it depends on those before.
    """

    def __init__(self, stage: str, node: Node, frames: Sequence[_Inputs], budget_s: float) -> None:
        self.judge, self.times = _Judge(), defaultdict[str, list[float]](list)
        self.measured, self.failure = 0, ""
        self._compare = getattr(self.judge, stage)
        self._frames, self._budget_s, self._spent_s, self._step = frames, budget_s, 0.0, 1
        self._is_pure = node.component.memory == "pure"
        self._call = _call(node, STAGES[stage])

    def run(self, turn: range) -> None:
        """Run the frames of a turn that are to be measured; what a method raises ends its trial."""
        answers = []
        for index in turn:
            if index % self._step or self._spent_s > self._budget_s or self.failure:
                continue
            began = time.thread_time()
            try:
                answer = self._call(self._frames[index])
            except Exception as error:
                self.failure = f"{type(error).__name__}: {error}"
                break
            cost_s = time.thread_time() - began
            answers.append((index, answer, cost_s))
            self._spent_s += cost_s
            # A first call may take longer than the others, but not a fifth of the budget.
            if self._is_pure and cost_s > self._budget_s / 5:
                self._step = max(self._step, math.ceil(cost_s * len(self._frames) / self._budget_s))
        for index, answer, cost_s in answers:
            inputs = self._frames[index]
            self.times[inputs.kind].append(cost_s)
            self.measured += 1
            self._compare(inputs, None if isinstance(answer, Absent) else answer)


def _call(node: Node, ports: frozenset[str]) -> Callable[[_Inputs], Any]:
    """A new stage, as a function of its inputs."""
    process = node.component.cls(node.params).process
    # A class of another kind may need other ports than the stage whose place it takes.
    wanted = [port.name for port in node.component.ports.inputs if port.name in ports or not port.optional]
    return lambda item: process(**{port: item.ports[port] for port in wanted if port in item.ports})
