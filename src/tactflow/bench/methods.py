"""Each stage's methods alone, on the same inputs.

The alternatives are whatever the stage's `method` parameter allows and the classes that the pipelines use in
its place, so a new one is measured without anything being added here. A method that a shipped pipeline uses
is given that pipeline's parameters. The inputs come from the default pipeline's stages, the same for every
alternative; geometry and flow are given the true contact mask.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args, get_origin

import numpy as np
from numpy.typing import NDArray

from tactflow.bench import metrics
from tactflow.bench.results import Measurement
from tactflow.bench.scenes import Rendered
from tactflow.bench.score import ContactScore, DetectionScore, FlowScore, MarkerScore, RemovalScore
from tactflow.bench.timing import CopyUnit, Samples, interleaved
from tactflow.engine.contract import StageParams
from tactflow.engine.errors import StageError
from tactflow.engine.frame import Absent, Frame
from tactflow.engine.graph import Pipeline
from tactflow.sim import Truth
from tactflow.vision.geometry import PixelMapping

CLASSIC = "classic"
"""Name of the pipeline that is the yardstick: the original script."""


@dataclass(frozen=True, slots=True)
class Alternative:
    """One way to do a stage's work.

    inputs : names of its input ports. required : those of them that it needs. yardstick : whether the
    original script does it so.
    """

    name: str
    cls: type
    params: StageParams
    inputs: frozenset[str]
    required: frozenset[str]
    yardstick: bool = False

    def build(self) -> Any:
        """A fresh instance."""
        return self.cls(self.params)


def methods_of(params: type[StageParams]) -> list[str]:
    """What the `method` parameter of a stage allows; empty where it has none."""
    method = params.model_fields.get("method")
    if method is None or get_origin(method.annotation) is not Literal:
        return []
    return [str(choice) for choice in get_args(method.annotation)]


def alternatives(pipelines: Mapping[str, Pipeline], stage: str) -> dict[str, Alternative]:
    """Every way to do a stage's work, the default pipeline's own first.

    A way is named after the stage's `method`; where the stage has none, after the pipeline.

    Parameters
    ----------
    pipelines : name -> pipeline, the default one first, the yardstick under `CLASSIC`.
    stage : id of the stage.
    """
    found: dict[str, Alternative] = {}
    for name, pipeline in pipelines.items():
        node = pipeline.nodes.get(stage)
        if node is None:
            continue
        cls = node.component.cls
        ports = node.component.ports.inputs
        inputs = frozenset(port.name for port in ports)
        required = frozenset(port.name for port in ports if not port.optional)
        method = str(getattr(node.params, "method", name))
        if name == CLASSIC:
            found[method] = Alternative(method, cls, node.params, inputs, required, yardstick=True)
        elif not any((way.cls, way.params) == (cls, node.params) for way in found.values()):
            found.setdefault(method, Alternative(method, cls, node.params, inputs, required))
        for other in methods_of(node.component.params):
            params = node.params.model_copy(update={"method": other})
            found.setdefault(other, Alternative(other, cls, params, inputs, required))
    return found


@dataclass(slots=True)
class _Inputs:
    """What the stages of the default pipeline hand to each other for one frame."""

    frame: Frame
    truth: Truth
    deep: bool
    image: NDArray[np.uint8]
    marker_mask: NDArray[np.uint8]
    unmarked: NDArray[np.uint8]
    markers: Any
    field: Any

    @property
    def ports(self) -> dict[str, Any]:
        """What any way to do a stage's work is given if it requires it."""
        names = ("frame", "image", "marker_mask", "unmarked", "markers")
        return {name: getattr(self, name) for name in names}

    @property
    def touching(self) -> bool:
        return self.truth.touching

    @property
    def true_mask(self) -> NDArray[np.uint8]:
        """What geometry and flow are given, so that their errors are their own and not the mask's."""
        return np.asarray(self.truth.contact_mask, dtype=np.uint8) * np.uint8(255)

    @property
    def kind(self) -> str:
        if self.frame.reference:
            return "reference"
        return "contact" if self.touching else "idle"


