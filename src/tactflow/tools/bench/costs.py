"""What a frame costs, stage by stage: with a contact, at its first touch, glanced at, and repeated."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Mapping
from contextlib import ExitStack, closing
from dataclasses import dataclass, field, replace
from functools import wraps
from pathlib import Path
from typing import Any, Final

import numpy as np

from tactflow.engine.errors import TactflowError
from tactflow.engine.graph import Node, Pipeline
from tactflow.tools.bench.lockstep import LockstepPipeline, TimedResult, on_recording
from tactflow.tools.bench.timing import quiet

FRAME_KINDS: Final = ("contact", "first touch", "in full, untouched", "glanced at", "repeated")
"""What was done with a frame."""
ENGINE: Final = "engine, message"
"""What is left of a frame's time when that of its stages is taken away."""


@dataclass(frozen=True, slots=True)
class Step:
    """One frame of a run.

    Attributes
    ----------
    t : capture time, s.
    kind : one of `FRAME_KINDS`.
    cpu_ms, stage_ms : CPU time, total and per stage.
    area : of the contact, px^2; 0 without.
    shift : largest displacement of a dot, px; NaN without dots.
    """

    t: float
    kind: str
    cpu_ms: float
    stage_ms: Mapping[str, float]
    area: float
    shift: float


@dataclass(slots=True)
class Costs:
    """The frames of one pipeline on a recording, without references."""

    steps: list[Step] = field(default_factory=list[Step])

    def by_stage(self) -> dict[str, dict[str, float]]:
        """Kind of frame -> stage -> median CPU time, ms; `ENGINE` has what is left of the whole frame's."""
        found: dict[str, dict[str, float]] = {}
        for kind in FRAME_KINDS:
            steps = [step for step in self.steps if step.kind == kind]
            if steps:
                names = list(dict.fromkeys(name for step in steps for name in step.stage_ms))
                values = {n: float(np.median([step.stage_ms.get(n, 0.0) for step in steps])) for n in names}
                whole = float(np.median([step.cpu_ms for step in steps]))
                found[kind] = values | {ENGINE: max(0.0, whole - sum(values.values()))}
        return found


class _Costed(LockstepPipeline):
    """A pipeline whose stages are timed one by one."""

    def __init__(self, pipeline: Pipeline) -> None:
        self._spent: dict[str, float] = defaultdict(float)
        nodes = {
            name: _timed(node, self._spent) if node.component.kind == "stage" else node
            for name, node in pipeline.nodes.items()
        }
        self.stage_ms: list[dict[str, float]] = []
        super().__init__(replace(pipeline, nodes=nodes))

    def _take(self, result: TimedResult) -> None:
        super()._take(result)
        self.stage_ms.append(dict(self._spent))
        self._spent.clear()


def _timed(node: Node, spent: dict[str, float]) -> Node:
    """A node that adds the CPU time, ms, of each call of its stage to `spent`."""
    component = node.component

    @wraps(component.make)
    def make(*args: Any, **offered: Any) -> Any:
        stage: Any = component.make(*args, **offered)
        process: Callable[..., Any] = stage.process

        @wraps(process)
        def timed(*inputs: Any, **named: Any) -> Any:
            began = time.thread_time()
            try:
                return process(*inputs, **named)
            finally:
                spent[node.id] += 1e3 * (time.thread_time() - began)

        stage.process = timed
        return stage

    return replace(node, component=replace(component, make=make))


def measure_costs(
    pipelines: Mapping[str, Pipeline], recording: Path | str, failures: dict[str, str] | None = None
) -> dict[str, Costs]:
    """Run pipelines over a recording in turns of a few frames. Returns name -> its frames.

    failures : gets name -> why it failed, of those that did; None: what fails raises TactflowError.
    """
    costs = {name: Costs() for name in pipelines}
    touched = dict.fromkeys(pipelines, False)
    with quiet(), ExitStack() as stack:
        running = {
            name: stack.enter_context(closing(_Costed(on_recording(pipeline, Path(recording)))))
            for name, pipeline in pipelines.items()
        }
        while running:
            for name, pipeline in list(running.items()):
                try:
                    results = pipeline.block()
                except TactflowError as error:
                    if failures is None:
                        raise
                    failures[name], results = str(error), []
                    del costs[name]
                # A pipeline that failed may have timed a frame without a result.
                for result, stage_ms in zip(results, pipeline.stage_ms, strict=False):
                    if not result.frame.reference:
                        costs[name].steps.append(_step(result, stage_ms, touched[name]))
                    touched[name] = result.contact is not None
                pipeline.stage_ms.clear()
                if not results:
                    del running[name]
    return costs


def _step(result: TimedResult, stage_ms: Mapping[str, float], touched: bool) -> Step:
    markers, contact, reasons = result.markers, result.contact, result.skipped.values()
    if contact is not None:
        kind = FRAME_KINDS[0] if touched else FRAME_KINDS[1]
    elif "at_rest" in reasons:
        kind = FRAME_KINDS[3]
    else:
        kind = FRAME_KINDS[4] if "unchanged" in reasons else FRAME_KINDS[2]
    shift = np.nan if markers is None else float(np.abs(markers.position - markers.origin).max(initial=0))
    area = 0.0 if contact is None else float(contact.area)
    return Step(result.t, kind, 1e3 * result.cpu_s, stage_ms, area, shift)
