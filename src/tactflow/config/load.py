"""Reads a pipeline file into a `Pipeline` that is known to be right, or reports every mistake in it."""

from __future__ import annotations

import json
import os
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

from pydantic import ValidationError

from tactflow.config import envelope, sensors, wiring
from tactflow.config.complaints import complain
from tactflow.config.registry import RESERVED, Section, code_place, did_you_mean, resolve
from tactflow.config.wiring import Draft
from tactflow.config.yamlmap import Entry, Item, Problems, read_value, read_yaml, wrap
from tactflow.engine.contract import Sink, StageParams
from tactflow.engine.errors import ConfigError
from tactflow.engine.graph import ErrorAction, FullPolicy, Mark, Node, OnError, Pipeline, Queue
from tactflow.engine.plan import plan_problems
from tactflow.files import is_device

TOP_LEVEL = ("sensor", "sensors", "skipping", "opencv_threads", "realtime_priority", "stages", "sinks")
_SECTIONS: tuple[Section, ...] = get_args(Section)


def load_pipeline(
    path: Path,
    overrides: Sequence[str] = (),
    extra_sinks: Mapping[str, Mapping[str, Any]] | None = None,
    extra_stage_values: Mapping[str, Mapping[str, Any]] | None = None,
    source_values: Mapping[str, Any] | None = None,
    sensor: str | None = None,
) -> Pipeline:
    """Read and check a pipeline file.

    path : the file.
    overrides : `a.b.c=VALUE` as given to `--set`; VALUE is YAML, null for a whole sink or stage removes it.
    extra_sinks : option of the command line, such as "--jsonl" -> settings of the sink it adds. The sink's id
        is the option's name, with a number if that is taken.
    extra_stage_values : stage id -> parameters that replace those of the file.
    source_values : parameters of the source stage, as `--NAME` on the command line sets them.
    sensor : which sensor of a file with `sensors:`; None is the first.

    Raises
    ------
    ConfigError : the message holds every mistake with file, line, column, source line and a caret.
    """
    problems = Problems()
    root = _read(path, overrides, problems)
    root = _add_sinks(root, extra_sinks or {})
    envelope.check_keys(root.entries, TOP_LEVEL, "", problems)
    runs = max(1, len(sensors.names(root)))
    root, name = sensors.select(root, sensor, problems)
    drafts = [draft for section in _SECTIONS for draft in _drafts(root, section, problems)]
    _check_ids(drafts, problems)
    for draft in drafts:
        _resolve(draft, path.parent, problems)
    source = _source(root, drafts, problems)
    values = {id_: dict(given) for id_, given in (extra_stage_values or {}).items()}
    if source is not None:
        values.setdefault(source.id, {}).update(source_values or {})
    _set_values(drafts, values, problems)
    params = {draft.id: _params(draft, problems) for draft in drafts}
    drafts = _one_writer_each(drafts, params, extra_sinks or {}, problems)
    wiring.connect(drafts, problems)
    nodes: dict[str, Node] = {}
    for draft in wiring.ordered(drafts, problems):
        node = _node(draft, params[draft.id], problems)
        if node is not None:
            nodes[draft.id] = node
    pipeline = Pipeline(
        file=str(path),
        directory=path.parent,
        sensor=name,
        nodes=nodes,
        skipping=_flag(root.entries, "skipping", True, problems),
        opencv_threads=envelope.whole(root.entries, "opencv_threads", 0, "", problems),
        realtime_priority=_flag(root.entries, "realtime_priority", False, problems),
        runs=runs,
        warnings=_warnings(root, drafts),
        settings=_settings(root, name, drafts),
    )
    problems.raise_if_any()
    for mark, message in plan_problems(pipeline):
        problems.add(mark, message)
    problems.raise_if_any()
    return pipeline


def sensor_names(path: Path, overrides: Sequence[str] = ()) -> list[str]:
    """The sensors under `sensors:` of a pipeline file, in order; empty if it has no such key.

    Raises
    ------
    ConfigError : the file is no YAML mapping, or an override cannot be applied.
    """
    problems = Problems()
    root = _read(path, overrides, problems)
    problems.raise_if_any()
    return sensors.names(root)


def _read(path: Path, overrides: Sequence[str], problems: Problems) -> Item:
    """The document with its overrides."""
    root = read_yaml(path, problems)
    if root.content is None:
        problems.add(root.mark, "the file is empty; required: a mapping with sensor, stages and sinks")
    elif not isinstance(root.content, dict):
        problems.add(root.mark, f"expected a mapping with sensor, stages and sinks, got {root.words()}")
    if not isinstance(root.content, dict):
        problems.raise_if_any()
    for text in overrides:
        root = _override(root, text, problems)
    return root