def frames_of(rendered: Rendered) -> Iterator[Frame]:
    """The frames as the capture stage would hand them over; the first is the reference."""
    for index in range(len(rendered)):
        image = np.array(rendered.frames[index])
        image.flags.writeable = False
        yield Frame("bench", index, index / rendered.scene.fps, image, reference=index == 0)


def _chain(pipeline: Pipeline, rendered: Rendered) -> tuple[list[_Inputs], PixelMapping]:
    """Run the default pipeline's stages by hand and keep everything in between."""
    stage = {
        node.id: node.component.cls(node.params)
        for node in pipeline.nodes.values()
        if node.component.kind == "stage"
    }
    collected = []
    truths: list[Truth] | None = None

    def run(name: str, **inputs: Any) -> Any:
        try:
            return stage[name].process(**inputs)
        except Exception as error:
            raise StageError(f"{name}, on {rendered.case.label}: {type(error).__name__}: {error}") from error

    for index, frame in enumerate(frames_of(rendered)):
        image, mapping = run("preprocess", frame=frame)
        if truths is None:
            truths = rendered.truths(mapping)
        mask = run("marker_mask", image=image)
        unmarked = run("inpaint", image=image, marker_mask=mask)
        markers = run("tracker", image=image, frame=frame)
        deep = rendered.deep(index)
        field = run("field", image=image, markers=markers) if "field" in stage else Absent("no_field")
        collected.append(_Inputs(frame, truths[index], deep, image, mask, unmarked, markers, field))
    return collected, mapping


@dataclass(slots=True)
class _Group:
    """How one stage is fed and judged. `see` gets (score, inputs, result)."""

    stage: str
    feed: Callable[[_Inputs], dict[str, Any] | None]
    score: Callable[[], Any]
    see: Callable[[Any, _Inputs, Any], None]


def _see_contact(score: ContactScore, inputs: _Inputs, result: Any) -> None:
    touching = bool(result.touching)
    if score.detected(touching, inputs.truth, inputs.deep):
        score.mask(result.contact_mask, inputs.truth)
        score.centroid(result.contact_mask, inputs.truth)


def _see_hull(score: ContactScore, inputs: _Inputs, result: Any) -> None:
    found = not isinstance(result, Absent) and result is not None
    if score.detected(found, inputs.truth, inputs.deep):
        score.geometry(result, inputs.truth)


def _see_mask(score: DetectionScore, inputs: _Inputs, result: NDArray[np.uint8]) -> None:
    score.add(metrics.mask_centroids(result), inputs.truth)


def _see_removal(score: RemovalScore, inputs: _Inputs, result: NDArray[np.uint8]) -> None:
    score.add(result, inputs.truth.unmarked, inputs.marker_mask)


def _see_markers(score: MarkerScore, inputs: _Inputs, result: Any) -> None:
    if not isinstance(result, Absent):
        score.add(result, inputs.truth)


def _see_flow(score: FlowScore, inputs: _Inputs, result: Any) -> None:
    score.add(None if isinstance(result, Absent) else result, inputs.truth)


def _flow_inputs(inputs: _Inputs) -> dict[str, Any] | None:
    if not inputs.touching:
        return None
    field = None if isinstance(inputs.field, Absent) else inputs.field.field
    return {"markers": inputs.markers, "contact_mask": inputs.true_mask, "field": field}


