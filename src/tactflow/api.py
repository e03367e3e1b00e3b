"""Pipelines from Python: load, check and run one, call a single stage. What `import tactflow` offers."""

from __future__ import annotations

import signal
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from types import FrameType
from typing import Any

import cv2

from tactflow.config.load import load_pipeline
from tactflow.config.overrides import Override, from_settings
from tactflow.config.registry import resolve
from tactflow.config.shipped import find_pipeline
from tactflow.config.validation import validated
from tactflow.engine.conformance import build
from tactflow.engine.errors import ConfigError, SourceError
from tactflow.engine.graph import Pipeline
from tactflow.engine.run import Runner, RunResult
from tactflow.system.redaction import public_address
from tactflow.system.signals import INTERRUPTED, Interrupted, ending_handled, on_ending
from tactflow.vision import compiled

Settings = Mapping[str, Any]
"""Values of the pipeline file to replace, as in `{"stages.preprocess.rotate": 0, "sinks.zmq": None}`."""


def load(
    pipeline: str | Path | None = None,
    *,
    source: str | None = None,
    settings: Settings | None = None,
    sensor: str | None = None,
    realtime: bool = False,
) -> Pipeline:
    """Read and check a pipeline file.

    Parameters
    ----------
    pipeline : a file, or the name of a shipped pipeline such as "markerless"; None: `./pipeline.yaml`, else
        the shipped default.
    source : replaces the source of the capture stage, as `--source` does: "video.avi", "sim:press", "0" ...
    settings : values to replace, as `--set` does; None for a whole stage or sink removes it.
    sensor : which sensor of a file with `sensors:`; None is the first.
    realtime : play a recording at its own pace, dropping frames like a camera.

    Raises
    ------
    ConfigError : the message holds every mistake with file, line and column.

    Examples
    --------
    >>> import tactflow
    >>> pipeline = tactflow.load("markerless", source="sim:unmarked", settings={"sinks.zmq": None})
    >>> list(pipeline.nodes)[:3]
    ['capture', 'probe', 'preprocess']
    """
    values = []
    if source is not None:
        values.append(Override("source", str(source), f"source {public_address(str(source))}"))
    if realtime:
        values.append(Override("realtime", value=True, origin="realtime"))
    file = find_pipeline(None if pipeline is None else str(pipeline))
    return load_pipeline(file, from_settings(settings or {}), source_values=values, sensor=sensor)


def check(pipeline: str | Path | None = None, *, settings: Settings | None = None) -> list[str]:
    """Every mistake in a pipeline file, each a text with its place; empty if it can be run.

    pipeline, settings : as for `load`.

    Examples
    --------
    >>> import tactflow
    >>> tactflow.check("markerless")
    []
    >>> print(tactflow.check("markerless", settings={"stages.hull.min_aera": 5})[0])
    settings: stages.hull.min_aera: unknown parameter; did you mean min_area?
    """
    try:
        load(pipeline, settings=settings)
    except ConfigError as error:
        return list(error.mistakes)
    return []


def run(
    pipeline: str | Path | Pipeline | None = None,
    *,
    source: str | None = None,
    settings: Settings | None = None,
    sensor: str | None = None,
    realtime: bool = False,
    max_frames: int | None = None,
) -> RunResult:
    """Run a pipeline with its sinks to the end of its source, in this process; like `tactflow run`.

    Parameters
    ----------
    pipeline : what `load` returned, or what it takes; then the other parameters are those of `load`.
    max_frames : stop after so many.

    Returns
    -------
    How it ended; `stats` are those of the statistics file.

    Raises
    ------
    ConfigError : the pipeline file is wrong; nothing was started.
    TactflowError : a stage, a sink or the source failed.
    KeyboardInterrupt : Ctrl-C; the run has ended, without what was under way. A second one leaves the part
        that is being closed as it is; the others are closed.

    Examples
    --------
    >>> import tactflow
    >>> no_sinks = {"sinks": {}}
    >>> tactflow.run("markerless", source="sim:unmarked", settings=no_sinks, max_frames=5).stats["frames"]
    5
    """
    if not isinstance(pipeline, Pipeline):
        pipeline = load(pipeline, source=source, settings=settings, sensor=sensor, realtime=realtime)
    result = make_runner(pipeline, max_frames=max_frames).run()
    if result.exit_code == INTERRUPTED:
        raise KeyboardInterrupt
    if result.failure is not None:
        raise result.failure
    return result


def make_runner(pipeline: Pipeline, **options: Any) -> Runner:
    """A run of a pipeline, after OpenCV was given the threads that the pipeline sets.

    options : of `Runner`.
    """
    if pipeline.opencv_threads is not None:
        cv2.setNumThreads(pipeline.opencv_threads)
    return Runner(_calibrated(pipeline), **options)


@contextmanager
def ended_by_signals(runner: Runner) -> Iterator[Sequence[int]]:
    """One Ctrl-C, SIGTERM or SIGHUP drains the pipeline; a second one ends it at once; a third is not caught.

    While kernels are compiled there is nothing to drain, and the first one ends it. Gives those that came.
    """
    caught: list[int] = []

    def handle(number: int, _: FrameType | None) -> None:
        caught.append(number)
        if len(caught) == 1:
            # In any case: Python drops what is raised while it frees an object or imports a module.
            runner.stop("signal")
            if not compiled.is_loading():
                return
        else:
            on_ending(signal.SIG_DFL)
        raise Interrupted

    with ending_handled(handle):
        yield caught


def _calibrated(pipeline: Pipeline) -> Pipeline:
    """With the calibration that its recording was made with, unless the pipeline names one, or null."""
    spec = pipeline.source.params.model_dump().get("source")
    name = str(spec).partition("?")[0]
    if pipeline.calibration or "calibration" in pipeline.settings or not name.endswith(".mcap"):
        return pipeline
    from tactflow.calibration.file import is_kept
    from tactflow.recording import missing_packages
    from tactflow.sources.base import find_path

    # What is wrong with the file the source will say.
    with suppress(SourceError, OSError):
        path = find_path(name, pipeline.directory)
        if missing_packages() is None and is_kept(_attachments(path)):
            return replace(pipeline, calibration=path)
    return pipeline


def _attachments(path: Path) -> Collection[str]:
    from tactflow.recording.reader import attachments
    from tactflow.recording.records import NotARecordingError

    try:
        return attachments(path)
    except NotARecordingError:
        return ()


def stage(use: str, /, **params: Any) -> Any:
    """One stage by itself, to be called without the engine: `stage("hull").process(mask)`.

    Parameters
    ----------
    use : what `use:` says in a pipeline file: "hull", "package.module:Class", "./file.py:Class".
    params : its parameters, as in a pipeline file.

    Returns
    -------
    The stage, opened. Its `process` takes and returns what `tactflow stages NAME` says.

    Raises
    ------
    ConfigError : there is no such stage, or a parameter is wrong.

    Examples
    --------
    >>> import numpy as np
    >>> import tactflow
    >>> mask = np.zeros((60, 80), np.uint8)
    >>> mask[20:40, 10:50] = 255
    >>> contact = tactflow.stage("hull").process(mask)
    >>> contact.center, contact.angle
    ((29.5, 29.5), 0.0)
    """
    component = resolve(use, "stages", Path())
    checked = validated(component.params, params, use, origin=f'stage("{use}")')
    offered = {"sensor": "main", "directory": Path(), "skipping": True, "control": None, "calibration": None}
    instance = build(component.cls, checked, offered)
    instance.open()
    return instance
