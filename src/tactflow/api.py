"""Pipelines from Python: load, check and run one, call a single stage. What `import tactflow` offers."""

from __future__ import annotations

import inspect
import logging
import signal
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cache, wraps
from itertools import count
from pathlib import Path
from types import FrameType
from typing import Any, TypeVar, overload

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.config.load import load_pipeline
from tactflow.config.overrides import Override, from_settings
from tactflow.config.recorded import read_calibration, with_recorded_calibration
from tactflow.config.registry import resolve
from tactflow.config.shipped import find_pipeline
from tactflow.config.validation import validated
from tactflow.engine.conformance import build, component, configured
from tactflow.engine.contract import Stage
from tactflow.engine.errors import ConfigError
from tactflow.engine.frame import NO_PICTURE, Frame
from tactflow.engine.graph import Pipeline
from tactflow.engine.ports import Port
from tactflow.engine.run import Runner, RunResult
from tactflow.sources.memory import MemoryFrames
from tactflow.system.memory import keep_freed_memory
from tactflow.system.opencv import opencv_conflict
from tactflow.system.redaction import public_address
from tactflow.system.signals import INTERRUPTED_EXIT_CODE, Interrupted, ending_handled, on_ending
from tactflow.vision import compiled

logger = logging.getLogger("tactflow")

S = TypeVar("S", bound=Stage)

Frames = Iterable[NDArray[np.uint8]]
"""Pictures in memory: an (N, H, W, 3) BGR or (N, H, W) grey array, a list, or any iterator of pictures."""

Settings = Mapping[str, Any]
"""Values of the pipeline file to replace, as in `{"stages.preprocess.rotate": 0, "sinks.zmq": None}`."""


