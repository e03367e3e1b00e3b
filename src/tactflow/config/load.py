"""Reads a pipeline file into a `Pipeline` that is known to be right, or reports every mistake in it."""

from __future__ import annotations

import inspect
import json
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

from pydantic import ValidationError

from tactflow.config import sensors, wiring
from tactflow.config.complaints import complain
from tactflow.config.files_used import FileId, file_id, files_read, files_written
from tactflow.config.models import RESERVED, Entry, PipelineFile, SinkEntry, is_word
from tactflow.config.overrides import Override, add_sinks, apply, plain, replaced
from tactflow.config.registry import Section, code_place, resolve
from tactflow.config.shipped import is_packaged
from tactflow.config.wiring import Draft
from tactflow.config.yamlmap import Item, Problems, read_yaml, wrap
from tactflow.engine.contract import Sink, StageParams
from tactflow.engine.errors import ConfigError
from tactflow.engine.graph import Gate, Mark, Node, OnError, Pipeline, Queue
from tactflow.engine.plan import plan_problems
from tactflow.system.files import expanded

_SECTIONS: tuple[Section, ...] = get_args(Section)

_NO_MEMORY = (
    "; a gate has no memory: put the stage hold behind the signal, as in "
    "held: {{use: hold, {key}: 3, in: {{signal: difference.touching}}}}, and write when: held"
)
_ADVICE = {key: _NO_MEMORY.format(key=key) for key in ("hold", "at_least_every")}


def load_pipeline(
    path: Path,
    overrides: Sequence[Override | str] = (),
    extra_sinks: Mapping[str, Mapping[str, Any]] | None = None,
    source_values: Sequence[Override] = (),
    sensor: str | None = None,
) -> Pipeline:
    """Read and check a pipeline file.

    path : the file.
    overrides : values to replace. A text is what `--set` takes: `a.b.c=VALUE`, with VALUE in YAML, null for a
        whole sink or stage removes it.
    extra_sinks : option of the command line, such as "--jsonl" -> settings of the sink it adds. The sink's id
        is the option's name, with a number if that is taken.
    source_values : parameters of the source stage to replace; their keys are names of parameters.
    sensor : which sensor of a file with `sensors:`; None is the first.

    Raises
    ------
    ConfigError : the message holds every mistake with file, line, column, source line and a caret.
    """
    problems = Problems()
    root = add_sinks(_read(path, overrides, problems), extra_sinks or {})
    root, name = sensors.select(root, sensor, problems)
    file = _envelope(root, problems)
    drafts = _drafts(root, path.parent, problems)
    source = _source(root, drafts, problems)
    if source is not None:
        _set_values(source, source_values)
    for draft in drafts:
        draft.params = _params(draft, problems)
    drafts = _one_writer_each(drafts, extra_sinks or {}, problems)
    _writes_nothing_that_is_read(drafts, path.parent, problems)
    wiring.connect(drafts, problems)
    drafts = wiring.ordered(drafts, problems)
    _check_needs(drafts, problems)
    calibration = _calibration(root, path.parent, problems)
    problems.raise_if_any()
    assert file is not None, "what is wrong with it was raised"
    entries: dict[str, Entry] = {**file.stages, **file.sinks}
    pipeline = Pipeline(
        file=str(path),
        directory=path.parent,
        sensor=name,
        nodes={draft.id: _node(draft, entries[draft.id]) for draft in drafts},
        skipping=file.skipping,
        opencv_threads=file.opencv_threads,
        realtime_priority=file.realtime_priority,
        runs=max(1, len(sensors.names(root))),
        calibration=calibration,
        warnings=_warnings(root, drafts),
        settings=_settings(root, name, drafts),
    )
    for mark, message in plan_problems(pipeline):
        problems.add(mark, message)
    problems.raise_if_any()
    return pipeline


def sensor_names(path: Path, overrides: Sequence[Override | str] = ()) -> list[str]:
    """The sensors under `sensors:` of a pipeline file, in order; empty if it has no such key.

    Raises
    ------
    ConfigError : the file is no YAML mapping, or an override cannot be applied.
    """
    problems = Problems()
    root = _read(path, overrides, problems)
    problems.raise_if_any()
    return sensors.names(root)


def _read(path: Path, overrides: Sequence[Override | str], problems: Problems) -> Item:
    """The document with its overrides."""
    root = read_yaml(path, problems)
    if root.content is None:
        problems.add(root.mark, "the file is empty; required: a mapping with sensor, stages and sinks")
    elif not isinstance(root.content, dict):
        problems.add(root.mark, f"expected a mapping with sensor, stages and sinks, got {root.words()}")
    if not isinstance(root.content, dict):
        problems.raise_if_any()
    for override in overrides:
        root = apply(root, override, problems)
    return root


def _envelope(root: Item, problems: Problems) -> PipelineFile | None:
    """The file as its model describes it; None if something in it is wrong."""
    try:
        return PipelineFile.model_validate(root.plain())
    except ValidationError as error:
        complain(error, PipelineFile, root, "", problems, advice=_misplaced(root) | _ADVICE)
        return None


