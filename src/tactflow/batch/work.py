"""Works on one recording, in whatever process an executor has chosen for it."""

from __future__ import annotations

import errno
import functools
import hashlib
import logging
import math
import os
import socket
import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import orjson

from tactflow.api import make_runner
from tactflow.batch.digests import (
    digest_of,
    fingerprint,
    input_digest,
    pipeline_digest,
    result_key,
    versions,
)
from tactflow.batch.folder import Folder, remove
from tactflow.batch.parts import OVERLAP, of_part
from tactflow.batch.recordings import Recording
from tactflow.batch.summary import Summary, with_looker
from tactflow.batch.task import Format, Outcome, PipelineRequest, Report, Task, result_name
from tactflow.config.load import load_pipeline
from tactflow.engine.errors import ConfigError, SourceError, StageError, TactflowError
from tactflow.engine.graph import Mark, Pipeline
from tactflow.engine.run import Progress
from tactflow.system.clock import SYSTEM

DEADLY = 2
"""Workers that a recording may kill before it is set aside."""
_SRC = Mark("recording", 0, 0)
"""Where the source stands: not in the pipeline file, which is not to blame for it."""
_MOST_NOTES = 5
"""Warnings that are kept of one recording. Chosen by hand."""


def work(task: Task, report: Report = lambda _done, _total: None) -> Outcome:
    """Run the pipeline over one recording, unless its result is there.

    report : told how far it is. Never raises a TactflowError: what is wrong is in the outcome.
    """
    began = SYSTEM.now()
    blank = Outcome(
        task.recording.source,
        task.recording.name,
        "failed",
        pipeline=task.pipeline.digest,
        started=SYSTEM.unix(),
        worker=f"{socket.gethostname()}:{os.getpid()}",
        versions=versions(),
    )
    try:
        with attempt(task) as attempts:
            blank = replace(blank, attempts=attempts)
            if attempts > DEADLY:
                what = f"it killed its worker {DEADLY} times. Is memory short, or the file harmful?"
                outcome = replace(blank, status="set aside", error=what, attempts=DEADLY)
            else:
                outcome = _result(task, blank, report)
    except TactflowError as error:
        outcome = replace(blank, error=str(error), disk_full=is_disk_full(error))
    except OSError as error:
        where = "" if error.filename is None else f"{error.filename}: "
        what = f"{where}{error.strerror or error}"
        outcome = replace(blank, error=what, disk_full=is_disk_full(error))
    except Exception as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        what = f"{type(error).__name__}: {error} ({place.filename}:{place.lineno})"
        outcome = replace(blank, error=what, disk_full=is_disk_full(error))
    return replace(outcome, seconds=0.0 if outcome.reused else SYSTEM.now() - began)


@contextmanager
def attempt(task: Task) -> Iterator[int]:
    """Count that a worker begins a recording; the count is forgotten when the worker is through with it."""
    marks = Path(task.scratch, f"{scratch_name(task)}.attempts")
    with marks.open("ab") as file:
        file.write(b"x")
    attempts = marks.stat().st_size
    try:
        yield attempts
    finally:
        with suppress(OSError):
            marks.unlink()


def scratch_name(task: Task) -> str:
    """What files of a task are called while it is not finished: no two of a call have the same."""
    name = hashlib.sha256(task.recording.source.encode()).hexdigest()[:16]
    return name if task.part is None else f"{name}-{task.part.number}"


def _result(task: Task, blank: Outcome, report: Report) -> Outcome:
    """The outcome of a recording: that of an earlier call if its result is there, else of a run."""
    path = task.recording.path
    try:
        before = None if path is None else fingerprint(path)
        # The parts of a recording have one digest: the first one works it out.
        read = "" if task.part is not None and task.part.number else input_digest(task.recording)
    except OSError as error:
        raise SourceError(f"{error.filename or path}: cannot be read: {error.strerror or error}") from error
    if task.part is not None:
        return _part(task, replace(blank, input=before, input_digest=read), report)
    key = result_key(read, task.pipeline.digest)
    folder = Folder(Path(task.folder))
    there = folder.outcome_of(key, verify=task.verify)
    if there is not None:
        return replace(there.of(task.recording), input=before, reused=True, started=blank.started)
    found = replace(blank, key=key, input=before, input_digest=read)
    unfinished = Path(task.scratch, f"{os.getpid()}-{scratch_name(task)}")
    try:
        found, summary = _run(task, found, unfinished, report)
        found = moved_to_place(task, found, unfinished)
    finally:
        with suppress(OSError):
            remove(unfinished)
    _refuse_changed(task, found)
    commit(task, found, summary.finished())
    return found


def _refuse_changed(task: Task, outcome: Outcome) -> None:
    path = task.recording.path
    if path is not None and fingerprint(path) != outcome.input:
        raise SourceError(f"{path}: was changed while it was read; call again")


def _part(task: Task, blank: Outcome, report: Report) -> Outcome:
    """Run the pipeline over a part of a recording, and leave result and summary in the scratch folder."""
    unfinished = Path(task.scratch, scratch_name(task))
    if unfinished.exists():
        # Of a worker that has died.
        remove(unfinished)
    found, summary = _run(task, blank, unfinished, report)
    _refuse_changed(task, found)
    told = {"outcome": asdict(found), "ends": summary.ends, **summary.finished()}
    unfinished.with_suffix(".json").write_bytes(orjson.dumps(told))
    return found


