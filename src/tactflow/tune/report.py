"""Report the result of a search: as text, page, JSON, and pipeline file with comments."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import yaml

from tactflow.engine.errors import ConfigError
from tactflow.report import COLORS, Section, Table, figure, mark, picture, write_report
from tactflow.tune.measure import ANY, CHECKS, ERRORS, Interval, Trial
from tactflow.tune.search import DEFAULT, Tuned


def lines(tuned: Tuned) -> Iterator[str]:
    """The report as lines of text."""
    kinds = _kinds(tuned)
    yield from _facts(tuned)
    yield ""
    yield f"  {'':<8} {'ms':>6} {'interval':>14} " + "".join(f"{k:>8} {'interval':>14} " for k in kinds)
    for trial in tuned.trials:
        if trial.failure:
            yield f"  {'fails':<8} {trial.name}: {trial.failure.splitlines()[0]}"
            continue
        cells = _cell(trial.ms, 6, 2) + "".join(_cell(trial.errors.get(kind), 8, 3) for kind in kinds)
        remark = f"  ({trial.unsound})" if trial.unsound else ""
        yield f"  {_role(tuned, trial):<8} {cells}{trial.name}{remark}"
    yield ""
    yield "; ".join(f"{kind}: {ERRORS[kind]}" for kind in kinds)
    yield from tuned.notes
    checks = [trial.checks for trial in tuned.trials if _role(tuned, trial) == "CHOSEN"]
    if checks and checks[0]:
        yield from ("", "the chosen pipeline on the recording:")
        yield from (f"  {value:>8.3g}  {CHECKS[check]}" for check, value in checks[0].items())


def _facts(tuned: Tuned) -> Iterator[str]:
    yield f"simulated sensor fitted to {tuned.recording.source}: {tuned.look}"
    rounds = ", ".join(f"{count} on {frames} frames" for count, frames in tuned.rounds)
    timed = "simulated"
    if tuned.timed_on_recording:
        rounds += f"; finalists on {tuned.recording.frames} frames of the recording"
        timed = "on the recording"
    yield f"tried: {rounds}"
    yield f"errors: px of the camera image, simulated; time: CPU of a frame with contact, {timed}"


def _kinds(tuned: Tuned) -> list[str]:
    return [kind for kind in ERRORS if kind != ANY and any(kind in trial.errors for trial in tuned.trials)]


def _cell(interval: Interval | None, width: int, digits: int) -> str:
    if interval is None:
        return f"{'-':>{width}} {'':>14} "
    span = f"{interval.low:.{digits}f}-{interval.high:.{digits}f}"
    return f"{interval.value:>{width}.{digits}f} {span:>14} "


def _role(tuned: Tuned, trial: Trial) -> str:
    if tuned.chosen is not None and trial.name == tuned.chosen.name:
        return "CHOSEN"
    return "fails" if trial.failure else "front" if trial.name in tuned.front else ""


def as_json(tuned: Tuned) -> dict[str, Any]:
    """The report as JSON-compatible values."""
    return {
        "source": tuned.recording.source,
        "sensor": asdict(tuned.look),
        "error": tuned.goal.kind,
        "chosen": None if tuned.chosen is None else tuned.chosen.name,
        "settings": None if tuned.chosen is None else dict(tuned.chosen.settings),
        "front": tuned.front,
        "words": tuned.notes,
        "candidates": [asdict(trial) for trial in tuned.trials],
    }


_MISSING: Final = object()


def pipeline_text(tuned: Tuned, file: Path, out: Path) -> str:
    """The chosen pipeline as YAML, with the measurements as comments.

    file : the user's pipeline. out : path of the file to write.

    Raises
    ------
    ConfigError
        The pipeline names files relative to itself, and `out` is in another folder.
    """
    assert tuned.chosen is not None
    document: dict[str, Any] = yaml.safe_load(file.read_text(encoding="utf-8"))
    if "./" in yaml.safe_dump(document) and out.absolute().parent != file.absolute().parent:
        raise ConfigError(
            f"--out: {file} names files relative to itself; required a path in the same folder, such as "
            f"{file.parent / out.name}"
        )
    changes = [
        change for key, value in tuned.chosen.settings if (change := _set(document, key, value)) is not None
    ]
    header = [f"Chosen by tactflow tune for {tuned.recording.source}, from {file.name}.", ""]
    header += changes or ["No changes: the original pipeline was chosen."]
    header += ["", *lines(tuned)]
    body = yaml.safe_dump(document, sort_keys=False, allow_unicode=True, width=100, default_flow_style=None)
    # The name of a recording may contain line breaks; all lines must stay comments.
    comments = "\n".join(f"# {line}".rstrip() for part in header for line in part.splitlines() or [""])
    return f"{comments}\n\n{body}"


def _set(document: dict[str, Any], key: str, value: Any) -> str | None:
    """Set a value, or remove it if None; return a description of the change, None if there is none."""
    *parents, last = key.split(".")
    for parent in parents:
        if document.get(parent) is None:
            document[parent] = {}
        document = document[parent]
    before = document.get(last, _MISSING)
    if value is None:
        document.pop(last, None)
        return None if before is _MISSING else f"{key}: removed"
    document[last] = value
    if before is _MISSING:
        return f"{key}: {value}"
    return None if before == value else f"{key}: {value}, was {before}"


def write_page(path: Path, tuned: Tuned) -> Path:
    """Write a page with a plot of time against error and the table. Raises ConfigError without matplotlib."""
    kinds = _kinds(tuned)
    columns = ["", "pipeline", "time, ms", *(f"{ERRORS[kind]}, px" for kind in kinds), "remarks"]
    rows = []
    for trial in tuned.trials:
        errors = [trial.errors[kind].value if kind in trial.errors else None for kind in kinds]
        role = _role(tuned, trial)
        marked = mark(role, role != "fails")
        rows.append([marked, trial.name, trial.ms.value, *errors, trial.failure or trial.unsound])
    chosen: Sequence[Trial] = [trial for trial in tuned.trials if _role(tuned, trial) == "CHOSEN"]
    checks = [[CHECKS[name], value] for trial in chosen for name, value in trial.checks.items()]
    sections = [
        Section(
            "Time and error",
            f"Error: {ERRORS[tuned.goal.kind]}. Bars are 90 % intervals.",
            [picture(_plot(tuned))],
            [Table(columns, rows)],
        )
    ]
    if checks:
        sections.append(
            Section("The chosen pipeline on the recording", tables=[Table(["check", ""], checks)])
        )
    text = "\n\n".join([*_facts(tuned), *tuned.notes])
    return write_report(path, f"Pipelines for {tuned.recording.source}", sections, text)


def _plot(tuned: Tuned) -> Any:
    """Plot time against error on logarithmic axes."""
    kind = tuned.goal.kind
    drawing, axes = figure(size=(7.2, 4.4))
    axes.set(xscale="log", yscale="log")
    axes.set_xlabel("CPU time of a frame with contact, ms")
    axes.set_ylabel("error, px of the camera image")
    for trial in tuned.trials:
        if trial.failure or not 0 < trial.of(kind) < math.inf or not trial.ms.value > 0:
            continue
        error, role = trial.errors[kind], _role(tuned, trial)
        color = COLORS[2] if role == "CHOSEN" else COLORS[1] if trial.name == DEFAULT else COLORS[6]
        spans = [[[i.value - i.low], [i.high - i.value]] for i in (trial.ms, error)]
        axes.errorbar(trial.ms.value, error.value, spans[1], spans[0], fmt="o", color=color, elinewidth=1)
        if role == "CHOSEN" or trial.name == DEFAULT:
            axes.annotate(
                trial.name, (trial.ms.value, error.value), (5, 5), textcoords="offset points", fontsize=8
            )
    if tuned.goal.max_ms is not None:
        axes.axvline(tuned.goal.max_ms, color="black", linestyle="--")
    if tuned.goal.max_error is not None:
        axes.axhline(tuned.goal.max_error, color="black", linestyle="--")
    return drawing