def _misplaced(root: Item) -> dict[str, str]:
    """For each stage and sink of the file, as if it stood beside `stages`: where it belongs."""
    ids = {
        id_: section
        for section in _SECTIONS
        if section in root.entries
        for id_ in root.entries[section].item.entries
    }
    return {id_: f"; did you mean {section}.{id_}?" for id_, section in ids.items()}


def _drafts(root: Item, directory: Path, problems: Problems) -> list[Draft]:
    """The stages and sinks of the file; what `_envelope` refuses of them is left out here."""
    drafts: dict[str, Draft] = {}
    for section in _SECTIONS:
        entries = root.entries[section].item.entries if section in root.entries else {}
        for id_, entry in entries.items():
            item = entry.item if entry.item.is_mapping else Item(None, entry.mark)
            draft = Draft(id_, section, entry.mark, item)
            if id_ in drafts:
                other = drafts[id_]
                taken = f"the id {id_} is taken by {other.path} ({other.mark})"
                problems.add(draft.mark, f"{draft.path}: {taken}")
            elif is_word(id_):
                drafts[id_] = draft
                _resolve(draft, directory, problems)
    return list(drafts.values())


def _resolve(draft: Draft, directory: Path, problems: Problems) -> None:
    entry = draft.item.entries.get("use")
    use = draft.id if entry is None else entry.item.content
    if not isinstance(use, str):
        return
    # On the command line, and in a pipeline that nobody can put a file beside, it means the current folder.
    own = is_packaged(directory) or (entry is not None and not entry.item.mark.line)
    try:
        draft.component = resolve(use, draft.section, *([Path()] if own else []), directory)
    except ConfigError as error:
        mark, path = (draft.mark, draft.path) if entry is None else (entry.item.mark, f"{draft.path}.use")
        problems.add(mark, f"{path}: {error}")


def _source(root: Item, drafts: Sequence[Draft], problems: Problems) -> Draft | None:
    """The source of frames; that there is none, or more than one, is a mistake."""
    stages = [draft for draft in drafts if draft.section == "stages"]
    sources = [draft for draft in stages if draft.component and draft.component.kind == "source"]
    entry = root.entries.get("stages")
    if not sources and entry and entry.item.is_mapping and all(draft.component for draft in stages):
        problems.add(entry.mark, "stages: there is no source of frames; add the stage capture")
    for other in sources[1:]:
        first = f"{sources[0].id} ({sources[0].mark})"
        problems.add(other.mark, f"{other.path}: a pipeline has one source, but {first} is one already")
    return sources[0] if sources else None


def _set_values(draft: Draft, values: Sequence[Override]) -> None:
    """Replace parameters of a stage."""
    for override in values:
        mark = Mark(override.origin, 0, 0)
        draft.item = replaced(draft.item, [override.key], wrap(plain(override.value), mark), mark)


def _params(draft: Draft, problems: Problems) -> StageParams | None:
    """What the component's own model makes of the parameters; None if it refuses them."""
    if draft.component is None:
        return None
    model = draft.component.params
    keys = {key for key in RESERVED if key != "max_rate" or draft.section == "sinks"}
    given = {key: entry for key, entry in draft.item.entries.items() if key not in keys}
    strange = [entry.item for entry in given.values() if not _is_text(entry.item.plain())]
    for item in strange:
        problems.add(item.mark, f"{draft.path}: {item.plain()!r} is not UTF-8; rename the file")
    if strange:
        return None
    whole = Item(given, draft.mark)
    try:
        # JSON, because pydantic's strict rules for it fit YAML too: a list may become a tuple, but text or a
        # boolean never becomes a number.
        return model.model_validate_json(json.dumps(whole.plain()), strict=True)
    except ValidationError as error:
        complain(error, model, whole, draft.path, problems, noun="parameter", other_keys=sorted(keys))
    except Exception as error:
        reason = f"{type(error).__name__}: {error} ({code_place(error.__traceback__)})"
        problems.add(draft.mark, f"{draft.path}: the parameters fail: {reason}")
    return None


def _is_text(value: Any) -> bool:
    """False for a name of a file that no encoding can write, as the command line may pass it."""
    try:
        json.dumps(value, ensure_ascii=False, default=str).encode()
    except UnicodeEncodeError:
        return False
    return True


def _one_writer_each(drafts: Sequence[Draft], options: Collection[str], problems: Problems) -> list[Draft]:
    """The drafts without those that an option adds for a file that is written anyway, just as it asks.

    Any other two sinks that would write the same file are a mistake.
    """
    kept: list[Draft] = []
    writers: dict[str, Draft] = {}
    for draft in drafts:
        places = _written(draft)
        place = next((place for place in places if place in writers), None)
        other = writers[place] if place is not None else None
        if other and draft.mark.file in options and _does_as_much(other, draft):
            continue
        kept.append(draft)
        if other:
            there = f"{other.id} ({other.mark}) writes {place} already; choose another path"
            problems.add(draft.mark, f"{draft.path}: {there}")
        writers |= {place: draft for place in places if place not in writers}
    return kept


