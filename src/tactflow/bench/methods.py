"""Each stage's methods alone, on the same inputs.

The alternatives are whatever the stage's `method` parameter allows and the classes that the pipelines use in
its place, so a new one is measured without anything being added here. A method that a shipped pipeline uses
is given that pipeline's parameters. The inputs come from the default pipeline's stages, the same for every
alternative; geometry and flow are given the true contact mask, so that their errors are their own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args, get_origin

import numpy as np

from tactflow.bench import metrics, score
from tactflow.bench.quantities import Tally
from tactflow.bench.results import BenchResult
from tactflow.bench.scenes import Rendered
from tactflow.bench.timing import CopyUnit, interleaved
from tactflow.engine.contract import StageParams
from tactflow.engine.errors import StageError
from tactflow.engine.frame import Absent, Frame
from tactflow.engine.graph import Node, Pipeline
from tactflow.sim import Truth


@dataclass(frozen=True, slots=True)
class Alternative:
    """One way to do a stage's work. node : with the class and its ports. params : its parameters."""

    node: Node
    params: StageParams

    def build(self, stage: str) -> Callable[[_Given], Any]:
        """A function of what is given in one frame, on a fresh instance. stage : whose work it does."""
        process = self.node.component.cls(self.params).process
        ports = self.node.component.ports.inputs
        usual = STAGES[stage].ports

        def run(given: _Given) -> Any:
            # A class of another kind may need other ports than the stage whose place it takes.
            taken = [port.name for port in ports if port.name in usual or not port.optional]
            return process(**{name: given.ports[name] for name in taken if name in given.ports})

        return run


def methods_of(params: type[StageParams]) -> list[str]:
    """The choices of a stage's `method` parameter; empty where it has none."""
    method = params.model_fields.get("method")
    if method is None or get_origin(method.annotation) is not Literal:
        return []
    return [str(choice) for choice in get_args(method.annotation)]


def alternatives(pipelines: Mapping[str, Pipeline], stage: str) -> dict[str, Alternative]:
    """Every way to do a stage's work, the default pipeline's own first.

    A way is named after the stage's `method`; where the stage has none, or another pipeline uses the method
    with other parameters, after the pipeline.

    Parameters
    ----------
    pipelines : name -> pipeline, the default one first. stage : id of the stage.
    """
    ways: dict[str, Alternative] = {}
    nodes = {name: p.nodes[stage] for name, p in pipelines.items() if stage in p.nodes}
    for name, node in nodes.items():
        if not any(
            (w.node.component.cls, w.params) == (node.component.cls, node.params) for w in ways.values()
        ):
            method = str(getattr(node.params, "method", name))
            ways[name if method in ways else method] = Alternative(node, node.params)
    for node in nodes.values():
        for method in methods_of(node.component.params):
            params = node.params.model_copy(update={"method": method})
            ways.setdefault(method, Alternative(node, params))
    return ways


@dataclass(frozen=True, slots=True)
class _Given:
    """What the stages of the default pipeline hand to each other in one frame, and the truth about it."""

    frame: Frame
    truth: Truth
    deep: bool
    ports: Mapping[str, Any]

    @property
    def kind(self) -> str:
        """The kind of frame that the time of a method belongs to."""
        if self.frame.reference:
            return "reference"
        return "contact" if self.truth.touching else "idle"


def _run_chain(pipeline: Pipeline, rendered: Rendered) -> Iterator[_Given]:
    """Run the default pipeline's stages by hand."""
    stages = {
        node.id: node.component.cls(node.params)
        for node in pipeline.nodes.values()
        if node.component.kind == "stage"
    }

    def run(name: str, **inputs: Any) -> Any:
        try:
            return stages[name].process(**inputs)
        except Exception as error:
            raise StageError(f"{name}, on {rendered.case.label}: {type(error).__name__}: {error}") from error

    for index in range(len(rendered)):
        pixels = np.array(rendered.frames[index])
        pixels.flags.writeable = False
        frame = Frame("bench", index, index / rendered.scene.fps, pixels, reference=index == 0)
        image, mapping = run("preprocess", frame=frame)
        marker_mask = run("marker_mask", image=image)
        markers = run("tracker", image=image, frame=frame)
        field = run("field", image=image, markers=markers) if "field" in stages else None
        truth = rendered.truths(mapping)[index]
        ports = {
            "frame": frame,
            "image": image,
            "marker_mask": marker_mask,
            "unmarked": run("inpaint", image=image, marker_mask=marker_mask),
            "markers": markers,
            "field": None if field is None or isinstance(field, Absent) else field.field,
            "contact_mask": np.where(truth.contact_mask, 255, 0).astype(np.uint8),
        }
        yield _Given(frame, truth, rendered.deep(index), ports)