def _run(task: Task, blank: Outcome, unfinished: Path, report: Report) -> tuple[Outcome, Summary]:
    """Run the pipeline into a file of the scratch folder."""
    summary = Summary()
    pipeline = with_looker(_for_recording(task, unfinished), summary)
    if task.part is not None:
        pipeline = of_part(pipeline, task.part)
    runner = make_runner(pipeline)

    def progress(now: Progress) -> None:
        report(now.frames, None if runner.source is None else runner.source.total)

    with _notes() as notes:
        result = runner.run(progress, interval_s=0.25)
    if result.failure is not None:
        raise result.failure
    outcome = replace(
        blank,
        status="done",
        frames=result.stats["frames"] if task.part is None else summary.frames,
        dropped=result.stats["dropped"],
        duration=summary.duration,
        contacts=summary.contacts,
        touching=summary.touching,
        largest=summary.largest,
        notes=tuple(notes),
    )
    return outcome, summary


def moved_to_place(task: Task, outcome: Outcome, unfinished: Path) -> Outcome:
    """Move a result that is whole from the scratch folder to where results are; the outcome names it."""
    written, digest = fingerprint(unfinished), digest_of(unfinished)
    name = result_name(task.recording, outcome.key, task.format)
    place = Path(task.folder, "results", name)
    if place.is_dir():
        # Of a call that ended before it could say that this is complete; no folder replaces another.
        remove(place)
    unfinished.replace(place)
    return replace(outcome, result=name, result_file=written, result_digest=digest)


def commit(task: Task, outcome: Outcome, told: Mapping[str, Any]) -> None:
    """Store what is told of a result: only what has this is complete."""
    unfinished = Path(task.scratch, f"{os.getpid()}-{outcome.key}.json")
    try:
        unfinished.write_bytes(orjson.dumps({"outcome": asdict(outcome), **told}))
        unfinished.replace(Folder(Path(task.folder)).records / f"{outcome.key}.json")
    finally:
        with suppress(OSError):
            unfinished.unlink()


def pipeline_for(request: PipelineRequest, format_: Format) -> tuple[Pipeline, str]:
    """The pipeline with one sink, that of the results, and its digest.

    A sink of that kind in the file is used as it stands there, but for where it writes.

    Raises
    ------
    ConfigError : the file is wrong, or its source is no stage that takes a `source`.
    """
    loaded = load_pipeline(Path(request.file), request.overrides, sensor=request.sensor)
    if not any(node.component.name == format_ for node in loaded.sinks):
        extra = {f"--{format_}": {"path": os.devnull}}
        loaded = load_pipeline(Path(request.file), request.overrides, extra, sensor=request.sensor)
    sink = next(node.id for node in loaded.sinks if node.component.name == format_)
    kept = {id_: n for id_, n in loaded.nodes.items() if n.component.kind != "sink" or id_ == sink}
    pipeline = replace(loaded, nodes=kept, opencv_threads=1)
    if "source" not in pipeline.source.component.params.model_fields:
        raise ConfigError(f"{pipeline.source.mark}: a batch needs a source with the parameter source")
    digest = pipeline_digest(pipeline)
    if request.split:
        digest = hashlib.sha256(f"{digest}\n{request.split!r} s, {OVERLAP} frames".encode()).hexdigest()
    return pipeline, digest


kept_pipeline_for = functools.lru_cache(maxsize=4)(pipeline_for)
"""The same for many recordings: the digest in the request tells of a file that has changed."""


def _for_recording(task: Task, path: Path) -> Pipeline:
    """The pipeline that reads this recording and writes to this path."""
    pipeline, digest = kept_pipeline_for(task.pipeline, task.format)
    if digest != task.pipeline.digest:
        # The right file may come late.
        kept_pipeline_for.cache_clear()
        here, there = versions(), dict(task.pipeline.versions)
        other = [
            f"{name} {here.get(name)} instead of {there[name]}"
            for name in there
            if here.get(name) != there[name]
        ]
        raise StageError(
            f"the worker {socket.gethostname()} would compute something else: "
            + (", ".join(other) or f"{task.pipeline.file}, or a file that it names, has changed; call again")
        )
    (sink,) = pipeline.sinks
    # Not in parts of so many seconds each: the same recording shall give the same files.
    flush = {"flush": math.inf} if task.format == "parquet" else {}
    params = sink.params.changed(path=str(path), overwrite=True, **flush)
    opened = reading(pipeline, task.recording)
    return replace(opened, nodes={**opened.nodes, sink.id: replace(sink, params=params)})


def reading(pipeline: Pipeline, recording: Recording) -> Pipeline:
    """The pipeline with a recording as its source; its settings, which results keep, say so."""
    source = pipeline.source
    wanted = {"source": recording.source, "realtime": False}
    wanted = {key: value for key, value in wanted.items() if key in type(source.params).model_fields}
    stages = dict(pipeline.settings["stages"])
    stages[source.id] = {**(stages[source.id] or {}), **wanted}
    settings = {
        **pipeline.settings,
        "stages": stages,
        "sinks": {n.component.name: {} for n in pipeline.sinks},
    }
    nodes = {**pipeline.nodes, source.id: replace(source, params=source.params.changed(**wanted), mark=_SRC)}
    return replace(pipeline, nodes=nodes, settings=settings)


def is_disk_full(error: BaseException | None) -> bool:
    """Whether that is why, however deep it lies."""
    while error is not None:
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
            return True
        error = error.__cause__ or error.__context__
    return False


class _Notes(logging.Handler):
    """Keeps the first warnings."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.texts: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        if len(self.texts) < _MOST_NOTES:
            self.texts.append(record.getMessage())


@contextmanager
def _notes() -> Iterator[list[str]]:
    """What the run warns of."""
    logger, handler = logging.getLogger("tactflow"), _Notes()
    logger.addHandler(handler)
    try:
        yield handler.texts
    finally:
        logger.removeHandler(handler)