GROUPS = (
    _Group("preprocess", lambda i: {"frame": i.frame}, DetectionScore, lambda *_: None),
    _Group("marker_mask", lambda i: {"image": i.image}, DetectionScore, _see_mask),
    _Group("inpaint", lambda i: {"image": i.image, "marker_mask": i.marker_mask}, RemovalScore, _see_removal),
    _Group("difference", lambda i: {"unmarked": i.unmarked, "frame": i.frame}, ContactScore, _see_contact),
    _Group("hull", lambda i: {"contact_mask": i.true_mask} if i.touching else None, ContactScore, _see_hull),
    _Group("tracker", lambda i: {"image": i.image, "frame": i.frame}, MarkerScore, _see_markers),
    _Group("flow_in_mask", _flow_inputs, FlowScore, _see_flow),
)
"""The stages whose methods are measured alone, in this order."""


def measure_methods(
    pipelines: Mapping[str, Pipeline], rendered: Rendered, unit: CopyUnit, step: Callable[[], None]
) -> list[Measurement]:
    """Every method of every stage on one scene.

    Parameters
    ----------
    pipelines : name -> pipeline; the first is the default one and provides the inputs.
    rendered : the scene. unit : measured along the way. step : called once per stage.
    """
    default = next(iter(pipelines.values()))
    inputs, mapping = _chain(default, rendered)
    limit = rendered.displacement_limit(mapping)
    measurements: list[Measurement] = []
    for group in GROUPS:
        ways = alternatives(pipelines, group.stage)
        if len(ways) > 1 or (ways and group.stage in ("hull", "tracker")):
            made = _measure_group(group, ways, inputs, rendered, unit)
            if group.stage == "tracker" and limit is not None:
                for measurement in made:
                    measurement.limits["displacement_rms"] = limit
            measurements += made
        step()
    return measurements


def _measure_group(
    group: _Group,
    ways: Mapping[str, Alternative],
    inputs: Sequence[_Inputs],
    rendered: Rendered,
    unit: CopyUnit,
) -> list[Measurement]:
    instances = {name: way.build() for name, way in ways.items()}
    scores = {name: group.score() for name in ways}
    failures: dict[str, str] = {}

    def call(name: str) -> Callable[[Any], Any]:
        process, way = instances[name].process, ways[name]

        def run(arguments: Any) -> Any:
            if name in failures:
                return None
            _, given, others = arguments
            ports = {port: given[port] for port in way.inputs & given.keys()}
            more = {port: others[port] for port in way.required & others.keys()}
            try:
                return process(**more | ports)
            except Exception as error:
                failures[name] = f"{type(error).__name__}: {error}"
                return None

        return run

    def see(name: str, _kind: Any, value: Any, result: Any) -> None:
        if name not in failures:
            group.see(scores[name], value[0], result)

    def feed() -> Iterator[tuple[str, Any]]:
        for item in inputs:
            arguments = group.feed(item)
            if arguments is not None:
                unit.take()
                yield item.kind, (item, arguments, item.ports)

    times = interleaved({name: call(name) for name in ways}, feed(), see=see)
    yardstick = next((name for name, way in ways.items() if way.yardstick), None)
    made = []
    for name in ways:
        measurement = Measurement(group.stage, name, rendered.case.label, frames=len(inputs))
        measurement.failure = failures.get(name)
        if measurement.failure is None:
            measurement.errors = scores[name].errors()
            fill_times(measurement, times[name], unit, times[yardstick] if yardstick else None)
        made.append(measurement)
    return made


def fill_times(
    measurement: Measurement,
    times: Mapping[Any, Samples],
    unit: CopyUnit,
    yardstick: Mapping[Any, Samples] | None,
) -> None:
    """Write times, copies and the ratio to the yardstick into a measurement, frames of reference left out."""
    for kind in ("contact", "idle"):
        summary = times[kind].summary() if kind in times else {}
        if not summary:
            continue
        measurement.time[kind] = summary
        measurement.copies[kind] = summary["cpu_ms_p50"] / unit.copy_ms
        other = yardstick[kind].summary() if yardstick and kind in yardstick else {}
        if other and summary["cpu_ms_p50"] > 0:
            measurement.faster[kind] = other["cpu_ms_p50"] / summary["cpu_ms_p50"]