def _override(root: Item, text: str, problems: Problems) -> Item:
    mark = Mark(f"--set {text}", 0, 0)
    path, equals, value_text = text.partition("=")
    keys = [key.strip() for key in path.split(".")]
    if not equals or not all(keys):
        problems.add(mark, "expected a.b.c=VALUE, as in stages.hull.min_area=50")
        return root
    value = read_value(value_text, mark, problems)
    if value is None:
        return root
    if value.content is None and len(keys) == 2 and keys[0] in _SECTIONS:
        return _remove(root, keys[0], keys[1], mark, problems)
    try:
        return _replaced(root, keys, value, mark)
    except ConfigError as error:
        problems.add(mark, str(error))
        return root


def _remove(root: Item, section: str, id_: str, mark: Mark, problems: Problems) -> Item:
    held = root.entries.get(section)
    entries = dict(held.item.entries) if held else {}
    if held is None or id_ not in entries:
        problems.add(mark, f"there is no {section[:-1]} {id_!r} to remove{did_you_mean(id_, entries)}")
        return root
    del entries[id_]
    content = root.entries | {section: Entry(held.mark, Item(entries, held.item.mark))}
    return Item(content, root.mark)


def _replaced(item: Item | None, keys: Sequence[str], value: Item, mark: Mark, path: str = "") -> Item:
    """A copy of `item` in which one value is replaced; parts that an alias shares stay as they are."""
    if not keys:
        return value
    key, rest = keys[0], keys[1:]
    inner = f"{path}.{key}" if path else key
    if item is not None and isinstance(item.content, list):
        if not key.isdecimal() or int(key) >= len(item.content):
            raise ConfigError(f"{path} is a list with {len(item.content)} items, counted from 0")
        parts = list(item.content)
        parts[int(key)] = _replaced(parts[int(key)], rest, value, mark, inner)
        return Item(parts, item.mark)
    if item is not None and not item.is_mapping:
        raise ConfigError(f"{path} is {item.words()}, so it has no {key}")
    entries = dict(item.entries) if item else {}
    old = entries.get(key)
    entries[key] = Entry(
        old.mark if old else mark, _replaced(old.item if old else None, rest, value, mark, inner)
    )
    return Item(entries, item.mark if item else mark)


def _add_sinks(root: Item, extra: Mapping[str, Mapping[str, Any]]) -> Item:
    for option, settings in extra.items():
        wanted = option.lstrip("-")
        mark = Mark(f"--{wanted}", 0, 0)
        taken = {
            id_
            for section in _SECTIONS
            if section in root.entries
            for id_ in root.entries[section].item.entries
        }
        count = 2
        id_ = wanted
        while id_ in taken:
            id_ = f"{wanted}_{count}"
            count += 1
        root = _replaced(root, ["sinks", id_], wrap({"use": wanted} | dict(settings), mark), mark)
    return root


def _one_writer_each(
    drafts: Sequence[Draft],
    params: Mapping[str, StageParams | None],
    options: Collection[str],
    problems: Problems,
) -> list[Draft]:
    """The drafts without those that an option adds for a file that is written anyway, just as it asks.

    Any other two sinks that would write the same file are a mistake.
    """
    kept: list[Draft] = []
    writers: dict[str, Draft] = {}
    for draft in drafts:
        place = _written(draft, params.get(draft.id))
        other = None if place is None else writers.setdefault(place, draft)
        if other is None or other is draft:
            kept.append(draft)
        elif draft.mark.file not in options or not _does_as_much(other, draft):
            kept.append(draft)
            problems.add(
                draft.mark,
                f"sinks.{draft.id}: {other.id} ({other.mark}) writes {place} already; choose another path",
            )
    return kept


def _does_as_much(there: Draft, added: Draft) -> bool:
    """Whether a sink writes all that one without settings of its own would write."""
    if there.component is None or added.component is None:
        return False
    return there.component.cls is added.component.cls and "max_rate" not in there.item.entries


def _written(draft: Draft, params: StageParams | None) -> str | None:
    """The file or folder that a sink writes, however it is spelled; None for what is not one."""
    cls = draft.component.cls if draft.component else None
    declared = cls.outputs(params) if cls is not None and issubclass(cls, Sink) and params is not None else ()
    for output in declared:
        # No file has a name with NUL; the sink will say so.
        if "\0" not in str(output.path) and not is_device(str(output.path)):
            return os.path.realpath(output.path)
    return None


