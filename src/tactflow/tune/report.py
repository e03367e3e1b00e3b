"""Report the result of a search: as text, JSON, and pipeline file with comments."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import yaml

from tactflow.engine.errors import ConfigError
from tactflow.engine.graph import Pipeline
from tactflow.system.terminal import markdown, printable
from tactflow.tune.measure import CHECKS, ERRORS, Interval
from tactflow.tune.search import Tuned


def lines(tuned: Tuned) -> Iterator[str]:
    """How the pipelines were measured, a table of them, and the chosen one on the recording, as Markdown."""
    facts = [
        f"simulated sensor fitted to {tuned.recording.source}: {tuned.look}",
        "errors: px of the camera image, simulated; time: CPU of a frame with contact, on the recording",
    ]
    kinds = [kind for kind in ERRORS if any(kind in trial.errors for trial in tuned.trials)]
    rows = []
    for trial in tuned.trials:
        cells = [_cell(trial.ms, 2), *(_cell(trial.errors.get(kind), 3) for kind in kinds)]
        remark = (trial.failure or trial.unsound).partition("\n")[0]
        rows.append(["CHOSEN" if trial is tuned.chosen else "", trial.name, *cells, remark])
    columns = ["", "pipeline", "time, ms", *(f"{kind}, px" for kind in kinds), "remarks"]
    legend = "; ".join(f"{kind}: {ERRORS[kind]}" for kind in kinds)
    legend = f"In brackets: 90 % intervals. {legend}"
    yield from markdown("How", "\n\n".join(facts))
    yield from markdown("Time and error", legend, columns, rows)
    if tuned.chosen is not None:
        checks = [[CHECKS[name], f"{value:.3g}"] for name, value in tuned.chosen.checks.items()]
        yield from markdown("The chosen pipeline on the recording", "", ["check", "value"], checks)


def _cell(interval: Interval | None, digits: int) -> str:
    if interval is None:
        return "-"
    return f"{interval.value:.{digits}f} ({interval.low:.{digits}f}-{interval.high:.{digits}f})"


def as_json(tuned: Tuned) -> dict[str, Any]:
    """The report as values for JSON."""
    keys = ("name", "settings", "errors", "quantities", "ms", "failure", "unsound", "checks")
    return {
        "source": tuned.recording.source,
        "sensor": tuned.look,
        "chosen": None if tuned.chosen is None else tuned.chosen.name,
        "candidates": [{key: getattr(trial, key) for key in keys} for trial in tuned.trials],
    }


def pipeline_text(tuned: Tuned, out: Path) -> str:
    """The chosen pipeline as YAML, with the measurements as comments; the rest as for `commented`."""
    chosen = tuned.chosen
    assert chosen is not None
    file = Path(chosen.pipeline.file).name
    title = f"Chosen by tactflow tune for {tuned.recording.source}, from {file}: {chosen.name}."
    changes = [f"{key}: {'removed' if value is None else value}" for key, value in chosen.settings.items()]
    return commented(chosen.pipeline, [title, *changes, "", *lines(tuned)], out)


def commented(pipeline: Pipeline, comments: Sequence[str], out: Path) -> str:
    """A pipeline as YAML, below comments. out : path of the file to write.

    Raises
    ------
    ConfigError
        The pipeline names files relative to itself, and `out` is in another folder.
    """
    body = yaml.safe_dump(
        dict(pipeline.settings), sort_keys=False, allow_unicode=True, width=100, default_flow_style=None
    )
    if "./" in body and out.absolute().parent != pipeline.directory.absolute():
        raise ConfigError(
            f"--out: {pipeline.file} names files relative to itself; required a path in the same folder, "
            f"such as {pipeline.directory / out.name}"
        )
    # The name of a recording may contain line breaks and control characters.
    header = "\n".join(
        f"# {printable(line)}".rstrip() for part in comments for line in part.splitlines() or [""]
    )
    return f"{header}\n\n{body}"
