"""`sensors:` in a pipeline file: the same graph for each of several sensors, with changes for each.

    sensors:
      left:  {stages: {capture: {source: /dev/video0}}}
      right: {stages: {capture: {source: /dev/video2}, preprocess: {rotate: 270}}}

What stands under a sensor's name is laid over the rest of the file; null removes a stage, a sink or a
parameter. `{sensor}` in any text of a sink stands for the sensor's name.
"""

from __future__ import annotations

from tactflow.config.models import Changes, is_word
from tactflow.config.yamlmap import Entry, Item, Problems
from tactflow.system.spelling import did_you_mean

PLACEHOLDER = "{sensor}"


def names(root: Item) -> list[str]:
    """The sensors that a file names under `sensors:`, in order; empty if it has none."""
    entry = root.entries.get("sensors")
    return [str(name) for name in entry.item.entries] if entry else []


def select(root: Item, chosen: str | None, problems: Problems) -> tuple[Item, str]:
    """The document for one sensor, and the sensor's name.

    chosen : a name of `sensors:`, or None for the first one, or for the only one of a file without it.
    """
    entry = root.entries.get("sensors")
    single = root.entries.get("sensor")
    if entry is None:
        own = single.item.content if single else None
        name = own if isinstance(own, str) and is_word(own) else "main"
        if chosen is not None and chosen != name:
            problems.add(root.mark, f"there is no sensor {chosen!r}; the file's only sensor is {name}")
        return _named(root, name), name
    if single is not None:
        there = f"the names stand under sensors ({entry.mark}) already; leave this one out"
        problems.add(single.mark, f"sensor: {there}")
    known = names(root)
    if chosen is not None and chosen not in known:
        problems.add(entry.mark, f"sensors: there is no {chosen!r}{did_you_mean(chosen, known)}")
    name = chosen if chosen in known else known[0] if known else "main"
    given = entry.item.entries[name].item.entries if known else {}
    changes = {key: value for key, value in given.items() if key in Changes.model_fields}
    return _named(_laid_over(root, Item(changes, entry.mark)), name), name


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
