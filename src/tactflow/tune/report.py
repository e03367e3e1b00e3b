"""What a search found: in the terminal, as a page, as JSON, and as a pipeline file with comments."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import yaml

from tactflow.engine.errors import ConfigError
from tactflow.report import COLORS, Section, Table, figure, mark, picture, write_report
from tactflow.tune.measure import ANY, CHECKS, ERRORS, Found, Interval
from tactflow.tune.search import DEFAULT, Tuned


def lines(tuned: Tuned) -> Iterator[str]:
    """The table of the terminal."""
    kinds = _kinds(tuned)
    yield from _facts(tuned)
    yield ""
    yield f"  {'':<8} {'ms':>6} {'interval':>14} " + "".join(f"{k:>8} {'interval':>14} " for k in kinds)
    for one in tuned.found:
        if one.failure:
            yield f"  {'fails':<8} {one.name}: {one.failure.splitlines()[0]}"
            continue
        cells = _cell(one.ms, 6, 2) + "".join(_cell(one.errors.get(kind), 8, 3) for kind in kinds)
        yield f"  {_role(tuned, one):<8} {cells}{one.name}{f'  ({one.unsound})' if one.unsound else ''}"
    yield ""
    yield "; ".join(f"{kind}: {ERRORS[kind]}" for kind in kinds)
    yield from tuned.notes
    checks = [one.checks for one in tuned.found if _role(tuned, one) == "CHOSEN"]
    if checks and checks[0]:
        yield from ("", "the recording itself, of the chosen one:")
        yield from (f"  {value:>8.3g}  {CHECKS[check]}" for check, value in checks[0].items())


def _facts(tuned: Tuned) -> Iterator[str]:
    yield f"simulated sensor fitted to {tuned.recording.source}: {tuned.look}"
    rounds = ", ".join(f"{count} on {frames} frames" for count, frames in tuned.rounds)
    timed = "simulated"
    if tuned.timed_on_recording:
        rounds += f"; the last ones on {tuned.recording.frames} frames of the recording"
        timed = "on the recording"
    yield f"tried: {rounds}"
    yield f"errors: px of the camera's picture, simulated; time: CPU of a frame with contact, {timed}"


def _kinds(tuned: Tuned) -> list[str]:
    return [kind for kind in ERRORS if kind != ANY and any(kind in one.errors for one in tuned.found)]


def _cell(interval: Interval | None, width: int, digits: int) -> str:
    if interval is None:
        return f"{'-':>{width}} {'':>14} "
    span = f"{interval.low:.{digits}f}-{interval.high:.{digits}f}"
    return f"{interval.value:>{width}.{digits}f} {span:>14} "


def _role(tuned: Tuned, one: Found) -> str:
    if tuned.chosen is not None and one.name == tuned.chosen.name:
        return "CHOSEN"
    return "fails" if one.failure else "front" if one.name in tuned.front else ""


def as_json(tuned: Tuned) -> dict[str, Any]:
    """Everything, for programs."""
    return {
        "source": tuned.recording.source,
        "sensor": asdict(tuned.look),
        "error": tuned.goal.kind,
        "chosen": None if tuned.chosen is None else tuned.chosen.name,
        "settings": None if tuned.chosen is None else dict(tuned.chosen.settings),
        "front": tuned.front,
        "words": tuned.notes,
        "candidates": [asdict(one) for one in tuned.found],
    }


_NOTHING: Final = object()


def pipeline_text(tuned: Tuned, file: Path, out: Path) -> str:
    """The chosen pipeline as YAML; its comments say what was measured.

    file : the user's pipeline. out : where the text will stand.

    Raises
    ------
    ConfigError
        If the pipeline names files beside itself, and `out` is elsewhere.
    """
    assert tuned.chosen is not None
    document: dict[str, Any] = yaml.safe_load(file.read_text(encoding="utf-8"))
    if "./" in yaml.safe_dump(document) and out.absolute().parent != file.absolute().parent:
        raise ConfigError(
            f"--out: {file} names files beside it; required a file in the same folder, such as "
            f"{file.parent / out.name}"
        )
    changes = [
        change for key, value in tuned.chosen.settings if (change := _set(document, key, value)) is not None
    ]
    header = [f"Chosen by tactflow tune for {tuned.recording.source}, from {file.name}.", ""]
    header += changes or ["Nothing is changed: the pipeline as given is the one."]
    header += ["", *lines(tuned)]
    body = yaml.safe_dump(document, sort_keys=False, allow_unicode=True, width=100, default_flow_style=None)
    # A recording may have a name of several lines; none of them may become YAML.
    comments = "\n".join(f"# {line}".rstrip() for part in header for line in part.splitlines() or [""])
    return f"{comments}\n\n{body}"


def _set(document: dict[str, Any], key: str, value: Any) -> str | None:
    """Set one value, None removes it; returns the change in words, or None if it changes nothing."""
    *parents, last = key.split(".")
    for parent in parents:
        if document.get(parent) is None:
            document[parent] = {}
        document = document[parent]
    before = document.get(last, _NOTHING)
    if value is None:
        document.pop(last, None)
        return None if before is _NOTHING else f"{key}: removed"
    document[last] = value
    if before is _NOTHING:
        return f"{key}: {value}"
    return None if before == value else f"{key}: {value}, in place of {before}"


def write_page(path: Path, tuned: Tuned) -> Path:
    """Write the page: a plot of time against error, and the table. Raises ConfigError without matplotlib."""
    kinds = _kinds(tuned)
    columns = ["", "pipeline", "time, ms", *(f"{ERRORS[kind]}, px" for kind in kinds), "remarks"]
    rows = []
    for one in tuned.found:
        errors = [one.errors[kind].value if kind in one.errors else None for kind in kinds]
        role = _role(tuned, one)
        marked = mark(role, role != "fails")
        rows.append([marked, one.name, one.ms.value, *errors, one.failure or one.unsound])
    chosen: Sequence[Found] = [one for one in tuned.found if _role(tuned, one) == "CHOSEN"]
    checks = [[CHECKS[name], value] for one in chosen for name, value in one.checks.items()]
    sections = [
        Section(
            "Time and error",
            f"Error: {ERRORS[tuned.goal.kind]}. Bars are intervals of 90 %.",
            [picture(_plot(tuned))],
            [Table(columns, rows)],
        )
    ]
    if checks:
        sections.append(
            Section("The recording itself, of the chosen one", tables=[Table(["check", ""], checks)])
        )
    text = "\n\n".join([*_facts(tuned), *tuned.notes])
    return write_report(path, f"Pipelines for {tuned.recording.source}", sections, text)


def _plot(tuned: Tuned) -> Any:
    """Time against error, both axes logarithmic."""
    kind = tuned.goal.kind
    drawing, axes = figure(size=(7.2, 4.4))
    axes.set(xscale="log", yscale="log")
    axes.set_xlabel("CPU time of a frame with contact, ms")
    axes.set_ylabel("error, px of the camera's picture")
    for one in tuned.found:
        if one.failure or not 0 < one.of(kind) < math.inf or not one.ms.value > 0:
            continue
        error, role = one.errors[kind], _role(tuned, one)
        color = COLORS[2] if role == "CHOSEN" else COLORS[1] if one.name == DEFAULT else COLORS[6]
        spans = [[[i.value - i.low], [i.high - i.value]] for i in (one.ms, error)]
        axes.errorbar(one.ms.value, error.value, spans[1], spans[0], fmt="o", color=color, elinewidth=1)
        if role == "CHOSEN" or one.name == DEFAULT:
            axes.annotate(
                one.name, (one.ms.value, error.value), (5, 5), textcoords="offset points", fontsize=8
            )
    if tuned.goal.max_ms is not None:
        axes.axvline(tuned.goal.max_ms, color="black", linestyle="--")
    if tuned.goal.max_error is not None:
        axes.axhline(tuned.goal.max_error, color="black", linestyle="--")
    return drawing