def _writes_nothing_that_is_read(drafts: Sequence[Draft], directory: Path, problems: Problems) -> None:
    """Report sinks that would write over what a stage reads: its source, a reference, a calibration."""
    readers: dict[FileId, Draft] = {}
    for draft in drafts:
        if draft.section == "stages" and draft.params is not None:
            readers |= dict.fromkeys(files_read(draft.params, directory), draft)
    for draft in drafts:
        for place in _written(draft):
            reader = readers.get(identity) if (identity := file_id(place)) else None
            if reader is not None:
                there = f"{place} is what {reader.path} reads; choose another path"
                problems.add(draft.mark, f"{draft.path}: {there}")


def _calibration(root: Item, directory: Path, problems: Problems) -> Path | None:
    """The calibration file that the pipeline names; that it is not there is a mistake."""
    entry = root.entries.get("calibration")
    if entry is None or not isinstance(entry.item.content, str):
        return None
    named = expanded(entry.item.content)
    paths = (directory / named, named)
    for path in paths:
        if path.is_file():
            return path
    looked = " or ".join(dict.fromkeys(str(path.absolute()) for path in paths))
    problems.add(entry.item.mark, f"calibration: there is no file {looked}; `tactflow calibrate` makes one")
    return None


def _does_as_much(there: Draft, added: Draft) -> bool:
    """Whether a sink writes all that one without settings of its own would write."""
    if there.component is None or added.component is None:
        return False
    return there.component.cls is added.component.cls and "max_rate" not in there.item.entries


def _written(draft: Draft) -> list[str]:
    """The files and folders that a sink writes, as far as it is known to be one."""
    if draft.component is None or draft.params is None:
        return []
    return files_written(draft.component.cls, draft.params)


def _check_needs(drafts: Sequence[Draft], problems: Problems) -> None:
    """Report parameters that need an input which is not connected."""
    if problems.found:
        # Another mistake may be why it is not connected.
        return
    for draft in drafts:
        for port, name in draft.params.needed_inputs().items() if draft.params else ():
            if draft.inputs.get(port) is None:
                entry = draft.item.entries.get(name)
                what = f"{getattr(draft.params, name)} needs {port}, which no stage gives"
                problems.add(
                    entry.item.mark if entry else draft.mark,
                    f"{draft.path}.{name}: {what}; add a stage that does",
                )


def _node(draft: Draft, entry: Entry) -> Node:
    """The node that a right draft describes."""
    assert draft.component is not None, "a stage without one was reported"
    assert draft.params is not None, "parameters that are wrong were reported"
    cls, entries = draft.component.cls, draft.item.entries
    # A picture for people must never stop the run.
    on_error = OnError("disable" if issubclass(cls, Sink) and cls.observer else "stop")
    if entry.on_error:
        on_error = OnError(entry.on_error.action, entry.on_error.budget)
    # What the command line makes it read may not be there: then the file is not to blame.
    read = entries.get("source") if draft.component.kind == "source" else None
    mark = read.item.mark if read and not read.item.mark.line else draft.mark
    gates = [
        Gate(ref, gate.reason or signal.closed or ref.port, gate.otherwise or signal.otherwise)
        for gate, (ref, signal) in zip(entry.when, draft.gates, strict=True)
    ]
    return Node(
        id=draft.id,
        component=draft.component,
        params=draft.params,
        inputs=draft.inputs,
        mark=mark,
        gates=tuple(gates),
        segment=entry.segment,
        queue=Queue(entry.queue.capacity, entry.queue.when_full),
        on_error=on_error,
        max_rate=entry.max_rate if isinstance(entry, SinkEntry) else None,
        marks={key: entries[key].item.mark for key in ("segment", "queue") if key in entries},
    )


def _settings(root: Item, sensor: str, drafts: Sequence[Draft]) -> dict[str, Any]:
    """What the file and all that changes it come to, for one sensor."""
    sections = {
        section: {draft.id: draft.item.plain() for draft in drafts if draft.section == section}
        for section in _SECTIONS
    }
    plain = {key: entry.item.plain() for key, entry in root.entries.items() if key != "sensors"}
    return plain | {"sensor": sensor} | sections


def _warnings(root: Item, drafts: Sequence[Draft]) -> list[str]:
    warnings = []
    if not any(draft.section == "sinks" for draft in drafts):
        entry = root.entries.get("sinks")
        mark = entry.mark if entry else root.mark
        warnings.append(f"{mark}  there are no sinks, so nothing will be computed")
    calibration = root.entries.get("calibration")
    users = (draft.component.cls for draft in drafts if draft.component)
    if calibration and calibration.item.content and not any(map(_takes_calibration, users)):
        warnings.append(f"{calibration.mark}  calibration: no stage uses it; add untouched, scale and depth")
    return warnings


def _takes_calibration(cls: type) -> bool:
    """Whether the constructor of a stage asks for the calibration."""
    return "calibration" in inspect.signature(cls).parameters
