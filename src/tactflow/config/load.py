"""Reads a pipeline file into a validated `Pipeline`, or reports all errors in it."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

from tactflow.calibration import KINDS, kinds
from tactflow.config import sensors, wiring
from tactflow.config.document import Document, described, dotted, read_document
from tactflow.config.files_used import files_named, files_written
from tactflow.config.models import RESERVED, Entry, PipelineFile, SinkEntry, is_word
from tactflow.config.overrides import Override, add_sinks, apply
from tactflow.config.registry import Section, code_place, resolve
from tactflow.config.shipped import is_packaged
from tactflow.config.validation import validate
from tactflow.config.wiring import Draft
from tactflow.engine.conformance import accepts, configured, declares
from tactflow.engine.contract import StageParams
from tactflow.engine.errors import ConfigError
from tactflow.engine.graph import Node, OnError, Pipeline
from tactflow.engine.plan import plan_problem
from tactflow.system.files import expanded

_SECTIONS: tuple[Section, ...] = get_args(Section)


def load_pipeline(
    path: Path,
    overrides: Sequence[Override | str] = (),
    extra_sinks: Mapping[str, Mapping[str, Any]] | None = None,
    source_values: Sequence[Override] = (),
    sensor: str | None = None,
) -> Pipeline:
    """Read and check a pipeline file.

    path : the file.
    overrides : values to replace. A text is an argument of `--set`: `a.b.c=VALUE`, with VALUE in YAML; null
        for a whole sink or stage removes it.
    extra_sinks : option of the command line, such as "--jsonl" -> settings of the sink it adds. The sink's id
        is the name of the option, with a number if necessary.
    source_values : parameters of the source stage to replace, by the name of the parameter.
    sensor : name of a sensor under `sensors:`; None is the first.

    Raises
    ------
    ConfigError : all errors with file, line, column, source line and caret.
    """
    document = _read(path, overrides)
    add_sinks(document, extra_sinks or {})
    name = sensors.select(document, sensor)
    file = validate(PipelineFile, document)
    drafts = _drafts(document, path.parent)
    source = _source(document, drafts)
    if source is not None:
        for override in source_values:
            apply(document, override, source.keys)
    for draft in drafts:
        _configure(draft, document)
    calibration = _calibration(document, path.parent)
    _check_files(drafts, path, calibration, document)
    wiring.connect(drafts, document)
    drafts = wiring.ordered(drafts, document)
    _check_needs(drafts, document)
    document.raise_if_mistaken()
    assert file is not None, "its mistakes were raised"
    entries: dict[str, Entry] = {**file.stages, **file.sinks}
    pipeline = Pipeline(
        file=str(path),
        directory=path.parent,
        sensor=name,
        nodes={draft.id: _node(draft, entries[draft.id], document) for draft in drafts},
        skipping=file.skipping,
        opencv_threads=file.opencv_threads,
        calibration=calibration,
        warnings=_warnings(document, drafts),
        settings=_settings(document, name, drafts),
    )
    problem = plan_problem(pipeline)
    if problem is not None:
        document.report_at(*problem)
    document.raise_if_mistaken()
    return pipeline


def sensor_names(path: Path, overrides: Sequence[Override | str] = ()) -> list[str]:
    """The names under `sensors:` of a pipeline file, in order; empty without that key.

    Raises
    ------
    ConfigError : the file is not a YAML mapping, or an override cannot be applied.
    """
    document = _read(path, overrides)
    document.raise_if_mistaken()
    return sensors.names(document)


def _read(path: Path, overrides: Sequence[Override | str]) -> Document:
    """Read the document and apply overrides."""
    document = read_document(path)
    if not isinstance(document.root, dict):
        is_empty = document.root is None
        problem = "the file is empty" if is_empty else f"expected a mapping, got {described(document.root)}"
        document.report((), f"{problem}; required: a mapping with sensor, stages and sinks")
        document.raise_if_mistaken()
    for override in overrides:
        apply(document, override)
    return document


def _drafts(document: Document, directory: Path) -> list[Draft]:
    """The stages and sinks of the file with valid ids."""
    drafts: dict[str, Draft] = {}
    for section in _SECTIONS:
        for id_ in document.mapping(section):
            draft = Draft(id_, section, document.mark(section, id_))
            if id_ in drafts:
                first = drafts[id_]
                taken = f"the id {id_} is taken by {dotted(first.keys)} ({first.mark})"
                document.report(draft.keys, taken)
            elif is_word(id_):
                drafts[id_] = draft
                _resolve(draft, directory, document)
    return list(drafts.values())


def _resolve(draft: Draft, directory: Path, document: Document) -> None:
    """Find the class of a stage or sink."""
    settings = document.mapping(*draft.keys)
    place = (*draft.keys, "use") if "use" in settings else draft.keys
    use = settings.get("use", draft.id)
    if not isinstance(use, str):
        return
    # For the command line and packaged pipelines, a loose file is relative to the current folder.
    is_option = "use" in settings and not document.mark(*place).line
    folders = [Path(), directory] if is_option or is_packaged(directory) else [directory]
    try:
        draft.component = resolve(use, draft.section, *folders)
    except ConfigError as error:
        document.report(place, str(error))


def _source(document: Document, drafts: Sequence[Draft]) -> Draft | None:
    """The source of frames; none, or several of them, are an error."""
    stages = [draft for draft in drafts if draft.section == "stages"]
    sources = [draft for draft in stages if draft.component and draft.component.kind == "source"]
    readable = document.has("stages") and isinstance(document.get("stages"), dict | None)
    if not sources and readable and all(draft.component for draft in stages):
        document.report(("stages",), "there is no source of frames; add the stage capture")
    for extra in sources[1:]:
        first = f"{sources[0].id} ({sources[0].mark})"
        document.report(extra.keys, f"a pipeline has one source, but {first} is one already")
    return sources[0] if sources else None


def _configure(draft: Draft, document: Document) -> None:
    """Validate the parameters of a stage or sink, and determine the ports that depend on them."""
    draft.params = _params(draft, document)
    if draft.component is not None and draft.params is not None:
        draft.component = configured(draft.component, draft.params)
    elif draft.component is not None and declares(draft.component.cls):
        # Its ports are unknown, so do not report errors of its connections.
        draft.component = None


def _params(draft: Draft, document: Document) -> StageParams | None:
    """The parameters as the model of the component; None if they are invalid."""
    if draft.component is None:
        return None
    reserved = {key for key in RESERVED if key != "max_rate" or draft.section == "sinks"}
    try:
        defaults = ("gel",) if draft.section == "stages" else ()
        return validate(
            draft.component.params,
            document,
            draft.keys,
            without=reserved,
            defaults=defaults,
            noun="parameter",
        )
    except Exception as error:
        reason = f"{type(error).__name__}: {error} ({code_place(error.__traceback__)})"
        document.report(draft.keys, f"the parameters fail: {reason}")
    return None


def _check_files(
    drafts: Sequence[Draft], pipeline: Path, calibration: Path | None, document: Document
) -> None:
    """Report sinks that write the same file, or a file that the run reads."""
    users = {os.path.realpath(pipeline): "is the pipeline file"}
    if calibration:
        users[os.path.realpath(calibration)] = "is the calibration"
    for draft in drafts:
        if draft.section == "stages" and draft.params is not None:
            reads = f"is what {dotted(draft.keys)} reads"
            users |= {os.path.realpath(path): reads for path in files_named(draft.params, pipeline.parent)}
    for draft in drafts:
        if draft.component is not None and draft.params is not None:
            for path in files_written(draft.component.cls, draft.params):
                if path in users:
                    message = f"{path} {users[path]}; choose another path"
                    document.report(draft.keys, message)
                users[path] = f"is written by {draft.id} ({draft.mark})"


def _calibration(document: Document, directory: Path) -> Path | None:
    """The calibration file named by the pipeline, or the default of a kind of sensor; reports a missing
    one."""
    name = document.get("calibration")
    if not isinstance(name, str):
        return None
    paths = (directory / expanded(name), expanded(name))
    for path in paths:
        if path.is_file():
            return path
    if name in kinds():
        return KINDS / f"{name}.yaml"
    looked = " or ".join(dict.fromkeys(str(path.absolute()) for path in paths))
    advice = f"`tactflow calibrate` makes one, and tactflow has those of {', '.join(kinds())}"
    document.report(("calibration",), f"there is no file {looked}; {advice}")
    return None


def _check_needs(drafts: Sequence[Draft], document: Document) -> None:
    """Report parameters that require an unconnected input."""
    if document.mistakes:
        # Another error may be the cause.
        return
    for draft in drafts:
        for port, name in draft.params.needed_inputs().items() if draft.params else ():
            if draft.inputs.get(port) is None:
                problem = f"{getattr(draft.params, name)} needs {port}, which no stage gives"
                place = (*draft.keys, name)
                document.report(place, f"{problem}; add a stage that does")


def _node(draft: Draft, entry: Entry, document: Document) -> Node:
    """The node of a valid draft."""
    assert draft.component is not None, "a stage without one was reported"
    assert draft.params is not None, "parameters that are wrong were reported"
    # A viewer must never stop the run.
    default = OnError(action="disable" if draft.component.delivery.observer else "stop")
    mark = draft.mark
    if draft.component.kind == "source" and not (origin := document.mark(*draft.keys, "source")).line:
        # A source of the command line that cannot be opened is not an error in the file.
        mark = origin
    return Node(
        id=draft.id,
        component=draft.component,
        params=draft.params,
        inputs=draft.inputs,
        mark=mark,
        gates=tuple(draft.gates),
        segment=entry.segment,
        queue=entry.queue,
        on_error=entry.on_error or default,
        max_rate=entry.max_rate if isinstance(entry, SinkEntry) else None,
    )


def _settings(document: Document, sensor: str, drafts: Sequence[Draft]) -> dict[str, Any]:
    """The values of the file with all overrides, for a sensor."""
    sections: dict[str, dict[str, Any]] = {section: {} for section in _SECTIONS}
    for draft in drafts:
        sections[draft.section][draft.id] = document.get(*draft.keys)
    kept = {key: value for key, value in document.root.items() if key != "sensors"}
    return kept | {"sensor": sensor} | sections


def _warnings(document: Document, drafts: Sequence[Draft]) -> list[str]:
    warnings = []
    if not any(draft.section == "sinks" for draft in drafts):
        warnings.append(f"{document.mark('sinks')}  there are no sinks, so nothing will be computed")
    users = (draft.component.make for draft in drafts if draft.component)
    if document.get("calibration") and not any(accepts(make, "calibration") for make in users):
        mark = document.mark("calibration")
        warnings.append(f"{mark}  calibration: no stage uses it; add untouched, scale and depth")
    return warnings
