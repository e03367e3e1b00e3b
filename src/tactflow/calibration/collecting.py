"""Run a pipeline on its source and collect what it gives, frame by frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from tactflow.api import ended_by_signals, make_runner
from tactflow.engine.conformance import own_sink
from tactflow.engine.contract import Sink
from tactflow.engine.errors import ConfigError
from tactflow.engine.graph import Node, Pipeline
from tactflow.system.signals import INTERRUPTED, Interrupted

_COLLECT: Final = "tactflow.calibrate"
"""Id of the sink that collects; no id of a file has a point in it."""


def collect(
    pipeline: Pipeline,
    sink: type[Sink],
    values: Mapping[str, Any],
    needed: Mapping[str, str],
    calibration: Path | None = None,
    watchers: Mapping[str, Node] | None = None,
) -> Any:
    """Run a pipeline with a sink of ours in place of its own, nothing skipped; returns the sink.

    A signal such as Ctrl-C ends it; what was collected until then counts. A second one, or one while kernels
    are compiled, raises KeyboardInterrupt.

    Parameters
    ----------
    sink, values : its class, and attributes that it gets.
    needed : port -> the stage that gives it. calibration : the file to use, in place of the pipeline's own.
    watchers : sinks that look on, by their ids.

    Raises
    ------
    ConfigError : a needed port is missing. TactflowError : a stage or the source failed.
    """
    attributes: dict[str, Any] = {name: staticmethod(value) for name, value in values.items()}
    node = own_sink(pipeline, sink, _COLLECT, "tactflow calibrate", **attributes)
    inputs = dict(node.inputs)
    # Of a gel without markers the picture itself is without them.
    if "unmarked" in inputs:
        inputs["unmarked"] = inputs["unmarked"] or pipeline.last_output("image")
    for port, stage in needed.items():
        if inputs[port] is None:
            raise ConfigError(f"calibrate: required a pipeline that gives {port}; add the stage {stage}")
    kept = {id_: node for id_, node in pipeline.nodes.items() if node.component.kind != "sink"}
    kept.update(watchers or {})
    kept[_COLLECT] = replace(node, inputs=inputs)
    runner = make_runner(replace(pipeline, nodes=kept, skipping=False, calibration=calibration))
    with ended_by_signals(runner):
        result = runner.run()
    if result.exit_code == INTERRUPTED:
        raise Interrupted
    if result.failure is not None:
        raise result.failure
    return runner.nodes[_COLLECT].instance
