"""`sensors:` in a pipeline file: the same graph for each of several sensors, with changes for each.

    sensors:
      left:  {stages: {capture: {source: /dev/video0}}}
      right: {stages: {capture: {source: /dev/video2}, preprocess: {rotate: 270}}}

What stands under a sensor's name is laid over the rest of the file; null removes a stage, a sink or a
parameter. `{sensor}` in any text of a sink stands for the sensor's name.
"""

from __future__ import annotations

from tactflow.config import envelope
from tactflow.config.registry import did_you_mean
from tactflow.config.yamlmap import Entry, Item, Problems
from tactflow.engine.graph import Mark

CHANGEABLE = ("skipping", "opencv_threads", "realtime_priority", "stages", "sinks")
"""What a sensor may change."""

PLACEHOLDER = "{sensor}"
RESERVED = "stats"


def names(root: Item) -> list[str]:
    """The sensors that a file names under `sensors:`, in order; empty if it has none."""
    entry = root.entries.get("sensors")
    return [str(name) for name in entry.item.entries] if entry else []


def select(root: Item, chosen: str | None, problems: Problems) -> tuple[Item, str]:
    """The document for one sensor, and the sensor's name.

    chosen : a name of `sensors:`, or None for the first one, or for the only one of a file without it.
    """
    entry = root.entries.get("sensors")
    if entry is None:
        own = envelope.word(root.entries, "sensor", "", problems) or "main"
        _refuse_reserved(own, root.entries["sensor"].mark if own == RESERVED else root.mark, problems)
        if chosen is not None and chosen != own:
            problems.add(root.mark, f"there is no sensor {chosen!r}; the file's only sensor is {own}")
        return _named(root, own), own
    _check(root, entry, problems)
    known = names(root)
    if chosen is not None and chosen not in known:
        problems.add(entry.mark, f"sensors: there is no {chosen!r}{did_you_mean(chosen, known)}")
    name = chosen if chosen in known else known[0] if known else "main"
    changes = entry.item.entries.get(name)
    rest = Item({key: value for key, value in root.entries.items() if key != "sensors"}, root.mark)
    # A name with nothing behind it changes nothing.
    merged = _laid_over(rest, changes.item) if changes and isinstance(changes.item.content, dict) else rest
    return _named(merged, name), name


def _refuse_reserved(name: str, mark: Mark, problems: Problems) -> None:
    if name == RESERVED:
        problems.add(mark, f"{name} is the topic of a run's statistics; give the sensor another name")


def _check(root: Item, entry: Entry, problems: Problems) -> None:
    if not isinstance(entry.item.content, dict) or not entry.item.content:
        problems.add(
            entry.item.mark,
            f"sensors: expected a mapping of name -> changes, as in {{left: {{stages: ...}}}}, got "
            f"{entry.item.words()}",
        )
    if "sensor" in root.entries:
        problems.add(
            root.entries["sensor"].mark,
            f"sensor: the names stand under sensors ({entry.mark}) already; leave this one out",
        )
    for name, changes in entry.item.entries.items():
        _refuse_reserved(name, changes.mark, problems)
        if not envelope.is_word(name):
            problems.add(changes.mark, f"sensors.{name}: a name is a word of letters, digits, _ and -")
        elif not changes.item.is_mapping:
            problems.add(
                changes.item.mark,
                f"sensors.{name}: expected a mapping of changes, as in {{stages: {{capture: ...}}}}, got "
                f"{changes.item.words()}",
            )
        else:
            envelope.check_keys(changes.item.entries, CHANGEABLE, f"sensors.{name}", problems)


def _laid_over(base: Item, changes: Item, depth: int = 0) -> Item:
    """A copy of `base` with the changes in it; parts that an alias shares stay as they are."""
    if not isinstance(changes.content, dict) or not base.is_mapping:
        return changes
    entries = dict(base.entries)
    for key, entry in changes.content.items():
        old = entries.get(key)
        if entry.item.content is None and depth > 0 and old is not None:
            del entries[key]
        elif old is None:
            entries[key] = entry
        else:
            entries[key] = Entry(entry.mark, _laid_over(old.item, entry.item, depth + 1))
    return Item(entries, base.mark)


def _named(root: Item, name: str) -> Item:
    sinks = root.entries.get("sinks")
    if sinks is None:
        return root
    return Item(root.entries | {"sinks": Entry(sinks.mark, _filled_in(sinks.item, name))}, root.mark)


def _filled_in(item: Item, name: str) -> Item:
    content = item.content
    if isinstance(content, str):
        return Item(content.replace(PLACEHOLDER, name), item.mark)
    if isinstance(content, list):
        return Item([_filled_in(part, name) for part in content], item.mark)
    if isinstance(content, dict):
        entries = {key: Entry(entry.mark, _filled_in(entry.item, name)) for key, entry in content.items()}
        return Item(entries, item.mark)
    return item
