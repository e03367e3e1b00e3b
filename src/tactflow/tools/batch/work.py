"""Run a pipeline over one recording, in any process."""

from __future__ import annotations

import functools
import hashlib
import logging
import math
import os
import socket
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import orjson

import tactflow
from tactflow.api import make_runner
from tactflow.config.files_used import files_named
from tactflow.config.load import load_pipeline
from tactflow.config.overrides import Override, from_settings
from tactflow.engine.collect import with_collector
from tactflow.engine.errors import ConfigError, SourceError, StageError, TactflowError
from tactflow.engine.graph import Mark, Node, Pipeline
from tactflow.message.result import Result
from tactflow.outputs import DISK_FULL
from tactflow.streaming import stream
from tactflow.system.clock import SYSTEM
from tactflow.tools.batch.recordings import Recording
from tactflow.tools.batch.store import Format, Outcome, Store, file_name, fingerprint, remove
from tactflow.tools.batch.summary import Summary

_SOURCE_POSITION = Mark("recording", 0, 0)
"""Position of the source in error messages: it is not in the pipeline file."""
_MAX_WARNINGS = 5
"""Warnings kept per recording; further ones are mostly repetitions."""
RESULT_SUFFIXES: Mapping[Format, str] = {"parquet": "", "csv": ".csv", "jsonl": ".jsonl"}
"""End of the name of a result, by format; Parquet tables are a folder."""
_OUTPUT_ONLY = {"path", "overwrite", "append", "flush"}
"""Sink parameters that do not change the content of the output."""


@dataclass(frozen=True, slots=True)
class Request:
    """A pipeline that any process can load.

    Attributes
    ----------
    file : absolute path.
    overrides : as for `--set`.
    sensor : None for a pipeline with a single sensor.
    digest : expected `pipeline_digest`.
    """

    file: str
    overrides: tuple[str, ...]
    sensor: str | None
    format: Format
    digest: str = ""


@dataclass(frozen=True, slots=True)
class Task:
    """A recording to process.

    Attributes
    ----------
    out : output folder.
    scratch : folder for unfinished results.
    """

    recording: Recording
    request: Request
    out: str
    scratch: str


def resolved(file: Path, overrides: list[str], sensor: str | None, format_: Format) -> Request:
    """Validate a pipeline and return its request.

    Raises
    ------
    ConfigError : the pipeline is invalid, or its source has no parameter `source`.
    """
    request = Request(os.path.abspath(file), tuple(overrides), sensor, format_)
    return replace(request, digest=pipeline_digest(load(request)))


def load(request: Request) -> Pipeline:
    """Load the pipeline with a single sink, which writes the results; raises ConfigError.

    If the file has a sink of the requested format, its settings apply, except for the path.
    """
    file, format_ = Path(request.file), request.format
    pipeline = load_pipeline(file, request.overrides, sensor=request.sensor)
    if not any(node.component.name == format_ for node in pipeline.sinks):
        extra = {f"--{format_}": {"path": os.devnull}}
        pipeline = load_pipeline(file, request.overrides, extra, sensor=request.sensor)
    sink = next(node.id for node in pipeline.sinks if node.component.name == format_)
    nodes = {id_: n for id_, n in pipeline.nodes.items() if n.component.kind != "sink" or id_ == sink}
    if "source" not in pipeline.source.component.params.model_fields:
        raise ConfigError(f"{pipeline.source.mark}: a batch needs a source with the parameter source")
    return replace(pipeline, nodes=nodes, opencv_threads=1)


def results_of(request: Request) -> Callable[[str], Iterable[Result]]:
    """A function that gives the results of a recording, with pictures, for a dataset."""

    def results(source: str) -> Iterable[Result]:
        overrides: list[Override | str] = [*request.overrides, *from_settings({"sinks": {}})]
        pipeline = load_pipeline(Path(request.file), overrides, sensor=request.sensor)
        node = _source_node(pipeline, _input(pipeline, source))
        return stream(replace(pipeline, nodes={**pipeline.nodes, node.id: node}), images=True)

    return results


_loaded = functools.lru_cache(maxsize=2)(load)


def pipeline_digest(pipeline: Pipeline) -> str:
    """Digest of the resolved settings, the files they name, and tactflow's version.

    Files, such as a calibration or Python code, enter with size and modification time.
    """
    stages = {node.id: _settings(pipeline, node) for node in pipeline.nodes.values()}
    files = {path for node in pipeline.nodes.values() for path in _files(pipeline, node)}
    content = {
        "settings": {k: v for k, v in pipeline.settings.items() if k not in ("sinks", "stages")},
        # The order matters: an input comes from the nearest stage above.
        "nodes": list(stages.items()),
        "files": [[str(path), fingerprint(path)] for path in sorted(files)],
        "tactflow": tactflow.__version__,
    }
    return hashlib.sha256(orjson.dumps(content, default=str)).hexdigest()[:16]


def _settings(pipeline: Pipeline, node: Node) -> Any:
    """Settings of a node, without its input and output paths."""
    if node.component.kind == "sink":
        return [node.component.name, node.params.model_dump(exclude=_OUTPUT_ONLY)]
    settings = dict(pipeline.settings["stages"].get(node.id) or {})
    if node.id == pipeline.source.id:
        settings = {key: value for key, value in settings.items() if key not in ("source", "realtime")}
    return settings


def _files(pipeline: Pipeline, node: Node) -> Iterator[Path]:
    """Files on which the results of a node depend."""
    if pipeline.calibration is not None:
        yield pipeline.calibration
    if node.component.kind != "sink":
        params = node.params if node.component.kind == "stage" else node.params.changed(source="")
        yield from (path for path in files_named(params, pipeline.directory) if path.is_file())
    module = node.component.cls.__module__
    code = getattr(sys.modules.get(module), "__file__", None)
    if code is not None and not module.startswith("tactflow."):
        yield Path(code)


