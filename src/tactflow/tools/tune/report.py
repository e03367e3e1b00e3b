"""Report the result of a search: a table, and a pipeline file with comments."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import yaml

from tactflow.engine.errors import ConfigError
from tactflow.engine.graph import Pipeline
from tactflow.system.terminal import markdown, printable
from tactflow.tools.tune.measure import ERRORS
from tactflow.tools.tune.search import Tuned


def lines(tuned: Tuned) -> Iterator[str]:
    """How the pipelines were measured, and a table of them, as Markdown."""
    kinds = [kind for kind in ERRORS if any(kind in trial.errors for trial in tuned.trials)]
    facts = [
        f"simulated sensor fitted to {tuned.recording.source}: {tuned.look}",
        "errors: px of the camera image, simulated; time: CPU of a frame with contact, on the recording",
        "; ".join(f"{kind}: {ERRORS[kind]}" for kind in kinds),
    ]
    rows = []
    for trial in tuned.trials:
        errors = (f"{trial.errors[kind]:.3f}" if kind in trial.errors else "-" for kind in kinds)
        ms = f"{trial.ms:.2f}" if math.isfinite(trial.ms) else "-"
        mark, remark = "CHOSEN" if trial is tuned.chosen else "", trial.fault.partition("\n")[0]
        rows.append([mark, trial.name, ms, *errors, remark])
    columns = ["", "pipeline", "time, ms", *(f"{kind}, px" for kind in kinds), "remarks"]
    yield from markdown("Time and error", "\n\n".join(facts), columns, rows)


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
