"""What a search found: in the terminal, as one HTML file, and as a pipeline file with comments."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from html import escape
from pathlib import Path
from typing import Any, Final

import yaml

from tactflow.bench.quantities import format_number
from tactflow.engine.errors import ConfigError
from tactflow.tune.checks import WORDS
from tactflow.tune.log_axis import LogAxis
from tactflow.tune.measure import ANY, ERRORS, Found, Interval
from tactflow.tune.search import DEFAULT, ORIGINAL, Tuned

WIDTH: Final = 860
HEIGHT: Final = 480
"""Size of the plot, px. This and the lengths below were chosen by hand."""
MARGINS: Final = (70, 24, 20, 50)
"""Left, right, top and bottom margin, px."""


def lines(tuned: Tuned) -> Iterator[str]:
    """The table of the terminal."""
    yield f"simulated sensor fitted to {tuned.recording.source}: {tuned.look.words()}"
    rounds = ", ".join(f"{count} on {frames} frames" for count, frames in tuned.rounds)
    shown = f"; the last ones on {tuned.recording.frames} frames of the recording"
    yield f"tried: {rounds}{shown if tuned.timed_on_recording else ''}"
    timed = "simulated"
    if tuned.timed_on_recording:
        timed = f"on the recording ({ORIGINAL}: simulated)"
    yield f"errors: px of the camera's picture, simulated; time: CPU of a frame with contact, {timed}"
    yield ""
    yield f"  {'':<8} {'ms':>6} {'interval':>14} " + "".join(
        f"{k:>8} {'interval':>14} " for k in _kinds(tuned)
    )
    for one in tuned.found:
        yield _line(tuned, one)
    kinds = "; ".join(f"{kind}: {ERRORS[kind]}" for kind in _kinds(tuned) if kind != ANY)
    yield ""
    yield kinds
    yield from tuned.words
    yield from _recording(tuned)


def _kinds(tuned: Tuned) -> list[str]:
    return [kind for kind in ERRORS if kind != ANY and any(kind in one.error for one in tuned.found)]


def _line(tuned: Tuned, one: Found) -> str:
    mark = "CHOSEN" if _is_chosen(tuned, one) else "front" if one.name in tuned.front else ""
    if one.failure:
        return f"  {'fails':<8} {one.name}: {one.failure.splitlines()[0]}"
    cells = f"{one.ms.value:>6.2f} {_between(one.ms, 2):>14} "
    for kind in _kinds(tuned):
        error = one.error.get(kind)
        cells += f"{error.value:>8.3f} {_between(error, 3):>14} " if error else f"{'-':>8} {'':>14} "
    unsound = f"  ({one.unsound})" if one.unsound else ""
    return f"  {mark:<8} {cells} {one.name}{unsound}"


def _between(interval: Interval, digits: int) -> str:
    return f"{interval.low:.{digits}f}-{interval.high:.{digits}f}"


def _is_chosen(tuned: Tuned, one: Found) -> bool:
    return tuned.chosen is not None and one.name == tuned.chosen.name


def _recording(tuned: Tuned) -> Iterator[str]:
    """What the recording itself says of the chosen one."""
    for one in tuned.found:
        if _is_chosen(tuned, one) and one.checks:
            yield ""
            yield "the recording itself, of the chosen one:"
            for check, value in one.checks.items():
                yield f"  {format_number(value):>8}  {WORDS[check]}"


def as_json(tuned: Tuned) -> dict[str, Any]:
    """Everything, for programs."""
    return {
        "source": tuned.recording.source,
        "sensor": tuned.look.as_dict(),
        "error": tuned.goal.kind,
        "chosen": None if tuned.chosen is None else tuned.chosen.name,
        "settings": None if tuned.chosen is None else dict(tuned.chosen.settings),
        "front": tuned.front,
        "words": tuned.words,
        "candidates": [
            {
                "name": one.name,
                "ms": vars(one.ms),
                "errors": {kind: vars(value) for kind, value in one.error.items()},
                "checks": one.checks,
                "failure": one.failure,
                "unsound": one.unsound,
            }
            for one in tuned.found
        ],
    }


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
    text = yaml.safe_dump(document)
    if "./" in text and out.absolute().parent != file.absolute().parent:
        raise ConfigError(
            f"--out: {file} names files beside it; required a file in the same folder, such as "
            f"{file.parent / out.name}"
        )
    header = [f"Chosen by tactflow tune for {tuned.recording.source}, from {file.name}."]
    header += ["", *_changes(document, tuned), ""]
    header += [line.rstrip() for line in lines(tuned)]
    for key, value in tuned.chosen.settings:
        _set(document, key.split("."), value)
    body = yaml.safe_dump(document, sort_keys=False, allow_unicode=True, width=100, default_flow_style=None)
    # A recording may have a name of several lines; none of them may become YAML.
    comments = "\n".join(f"# {line}".rstrip() for part in header for line in part.splitlines() or [""])
    return f"{comments}\n\n{body}"


def _changes(document: dict[str, Any], tuned: Tuned) -> Iterator[str]:
    assert tuned.chosen is not None
    same = True
    for key, value in tuned.chosen.settings:
        before = _get(document, key.split("."))
        if value is None and before is _NOTHING:
            continue
        if before is _NOTHING or before != value:
            same = False
            now = "removed" if value is None else value
            yield f"{key}: {now}" + ("" if before is _NOTHING or value is None else f", in place of {before}")
    if same:
        yield "Nothing is changed: the pipeline as given is the one."


_NOTHING: Final = object()


def _get(document: Any, keys: Sequence[str]) -> Any:
    for key in keys:
        if not isinstance(document, dict) or key not in document:
            return _NOTHING
        document = document[key]
    return document


def _set(document: dict[str, Any], keys: Sequence[str], value: Any) -> None:
    """Set one value; None removes a stage."""
    for key in keys[:-1]:
        if document.get(key) is None:
            document[key] = {}
        document = document[key]
    if value is None:
        document.pop(keys[-1], None)
    else:
        document[keys[-1]] = value


def html(tuned: Tuned) -> str:
    """One HTML file: the plot, and the table."""
    kind = tuned.goal.kind
    body = "\n".join(escape(line) for line in lines(tuned))
    return (
        '<!doctype html>\n<meta charset="utf-8">\n<title>tactflow tune</title>\n'
        "<style>body{font:14px system-ui,sans-serif;margin:2em;max-width:70em}pre{overflow:auto}"
        "svg text{font:12px system-ui,sans-serif}</style>\n"
        f"<h1>Time and error of pipelines on {escape(tuned.recording.source)}</h1>\n"
        f"<p>Error: {escape(ERRORS[kind])}. Bars are intervals of 90 %. Green: chosen; black: on the front; "
        "orange: as given, and the original script; grey: others. A point shows its name.</p>\n"
        f"{plot(tuned)}\n<pre>{body}</pre>\n"
    )


def plot(tuned: Tuned) -> str:
    """Time against error as SVG, both axes logarithmic."""
    kind = tuned.goal.kind
    shown = [
        one for one in tuned.found if not one.failure and 0 < one.of(kind) < math.inf and one.ms.value > 0
    ]
    times = [v for one in shown for v in (one.ms.low, one.ms.high)]
    across = LogAxis.around(times or [1.0, 10.0], MARGINS[0], WIDTH - MARGINS[1])
    errors = [v for one in shown for v in (one.error[kind].low, one.error[kind].high) if v > 0]
    up = LogAxis.around(errors or [1.0, 10.0], HEIGHT - MARGINS[3], MARGINS[2])
    parts = [f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" width="{WIDTH}" role="img">', *_grid(across, up)]
    bounds = ((tuned.goal.max_ms, True), (tuned.goal.max_error, False))
    for bound, vertical in bounds:
        if bound is not None:
            ends = (across.at(bound), float(MARGINS[2]), across.at(bound), float(HEIGHT - MARGINS[3]))
            if not vertical:
                ends = (float(MARGINS[0]), up.at(bound), float(WIDTH - MARGINS[1]), up.at(bound))
            parts.append(_rule(*ends, "#c00", "5 4"))
    for one in sorted(shown, key=lambda one: _is_chosen(tuned, one)):
        parts += _dot(tuned, one, across, up)
    return "\n".join([*parts, "</svg>"])


def _grid(across: LogAxis, up: LogAxis) -> Iterator[str]:
    left, right, top, bottom = MARGINS[0], WIDTH - MARGINS[1], MARGINS[2], HEIGHT - MARGINS[3]
    for value in across.ticks():
        yield _rule(across.at(value), top, across.at(value), bottom, "#ddd")
        yield _text(across.at(value), bottom + 18, format_number(value), "middle")
    for value in up.ticks():
        yield _rule(left, up.at(value), right, up.at(value), "#ddd")
        yield _text(left - 8, up.at(value) + 4, format_number(value), "end")
    yield _text((left + right) / 2, HEIGHT - 10, "CPU time of a frame with contact, ms", "middle")
    yield _text(left, top - 6, "error, px of the camera's picture", "start")


def _dot(tuned: Tuned, one: Found, across: LogAxis, up: LogAxis) -> Iterator[str]:
    error = one.error[tuned.goal.kind]
    special = one.name in (DEFAULT, ORIGINAL)
    color = "#999"
    if _is_chosen(tuned, one):
        color = "#080"
    elif special:
        color = "#d60"
    elif one.name in tuned.front:
        color = "#000"
    x, y = across.at(one.ms.value), up.at(error.value)
    yield _rule(across.at(one.ms.low), y, across.at(one.ms.high), y, color)
    yield _rule(x, up.at(error.low), x, up.at(error.high), color)
    title = f"{one.name}: {one.ms.value:.2f} ms, {error.value:.3f} px"
    yield f'<circle cx="{x:.1f}" cy="{y:.1f}" r="5" fill="{color}"><title>{escape(title)}</title></circle>'
    if _is_chosen(tuned, one) or special:
        yield _text(x + 9, y - 7 if _is_chosen(tuned, one) else y + 17, one.name, "start")


def _rule(x0: float, y0: float, x1: float, y1: float, color: str, dash: str = "") -> str:
    dashed = f' stroke-dasharray="{dash}"' if dash else ""
    ends = f'x1="{x0:.1f}" y1="{y0:.1f}" x2="{x1:.1f}" y2="{y1:.1f}"'
    return f'<line {ends} stroke="{color}"{dashed}/>'


def _text(x: float, y: float, text: str, anchor: str) -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(text)}</text>'