def work(task: Task) -> Outcome:
    """Process one recording and save its result and record; errors are returned in the outcome."""
    began = SYSTEM.now()
    outcome = Outcome(
        task.recording.source,
        task.recording.name,
        "failed",
        started_unix=SYSTEM.unix(),
        worker=f"{socket.gethostname()}:{os.getpid()}",
        tactflow=tactflow.__version__,
        pipeline=task.request.digest,
    )
    unfinished = Path(task.scratch, file_name(task.recording))
    try:
        done, pictures = _run(task, outcome, unfinished)
        done = replace(done, took_s=SYSTEM.now() - began)
        _publish(task, done, unfinished, pictures)
    except Exception as error:
        with suppress(OSError):
            remove(unfinished)
        return replace(
            outcome, error=_describe(error), took_s=SYSTEM.now() - began, disk_full=_is_disk_full(error)
        )
    return done


def _run(task: Task, outcome: Outcome, unfinished: Path) -> tuple[Outcome, list[bytes]]:
    """Run the pipeline into the scratch folder; also returns the pictures of the page."""
    path = task.recording.path
    before = None if path is None else fingerprint(path)
    # A worker that died may have left files.
    remove(unfinished)
    summary = Summary()
    pipeline = _pipeline_for(task, unfinished)
    runner = make_runner(with_collector(pipeline, Result, summary.add, name="tactflow.batch", sinks=True))
    with _warnings() as texts:
        result = runner.run()
    if result.failure is not None:
        raise result.failure
    if path is not None and fingerprint(path) != before:
        raise SourceError(f"{path}: changed while being read; run again")
    pictures = summary.pictures()
    done = replace(
        outcome,
        status="done",
        frames=result.stats["frames"],
        dropped=result.stats["dropped"],
        duration_s=summary.duration,
        contacts=summary.contacts,
        touching_frames=summary.touching,
        largest_area_px2=summary.largest,
        warnings="\n".join(texts) or None,
        recording_is=before,
        result_is=fingerprint(unfinished),
        result=f"results/{unfinished.name}{RESULT_SUFFIXES[task.request.format]}",
        pictures=tuple(picture.t for picture in pictures),
        trace=summary.trace.values,
    )
    return done, [picture.jpeg for picture in pictures]


def _publish(task: Task, outcome: Outcome, unfinished: Path, pictures: list[bytes]) -> None:
    """Move a result to its final path, then save the record, which marks it as complete."""
    path = Path(task.out, str(outcome.result))
    if path.is_dir():
        # A rename cannot overwrite a folder.
        remove(path)
    unfinished.replace(path)
    Store(Path(task.out)).save(task.recording, outcome, pictures)


def _pipeline_for(task: Task, path: Path) -> Pipeline:
    """The pipeline that reads the task's recording and writes to a path."""
    pipeline = _loaded(task.request)
    if pipeline_digest(pipeline) != task.request.digest:
        _loaded.cache_clear()
        raise StageError(
            f"the worker {socket.gethostname()} has a different pipeline: it runs tactflow "
            f"{tactflow.__version__}, or {task.request.file} or a file that it names has changed; run again"
        )
    (sink,) = pipeline.sinks
    # One part per table, so that repeated runs write identical files.
    flush = {"flush": math.inf} if task.request.format == "parquet" else {}
    params = sink.params.changed(path=str(path), overwrite=True, **flush)
    source, input_ = pipeline.source, _input(pipeline, task.recording.source)
    stages = dict(pipeline.settings["stages"])
    stages[source.id] = {**(stages[source.id] or {}), **input_}
    # Results store the settings as metadata.
    settings = {**pipeline.settings, "stages": stages, "sinks": {sink.component.name: {}}}
    nodes = {
        **pipeline.nodes,
        source.id: _source_node(pipeline, input_),
        sink.id: replace(sink, params=params),
    }
    return replace(pipeline, nodes=nodes, settings=settings)


def _input(pipeline: Pipeline, source: str) -> dict[str, Any]:
    """The parameters of the source stage that make it read a recording."""
    input_ = {"source": source, "realtime": False}
    return {key: value for key, value in input_.items() if key in type(pipeline.source.params).model_fields}


def _source_node(pipeline: Pipeline, input_: Mapping[str, Any]) -> Node:
    """The source stage with these parameters."""
    params = pipeline.source.params.changed(**input_)
    return replace(pipeline.source, params=params, mark=_SOURCE_POSITION)


def _describe(error: Exception) -> str:
    """Error message for users; unexpected errors include the line of code."""
    if isinstance(error, TactflowError):
        return str(error)
    if isinstance(error, OSError):
        return f"{error.filename}: {error.strerror}" if error.filename else str(error.strerror or error)
    place = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__}: {error} ({place.filename}:{place.lineno})"


def _is_disk_full(error: BaseException | None) -> bool:
    while error is not None:
        if isinstance(error, OSError) and error.errno in DISK_FULL:
            return True
        error = error.__cause__ or error.__context__
    return False


@contextmanager
def _warnings() -> Iterator[list[str]]:
    """Collect the first warnings logged in the block."""
    texts: list[str] = []
    handler = logging.Handler(logging.WARNING)
    handler.emit = lambda record: texts.append(record.getMessage())  # type: ignore[method-assign]
    logger = logging.getLogger("tactflow")
    logger.addHandler(handler)
    try:
        yield texts
    finally:
        logger.removeHandler(handler)
        del texts[_MAX_WARNINGS:]