class _Judge:
    """Compares what one method says with the truth; a function for each stage. `result` may be absent."""

    def __init__(self) -> None:
        self.tally = Tally()
        self._markers = score.MarkerScore(self.tally)

    def marker_mask(self, given: _Given, result: Any) -> None:
        score.add_detection(self.tally, metrics.mask_centroids(result), given.truth)

    def inpaint(self, given: _Given, result: Any) -> None:
        mask = given.ports["marker_mask"]
        mae = metrics.masked_mae(result, given.truth.unmarked, mask)
        psnr = metrics.masked_psnr(result, given.truth.unmarked, mask)
        if mae is not None and psnr is not None:
            self.tally.add(inpaint_mae=mae, inpaint_psnr=psnr)

    def difference(self, given: _Given, result: Any) -> None:
        if score.add_decision(self.tally, bool(result.touching), given.truth, given.deep):
            score.add_mask(self.tally, result.contact_mask, given.truth)
            score.add_centroid(self.tally, result.contact_mask, given.truth)

    def hull(self, given: _Given, result: Any) -> None:
        if score.add_decision(self.tally, result is not None, given.truth, given.deep):
            score.add_geometry(self.tally, result, given.truth)

    def tracker(self, given: _Given, result: Any) -> None:
        if result is not None:
            self._markers.add(result, given.truth)

    def flow_in_mask(self, given: _Given, result: Any) -> None:
        score.add_flow(self.tally, result, given.truth)


@dataclass(frozen=True, slots=True)
class _Stage:
    """How the methods of a stage are fed and judged. touched : only with frames that show a contact."""

    ports: frozenset[str]
    judge: Callable[[_Judge, _Given, Any], None]
    touched: bool = False


STAGES: Mapping[str, _Stage] = {
    "marker_mask": _Stage(frozenset({"image"}), _Judge.marker_mask),
    "inpaint": _Stage(frozenset({"image", "marker_mask"}), _Judge.inpaint),
    "difference": _Stage(frozenset({"unmarked", "frame"}), _Judge.difference),
    "hull": _Stage(frozenset({"contact_mask"}), _Judge.hull, touched=True),
    "tracker": _Stage(frozenset({"image", "frame"}), _Judge.tracker),
    "flow_in_mask": _Stage(
        frozenset({"markers", "contact_mask", "field"}), _Judge.flow_in_mask, touched=True
    ),
}
"""The stages whose methods are measured alone, with the ports that are given to them."""


def measure_methods(
    result: BenchResult,
    pipelines: Mapping[str, Pipeline],
    rendered: Rendered,
    unit: CopyUnit,
    step: Callable[[int], None],
) -> None:
    """Measure every method of every stage on one scene.

    Parameters
    ----------
    result : what is measured is added to it.
    pipelines : name -> pipeline; the first is the default one and provides the inputs.
    rendered : the scene. unit : measured along the way. step : called with 1 after each stage.
    """
    given = list(_run_chain(next(iter(pipelines.values())), rendered))
    for stage in STAGES:
        ways = alternatives(pipelines, stage)
        if len(ways) > 1:
            _measure_stage(result, stage, ways, given, rendered.case.label, unit)
        step(1)


def _measure_stage(
    result: BenchResult,
    stage: str,
    ways: Mapping[str, Alternative],
    given: Sequence[_Given],
    scene: str,
    unit: CopyUnit,
) -> None:
    judges = {name: _Judge() for name in ways}
    failures: dict[str, str] = {}

    def guarded(name: str, call: Callable[[_Given], Any]) -> Callable[[_Given], Any]:
        def run(item: _Given) -> Any:
            if name in failures:
                return None
            try:
                return call(item)
            except Exception as error:
                failures[name] = f"{type(error).__name__}: {error}"
                return None

        return run

    def see(name: str, item: _Given, answer: Any) -> None:
        if name not in failures:
            STAGES[stage].judge(judges[name], item, None if isinstance(answer, Absent) else answer)

    shown = [item for item in given if item.truth.touching or not STAGES[stage].touched]
    unit.take()
    calls = {name: guarded(name, way.build(stage)) for name, way in ways.items()}
    times = interleaved(calls, [(item.kind, item) for item in shown], see=see)
    for name in ways:
        if name in failures:
            result.failures[f"{stage}/{name}/{scene}"] = failures[name]
        else:
            result.add(stage, name, scene, judges[name].tally.errors(), times=times[name], frames=len(shown))
