"""`index.html`: one file that shows a batch to people, without a network."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from html import escape
from importlib.resources import files
from itertools import chain, groupby, islice
from pathlib import Path
from string import Template
from typing import Any
from urllib.parse import quote

from tactflow.batch.folder import Folder
from tactflow.batch.runs_table import Row
from tactflow.batch.task import Outcome
from tactflow.engine.errors import StageError
from tactflow.system.files import completed

MOST_ROWS = 1000
"""Recordings that the page shows, those that failed first: it has some 20 kB for each. Chosen by hand: a
browser still opens it at once."""
WIDTH, HEIGHT, GAP = 260, 26, 14
"""Size of a plot and the height of its title, px. Chosen by hand."""
STEEPEST = 90.0
"""Angles are within plus and minus this, degrees."""

_COLUMNS: Mapping[str, str] = {
    "recording": "its name, and where it is",
    "status": "done, failed, set aside, or not done",
    "frames": "processed",
    "duration": "of the recording, s",
    "frames/s": "processed a second, with what is read and written",
    "contacts": "how often something touched the gel",
    "touching": "share of the frames with a contact",
    "largest": "contact, px^2",
}

Curve = Sequence[Sequence[float | None]]
"""Points (t, area, flow, angle) in order of time."""


def write_page(folder: Folder, rows: Sequence[Row], title: str, facts: Iterable[str]) -> Path:
    """Write the page beside the results, in place of an earlier one; returns its path.

    title : for example the pipeline's name. facts : lines below it.

    Raises
    ------
    StageError : it cannot be written.
    """
    shown = list(islice(sorted(rows, key=_failed_first), MOST_ROWS))
    lines = [*facts, *_left_out(len(shown), len(rows))]
    heads = "\n".join(
        f'<th scope="col" title="{escape(help_)}"><button>{name}</button></th>'
        for name, help_ in _COLUMNS.items()
    )
    values = {
        "title": escape(title),
        "facts": "\n".join(f"<p>{escape(line)}</p>" for line in lines),
        "columns": heads,
    }
    head, foot = filled_in("index.html", values, scripts=True).split("<!-- rows -->\n")
    return replaced(folder.path / "index.html", chain([head], (_row(folder, row) for row in shown), [foot]))


def filled_in(name: str, values: Mapping[str, str], *, scripts: bool) -> str:
    """A page of this package with values, in HTML, in it. scripts : whether it has one."""
    room = files("tactflow.batch")
    style, head, rest = (
        room.joinpath(n).read_text(encoding="utf-8") for n in ("page.css", "head.html", name)
    )
    allowed = "'unsafe-inline'" if scripts else "'none'"
    return Template(head + rest).substitute(values, style=style, script=allowed)


def replaced(path: Path, parts: Iterable[str]) -> Path:
    """Write a file in place of an earlier one, never in half; returns its path.

    Raises
    ------
    StageError : it cannot be written.
    """
    try:
        with completed(path) as partial, partial.open("w", encoding="utf-8") as file:
            file.writelines(parts)
    except OSError as error:
        raise StageError(f"{path}: cannot be written: {error.strerror or error}") from error
    return path


def _failed_first(row: Row) -> int:
    if row.outcome is None:
        return 2
    return int(row.outcome.status == "done")


def _left_out(shown: int, total: int) -> Iterator[str]:
    if shown < total:
        yield f"{shown} of {total} recordings are shown, those that failed first; the table of runs has all"


def _row(folder: Folder, row: Row) -> str:
    """A line of the table."""
    outcome = row.outcome
    where = escape(row.recording.source)
    name = f"<b>{escape(row.recording.name)}</b>"
    if outcome is not None and outcome.result is not None:
        name += f' <a href="results/{quote(outcome.result)}">result</a>'
    name += "" if where == escape(row.recording.name) else f"<small>{where}</small>"
    # Beside the name they are seen without scrolling sideways.
    notes = () if outcome is None else outcome.notes
    name += "".join(f'<small class="bad">{escape(note)}</small>' for note in notes)
    status = "not done" if outcome is None else outcome.status
    kind = "good" if status == "done" else "bad"
    cells = [_cell(row.recording.name, name), _cell(status, f'<span class="{kind}">{status}</span>')]
    if outcome is None or outcome.status != "done":
        why = "" if outcome is None else escape(outcome.error or "")
        across = len(_COLUMNS) - len(cells) + 2
        return f'<tr>{"".join(cells)}<td class="why" colspan="{across}">{why}</td></tr>\n'
    cells += _numbers(outcome)
    record = folder.record(outcome.key) or {"curve": [], "pictures": []}
    cells.append(f'<td class="wide">{plots(record["curve"], outcome.duration)}</td>')
    cells.append(f'<td class="wide"><div class="pictures">{_pictures(record)}</div></td>')
    return f"<tr data-done>{''.join(cells)}</tr>\n"


def _numbers(outcome: Outcome) -> list[str]:
    share = outcome.touching / outcome.frames if outcome.frames else 0.0
    rate = outcome.frames / outcome.seconds if outcome.seconds else 0.0
    return [
        _cell(outcome.frames, f"{outcome.frames}"),
        _cell(outcome.duration, f"{outcome.duration:.1f} s"),
        _cell(rate, f"{rate:.1f}"),
        _cell(outcome.contacts, f"{outcome.contacts}"),
        _cell(share, f"{100 * share:.0f} %"),
        _cell(outcome.largest, f"{outcome.largest:.0f}"),
    ]


def _cell(value: object, content: str) -> str:
    return f'<td data-value="{escape(str(value))}">{content}</td>'


def _pictures(record: Mapping[str, Any]) -> str:
    return "".join(
        f'<figure><img alt="contact in frame {picture["seq"]}" '
        f'src="data:image/jpeg;base64,{picture["jpeg"]}">'
        f"<figcaption>{picture['t']:.2f} s</figcaption></figure>"
        for picture in record["pictures"]
    )


def plots(curve: Curve, duration: float) -> str:
    """Area, flow and angle over time as SVG.

    duration : s, the width of a plot.

    >>> plots([(0.0, 0.0, None, None), (1.0, 50.0, 2.0, 30.0)], 1.0)[:48]
    '<svg width="260" height="122" viewBox="0 0 260 1'
    """
    largest = max((point[1] or 0.0 for point in curve), default=0.0)
    fastest = max((point[2] or 0.0 for point in curve), default=0.0)
    across = WIDTH / duration if duration > 0 else 0.0
    parts = [
        ("area", f"area, up to {largest:.0f} px²", _filled(curve, across, _upwards(largest))),
        ("flow", f"flow, up to {fastest:.1f} px", _line(curve, 2, across, _upwards(fastest))),
        ("angle", "angle, -90 to 90°", _line(curve, 3, across, lambda v: HEIGHT * (STEEPEST - v) / 180)),
    ]
    step = HEIGHT + GAP
    height = len(parts) * step + 2
    drawn = []
    for index, (kind, label, path) in enumerate(parts):
        top = index * step + GAP
        drawn.append(
            f'<g transform="translate(0 {top})"><line class="axis" y1="{HEIGHT}" y2="{HEIGHT}" x2="{WIDTH}"/>'
            f'<path class="{kind}" d="{path}"/><text y="-3">{label}</text></g>'
        )
    return f'<svg width="{WIDTH}" height="{height}" viewBox="0 0 {WIDTH} {height}">{"".join(drawn)}</svg>'


def _upwards(most: float) -> Callable[[float], float]:
    return lambda value: HEIGHT * (1 - value / most) if most > 0 else HEIGHT


def _filled(curve: Curve, across: float, down: Callable[[float], float]) -> str:
    """The area under a curve."""
    inside = "".join(f"L{_x(point, across)} {down(point[1] or 0.0):.1f}" for point in curve)
    return f"M0 {HEIGHT}{inside}V{HEIGHT}Z" if inside else ""


def _line(curve: Curve, place: int, across: float, down: Callable[[float], float]) -> str:
    """A line with gaps where there is no value; a single point is a dot."""
    runs = (list(run) for there, run in groupby(curve, lambda point: point[place] is not None) if there)
    text = ""
    for run in runs:
        ends = [f"{_x(point, across)} {down(float(point[place] or 0.0)):.1f}" for point in run]
        text += f"M{ends[0]}" + "".join(f"L{end}" for end in ends[1:]) + ("h0" if len(ends) == 1 else "")
    return text


def _x(point: Sequence[float | None], across: float) -> str:
    return f"{(point[0] or 0.0) * across:.1f}"