def _drafts(root: Item, section: Section, problems: Problems) -> list[Draft]:
    entry = root.entries.get(section)
    if entry is None:
        return []
    if not entry.item.is_mapping:
        what = f"expected a mapping of id -> {section[:-1]}, got {entry.item.words()}"
        problems.add(entry.item.mark, f"{section}: {what}")
        return []
    drafts = []
    for id_, given in entry.item.entries.items():
        if not envelope.is_word(id_):
            problems.add(given.mark, f"{section}.{id_}: an id is a word of letters, digits, _ and -")
        elif not given.item.is_mapping:
            what = f"expected a mapping of settings, as in {{use: {id_}}}, got {given.item.words()}"
            problems.add(given.item.mark, f"{section}.{id_}: {what}")
            drafts.append(Draft(id_, section, given.mark, Item(None, given.mark)))
        else:
            drafts.append(Draft(id_, section, given.mark, given.item))
    return drafts


def _check_ids(drafts: list[Draft], problems: Problems) -> None:
    seen: dict[str, Draft] = {}
    for draft in list(drafts):
        if draft.id in seen:
            other = seen[draft.id]
            problems.add(
                draft.mark, f"{draft.path}: the id {draft.id} is taken by {other.path} ({other.mark})"
            )
            drafts.remove(draft)
        seen.setdefault(draft.id, draft)


def _resolve(draft: Draft, directory: Path, problems: Problems) -> None:
    entry = draft.item.entries.get("use")
    use: Any = draft.id if entry is None else entry.item.content
    mark = draft.mark if entry is None else entry.item.mark
    if entry is not None and not isinstance(use, str):
        problems.add(
            mark, f"{draft.path}.use: expected the name of a {draft.section[:-1]}, got {entry.item.words()}"
        )
        return
    try:
        draft.component = resolve(use, draft.section, directory)
    except ConfigError as error:
        problems.add(mark, f"{draft.path}{'.use' if entry else ''}: {error}")


def _source(root: Item, drafts: Sequence[Draft], problems: Problems) -> Draft | None:
    entry = root.entries.get("stages")
    if entry is None:
        problems.add(root.mark, "stages is missing; it is a mapping of id -> stage and begins with a source")
        return None
    stages = [draft for draft in drafts if draft.section == "stages"]
    sources = [draft for draft in stages if draft.component and draft.component.kind == "source"]
    if not sources and entry.item.is_mapping and all(draft.component for draft in stages):
        problems.add(entry.mark, "stages: there is no source of frames; add the stage capture")
    for other in sources[1:]:
        first = sources[0]
        problems.add(
            other.mark,
            f"{other.path}: a pipeline has one source, but {first.id} ({first.mark}) is one already",
        )
    return sources[0] if sources else None


def _set_values(drafts: Sequence[Draft], values: Mapping[str, Mapping[str, Any]], problems: Problems) -> None:
    by_id = {draft.id: draft for draft in drafts}
    for id_, given in values.items():
        for name, value in given.items():
            mark = Mark(f"--{name.replace('_', '-')}", 0, 0)
            if id_ not in by_id:
                problems.add(mark, f"there is no stage {id_!r}{did_you_mean(id_, by_id)}")
                continue
            draft = by_id[id_]
            draft.item = _replaced(draft.item, [name], wrap(value, mark), mark)


def _keys(section: Section) -> frozenset[str]:
    return RESERVED if section == "sinks" else RESERVED - {"max_rate"}


def _params(draft: Draft, problems: Problems) -> StageParams | None:
    if draft.component is None:
        return None
    keys = _keys(draft.section)
    given = {key: entry for key, entry in draft.item.entries.items() if key not in keys}
    item = Item(given, draft.mark)
    model = draft.component.params
    strange = [entry for entry in given.values() if not _is_text(entry.item.plain())]
    for entry in strange:
        problems.add(entry.item.mark, f"{draft.path}: {entry.item.plain()!r} is not UTF-8; rename the file")
    if strange:
        return None
    try:
        # JSON, because pydantic's strict rules for it fit YAML too: a list may become a tuple, but text or a
        # boolean never becomes a number.
        return model.model_validate_json(json.dumps(item.plain()), strict=True)
    except ValidationError as error:
        complain(error, model, item, draft.path, sorted(keys), problems)
    except Exception as error:
        place = code_place(error.__traceback__)
        problems.add(
            draft.mark, f"{draft.path}: the parameters fail: {type(error).__name__}: {error} ({place})"
        )
    return None


