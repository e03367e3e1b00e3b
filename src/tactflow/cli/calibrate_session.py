"""Sessions of `tactflow calibrate`: the pipeline that plays a recording or a camera, and its page."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

from tactflow.api import Settings, ended_by_signals, load, make_runner
from tactflow.calibration.guide import Guide
from tactflow.calibration.session import Play
from tactflow.calibration.weights import WeightGuide
from tactflow.engine.collect import with_collector
from tactflow.engine.contract import Source
from tactflow.engine.errors import ConfigError
from tactflow.engine.graph import Node, Pipeline
from tactflow.message.result import Result
from tactflow.system.signals import INTERRUPTED_EXIT_CODE, Interrupted


def file_and_pipeline(args: argparse.Namespace, verb: str) -> tuple[Path, str | None]:
    """The calibration file and the pipeline among the words of a verb."""
    if len(args.words) not in (1, 2):
        raise ConfigError(f"calibrate {verb}: required a calibration file, and a pipeline if wanted")
    path, *pipeline = args.words
    return Path(path), pipeline[0] if pipeline else None


def player(pipeline: Pipeline, page: Mapping[str, Node] = MappingProxyType({})) -> Play:
    """Plays a pipeline without its sinks, nothing skipped. page : sinks that look on.

    A signal such as Ctrl-C ends it.
    """

    def play(
        take: Callable[[Result, Source], bool], needed: Mapping[str, str], calibration: Path | None = None
    ) -> None:
        ports = {port.name for node in pipeline.nodes.values() for port in node.component.ports.outputs}
        for port, stage in needed.items():
            if port not in ports:
                raise ConfigError(f"calibrate: required a pipeline that gives {port}; add the stage {stage}")

        def hand_over(result: Result) -> None:
            if runner.source is not None and not take(result, runner.source):
                runner.stop()

        plain = replace(pipeline, skipping=False, calibration=calibration)
        collecting = with_collector(plain, Result, hand_over, name="tactflow.calibrate", references=True)
        runner = make_runner(replace(collecting, nodes={**collecting.nodes, **page}))
        with ended_by_signals(runner):
            ended = runner.run()
        if ended.exit_code == INTERRUPTED_EXIT_CODE:
            raise Interrupted
        if ended.failure is not None:
            raise ended.failure

    return play


def load_uncalibrated(
    args: argparse.Namespace,
    pipeline: str | None,
    settings: Settings = MappingProxyType({}),
    source: str | None = None,
) -> Pipeline:
    """The pipeline without a calibration. source : default: --source."""
    settings = {"calibration": None, **settings}
    source = args.source if source is None else source
    return load(pipeline, source=source, sensor=args.sensor, settings=settings, realtime=args.realtime)


def page_of(args: argparse.Namespace, pipeline: str | None, guide: Guide | WeightGuide) -> dict[str, Node]:
    """The live page of the pipeline, or else one with defaults, showing the guided session."""
    own, added = load_uncalibrated(args, pipeline), load_uncalibrated(args, pipeline, {"sinks.view": {}})
    node = next(node for node in (*own.sinks, *added.sinks) if node.component.name == "view")
    return {node.id: replace(node, component=node.component.with_arguments(session=guide))}
