"""Report the result of a search: a table, and a pipeline file with comments."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import yaml

from tactflow.drawing.plots import colour
from tactflow.engine.errors import ConfigError
from tactflow.engine.graph import Pipeline
from tactflow.system.terminal import markdown, printable
from tactflow.tools.bench.page import Point, draw_points
from tactflow.tools.page import Section, marked, page, plot, table
from tactflow.tools.tune.measure import ERROR_KINDS
from tactflow.tools.tune.search import Goal, Tuned

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def lines(tuned: Tuned) -> Iterator[str]:
    """How the pipelines were measured, and a table of them, as Markdown."""
    kinds = [kind for kind in ERROR_KINDS if any(kind in trial.errors for trial in tuned.trials)]
    facts = [
        f"simulated sensor fitted to {tuned.recording.source}: {tuned.look}",
        "errors: px of the camera image, simulated; time: CPU of a frame with contact, on the recording",
        "; ".join(f"{kind}: {ERROR_KINDS[kind]}" for kind in kinds),
    ]
    rows = []
    for trial in tuned.trials:
        errors = (f"{trial.errors[kind]:.3f}" if kind in trial.errors else "-" for kind in kinds)
        ms = f"{trial.ms:.2f}" if math.isfinite(trial.ms) else "-"
        mark, remark = "CHOSEN" if trial is tuned.chosen else "", trial.fault.partition("\n")[0]
        rows.append([mark, trial.name, ms, *errors, remark])
    columns = ["", "pipeline", "time, ms", *(f"{kind}, px" for kind in kinds), "remarks"]
    yield from markdown("Time and error", "\n\n".join(facts), columns, rows)


def _reaching(limits: tuple[float, float], budget: float) -> tuple[float, float]:
    """Limits of a logarithmic axis that show a budget, too."""
    return min(limits[0], budget / 1.2), max(limits[1], budget * 1.2)


def front_page(tuned: Tuned, goal: Goal) -> str:
    """A page: each candidate's time against its largest error, their front, the budgets, and the choice."""
    usable = [trial for trial in tuned.trials if trial.usable and math.isfinite(trial.ms)]
    found = [Point(trial.name, (trial.ms,) * 3, (trial.error,) * 3) for trial in usable]

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        draw_points(axes, found, [] if tuned.chosen is None else [tuned.chosen.name])
        axes.set_title("largest error, px of the camera image")
        if goal.max_ms is not None:
            axes.axvline(goal.max_ms, color=colour("warn"), linewidth=1)
            axes.set_xlim(_reaching(axes.get_xlim(), goal.max_ms))
        if goal.max_error is not None:
            axes.axhline(goal.max_error, color=colour("warn"), linewidth=1)
            axes.set_ylim(_reaching(axes.get_ylim(), goal.max_error))

    rows = []
    for trial in tuned.trials:
        choice = marked("chosen", "good") if trial is tuned.chosen else ""
        error, ms = (f"{value:.3f}" if math.isfinite(value) else "" for value in (trial.error, trial.ms))
        rows.append([trial.name, ms, error, choice or trial.fault.partition("\n")[0]])
    columns = ["pipeline", "time, ms", "largest error, px", ""]
    text = f"Simulated sensor fitted to {tuned.recording.source}: {tuned.look}."
    body = [plot(draw, width=760, height=420), table(columns, rows, sortable=True)]
    return page("tactflow tune", [Section("Time against error", text, body)])


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