def load(
    pipeline: str | Path | None = None,
    *,
    source: str | Path | Frames | None = None,
    settings: Settings | None = None,
    sensor: str | None = None,
    realtime: bool = False,
) -> Pipeline:
    """Read and check a pipeline file.

    Parameters
    ----------
    pipeline : a file, or the name of a shipped pipeline such as "markerless"; None: `./pipeline.yaml`, else
        the shipped default.
    source : replaces the source of the capture stage, as `--source` does: "video.avi", "sim:press", "0" ...;
        or the frames themselves, (H, W, 3) uint8 BGR or (H, W) grey: an array, a list, any iterator. Their
        rate is 30 Hz unless settings has another `stages.capture.fps`.
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
    frames = None if source is None or isinstance(source, str | Path) else source
    if source is not None:
        text = _MEMORY_DESCRIPTION if frames is not None else str(source)
        values.append(Override("source", text, f"source {public_address(text)}"))
    if realtime:
        values.append(Override("realtime", value=True, origin="realtime"))
    file = find_pipeline(None if pipeline is None else str(pipeline))
    loaded = load_pipeline(file, from_settings(settings or {}), source_values=values, sensor=sensor)
    return loaded if frames is None else _with_frames(loaded, frames)


_MEMORY_DESCRIPTION = "frames in memory"
"""Name of the source in messages if the frames came from Python."""


def _with_frames(pipeline: Pipeline, frames: Frames) -> Pipeline:
    """The pipeline with a source that reads these frames."""
    node = pipeline.source
    if "opener" not in inspect.signature(node.component.make).parameters:
        name = node.component.cls.__name__
        raise ConfigError(f"{node.id}: {name} cannot take frames from memory; use the stage capture")

    def open_frames(_: str, *, fps: float | None = None, **__: Any) -> MemoryFrames:
        return MemoryFrames(frames, fps)

    component = node.component.with_arguments(opener=open_frames)
    return replace(pipeline, nodes={**pipeline.nodes, node.id: replace(node, component=component)})


def check(pipeline: str | Path | None = None, *, settings: Settings | None = None) -> list[str]:
    """All mistakes in a pipeline file, each with its position; empty if it can be run.

    pipeline, settings : as for `load`; it raises no errors, but returns them.

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
    source: str | Path | Frames | None = None,
    settings: Settings | None = None,
    sensor: str | None = None,
    realtime: bool = False,
    max_frames: int | None = None,
) -> RunResult:
    """Run a pipeline with its sinks to the end of its source, in this process; like `tactflow run`.

    Parameters
    ----------
    pipeline, source, settings, sensor, realtime : as for `load`; or a loaded pipeline.
    max_frames : stop after this many frames.

    Returns
    -------
    How it ended; `stats` are those of the statistics file.

    Raises
    ------
    ConfigError : the pipeline file is wrong; nothing was started.
    TactflowError : a stage, a sink or the source failed.
    KeyboardInterrupt : Ctrl-C: the run has ended without its pending frames. After a second one, the part
        that is being closed is left as it is.

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
    if result.exit_code == INTERRUPTED_EXIT_CODE:
        raise KeyboardInterrupt
    if result.failure is not None:
        raise result.failure
    return result


def make_runner(pipeline: Pipeline, **options: Any) -> Runner:
    """A run of a pipeline; OpenCV has the threads that the pipeline sets.

    options : passed to `Runner`. Raises ConfigError if the calibration cannot be read.
    """
    _warn_of_opencv()
    compiled.warn_if_plain()
    keep_freed_memory()
    if pipeline.opencv_threads is not None:
        cv2.setNumThreads(pipeline.opencv_threads)
    pipeline = with_recorded_calibration(pipeline)
    return Runner(pipeline, offered={"calibration": read_calibration(pipeline)}, **options)


@cache
def _warn_of_opencv() -> None:
    """Say once if several packages of OpenCV are installed that differ."""
    packages = Path(cv2.__file__).parents[1]
    if conflict := opencv_conflict(packages, has_contrib=hasattr(cv2, "ximgproc")):
        logger.warning("%s", conflict)


@contextmanager
def ended_by_signals(runner: Runner) -> Iterator[Sequence[int]]:
    """One Ctrl-C, SIGTERM or SIGHUP drains the pipeline; a second one ends it at once; a third is not caught.

    Yields the numbers of the signals received so far.
    """
    caught: list[int] = []

    def handle(number: int, _: FrameType | None) -> None:
        caught.append(number)
        if len(caught) == 1:
            # Stop rather than raise: Python swallows exceptions while it frees an object or imports a module.
            runner.stop("signal")
            return
        on_ending(signal.SIG_DFL)
        raise Interrupted

    with ending_handled(handle):
        yield caught


@overload
def stage(use: type[S], /, **params: Any) -> S: ...
@overload
def stage(use: str, /, **params: Any) -> Stage: ...
def stage(use: str | type[Stage], /, **params: Any) -> Any:
    """One stage by itself, to be called without the engine: `stage("hull").process(mask)`.

    Parameters
    ----------
    use : a stage class, or what `use:` says in a pipeline file: "hull", "package.module:Class",
        "./file.py:Class".
    params : its parameters.

    Returns
    -------
    The stage, opened. Its `process` takes and returns the ports listed by `tactflow stages NAME`, except that
    `frame` may be left out: it is then made from the picture, and the first picture is the reference.

    Raises
    ------
    ConfigError : there is no such stage, or a parameter is wrong.

    Examples
    --------
    >>> import tactflow
    >>> scene = tactflow.open_scene("press")
    >>> difference = tactflow.stage("difference")
    >>> difference.process(scene.frame(0)).touching, difference.process(scene.frame(60)).touching
    (False, True)
    """
    if isinstance(use, str):
        name, found = use, resolve(use, "stages", Path())
    else:
        name, found = use.__name__, component(use, use.__name__, use.__module__, ())
    checked = validated(found.params, params, name, origin=f'stage("{name}")')
    offered = {"sensor": "main", "directory": Path(), "skipping": True, "control": None, "calibration": None}
    instance: Any = build(found.make, checked, offered)
    instance.open()
    instance.process = _with_frames_made(instance.process, configured(found, checked).ports.inputs)
    return instance


def _with_frames_made(process: Callable[..., Any], inputs: Sequence[Port]) -> Callable[..., Any]:
    """`process` with an optional parameter `frame: Frame`; the first call is the reference.

    Positional arguments are the other inputs, in order; the frame is created from the first array among them.
    A stage whose only input is the frame takes the picture instead.
    """
    frame = next((port.name for port in inputs if port.annotation is Frame), None)
    if frame is None:
        return process
    names = [port.name for port in inputs if port.name != frame] or [frame]
    numbers = count()

    @wraps(process)
    def call(*args: Any, **kwargs: Any) -> Any:
        values = dict(zip(names, args, strict=False)) | kwargs
        if len(args) > len(names) or any(isinstance(value, Frame) for value in values.values()):
            return process(*args, **kwargs)
        picture = next((value for value in values.values() if isinstance(value, np.ndarray)), NO_PICTURE)
        seq = next(numbers)
        return process(**values | {frame: Frame("main", seq, seq / 30, picture)})

    return call