def _is_text(value: Any) -> bool:
    """False for a name of a file that no encoding can write, as the command line may pass it."""
    try:
        json.dumps(value, ensure_ascii=False, default=str).encode()
    except UnicodeEncodeError:
        return False
    return True


def _node(draft: Draft, params: StageParams | None, problems: Problems) -> Node | None:
    entries, path = draft.item.entries, draft.path
    queue = _queue(entries, path, problems)
    on_error = _on_error(draft, problems)
    segment = envelope.word(entries, "segment", path, problems)
    max_rate = _max_rate(entries, path, problems) if draft.section == "sinks" else None
    if draft.component is None or params is None:
        return None
    # Another mistake may be why an input is not connected.
    for port, name in {} if problems.found else params.needed_inputs().items():
        if draft.inputs.get(port) is None:
            mark = entries[name].item.mark if name in entries else draft.mark
            value = getattr(params, name)
            problems.add(
                mark, f"{path}.{name}: {value} needs {port}, which no stage gives; add a stage that does"
            )
    return Node(
        id=draft.id,
        component=draft.component,
        params=params,
        inputs=draft.inputs,
        mark=draft.mark,
        gates=tuple(draft.gates),
        segment=segment,
        queue=queue,
        on_error=on_error,
        max_rate=max_rate,
        marks={key: entries[key].item.mark for key in ("segment", "queue") if key in entries},
    )


def _queue(entries: Mapping[str, Entry], path: str, problems: Problems) -> Queue:
    entry = entries.get("queue")
    if entry is None:
        return Queue()
    path = f"{path}.queue"
    if not entry.item.is_mapping:
        what = f"expected a mapping, as in {{capacity: 4, when_full: block}}, got {entry.item.words()}"
        problems.add(entry.item.mark, f"{path}: {what}")
        return Queue()
    settings = entry.item.entries
    envelope.check_keys(settings, ["capacity", "when_full"], path, problems)
    policies: tuple[FullPolicy, ...] = get_args(FullPolicy)
    name = envelope.choice(settings, "when_full", policies, path, problems)
    policy = next((known for known in policies if known == name), None)
    return Queue(envelope.whole(settings, "capacity", 1, path, problems), policy)


def _on_error(draft: Draft, problems: Problems) -> OnError:
    actions: tuple[ErrorAction, ...] = get_args(ErrorAction)
    entry = draft.item.entries.get("on_error")
    if entry is None:
        # A picture for people must never stop the run.
        observer = draft.component is not None and getattr(draft.component.cls, "observer", False)
        return OnError("disable" if observer else "stop")
    path = f"{draft.path}.on_error"
    if isinstance(entry.item.content, dict):
        settings = entry.item.content
        envelope.check_keys(settings, ["action", "budget"], path, problems)
        name = envelope.choice(settings, "action", actions, path, problems)
        budget = envelope.whole(settings, "budget", 0, path, problems)
    else:
        name = envelope.choice({"on_error": entry}, "on_error", actions, draft.path, problems)
        budget = None
    action: ErrorAction = next((known for known in actions if known == name), "stop")
    return OnError(action) if budget is None else OnError(action, budget)


def _max_rate(entries: Mapping[str, Entry], path: str, problems: Problems) -> float | None:
    entry = entries.get("max_rate")
    if entry is None or entry.item.content is None:
        return None
    value = entry.item.content
    if isinstance(value, int | float) and not isinstance(value, bool) and 0 < value < float("inf"):
        return float(value)
    problems.add(entry.item.mark, f"{path}.max_rate: expected a rate in Hz, > 0, got {entry.item.words()}")
    return None


def _flag(entries: Mapping[str, Entry], key: str, default: bool, problems: Problems) -> bool:
    entry = entries.get(key)
    if entry is None:
        return default
    value = entry.item.content
    if isinstance(value, bool):
        return value
    problems.add(entry.item.mark, f"{key}: expected true or false, got {entry.item.words()}")
    return default


def _settings(root: Item, sensor: str, drafts: Sequence[Draft]) -> dict[str, Any]:
    plain = {key: entry.item.plain() for key, entry in root.entries.items() if key not in _SECTIONS}
    sections = {
        section: {draft.id: draft.item.plain() for draft in drafts if draft.section == section}
        for section in _SECTIONS
    }
    return plain | {"sensor": sensor} | sections


def _warnings(root: Item, drafts: Sequence[Draft]) -> list[str]:
    if any(draft.section == "sinks" for draft in drafts):
        return []
    entry = root.entries.get("sinks")
    return [f"{entry.mark if entry else root.mark}  there are no sinks, so nothing will be computed"]
