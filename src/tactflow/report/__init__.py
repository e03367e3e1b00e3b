"""Reports: a self-contained HTML file with headings, text, tables, pictures and plots."""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tactflow.engine.errors import ConfigError, StageError
from tactflow.system.extras import missing
from tactflow.system.files import completed

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7f8a94")
"""Data colours by Okabe and Ito: distinct for all types of colour vision, on light and dark pages."""


class Html(str):
    """Text that is already HTML; other text is escaped."""


@dataclass(frozen=True)
class Table:
    """A table, sorted by a click on a heading.

    columns : headings with units, such as "time, ms". rows : cells are text, numbers, None or `Html` from
    `link`, `mark` or `picture`.
    """

    columns: Sequence[str]
    rows: Sequence[Sequence[object]]


@dataclass(frozen=True)
class Section:
    """A heading followed by text, pictures and tables.

    text : paragraphs, separated by empty lines. pictures : from `picture`.
    """

    title: str
    text: str = ""
    pictures: Sequence[Html] = ()
    tables: Sequence[Table] = ()


def write_report(path: Path, title: str, sections: Iterable[Section], text: str = "") -> Path:
    """Write a report, overwriting an earlier one; return its path. text : paragraphs below the title.

    Raises
    ------
    StageError : the file cannot be written.

    >>> from tempfile import mkdtemp
    >>> speed = Table(["method", "time, ms"], [["fast", 1.25], ["slow", 31.0]])
    >>> write_report(Path(mkdtemp(), "report.html"), "Speed", [Section("Times", tables=[speed])]).name
    'report.html'
    """
    template = Template(files("tactflow.report").joinpath("page.html").read_text(encoding="utf-8"))
    body = "\n".join(_section(section) for section in sections)
    page = template.substitute(title=escape(title), text=_paragraphs(text), body=body)
    try:
        with completed(path) as partial:
            partial.write_text(page, encoding="utf-8")
    except OSError as error:
        raise StageError(f"{path}: cannot be written: {error.strerror or error}") from error
    return path


def markdown(sections: Iterable[Section]) -> Iterator[str]:
    """Lines of the text and tables of sections in Markdown, with aligned columns.

    >>> speed = Table(["method", "time, ms"], [["fast", 1.25], ["exact", 31]])
    >>> print(*markdown([Section("Times", tables=[speed])]), sep="\\n")
    ### Times
    <BLANKLINE>
    | method | time, ms |
    | ------ | -------- |
    | fast   | 1.25     |
    | exact  | 31       |
    <BLANKLINE>
    """
    for section in sections:
        yield from (f"### {section.title}", "", *([*section.text.splitlines(), ""] if section.text else []))
        for table in section.tables:
            lines = [table.columns, *table.rows]
            cells = [[str(cell).replace("|", "\\|").replace("\n", " ") for cell in line] for line in lines]
            widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
            cells.insert(1, ["-" * width for width in widths])
            for line in cells:
                yield f"| {' | '.join(map(str.ljust, line, widths))} |"
            yield ""


def figure(rows: int = 1, columns: int = 1, size: tuple[float, float] = (4.8, 3.0), **options: Any) -> Any:
    """A matplotlib figure and its axes, like `pyplot.subplots` but without a window.

    size : width and height, inches. options : for `Figure.subplots`, such as `sharex=True`. Black and white
    adapt to the page's light or dark theme; take other colours from `COLORS`.

    Raises
    ------
    ConfigError : matplotlib is missing.
    """
    if problem := missing("plots", "plot", ["matplotlib"]):
        raise ConfigError(problem)
    from cycler import cycler
    from matplotlib.figure import Figure

    drawing = Figure(figsize=size, layout="constrained")
    axes = drawing.subplots(rows, columns, **options)
    for axis in drawing.axes:
        axis.set_prop_cycle(cycler(color=COLORS))
        axis.spines[["top", "right"]].set_visible(False)
    return drawing, axes


def picture(content: NDArray[Any] | bytes | Figure, caption: str = "") -> Html:
    """A picture or plot, for a section or a table cell.

    content : (H, W) or (H, W, 3) uint8, gray or BGR; an encoded JPEG or PNG; or a matplotlib figure.
    """
    if isinstance(content, np.ndarray):
        import cv2

        content = cv2.imencode(".png", content)[1].tobytes()
    drawn = _image(content) if isinstance(content, bytes) else _svg(content)
    return Html(f"<figure>{drawn}{f'<figcaption>{escape(caption)}</figcaption>' if caption else ''}</figure>")


def link(text: str, address: str) -> Html:
    """A link, for a table cell. address : URL-quoted."""
    return Html(f'<a href="{escape(address)}">{escape(text)}</a>')


def mark(text: str, good: bool) -> Html:
    """Text in the colour of success or failure, for a table cell."""
    return Html(f'<b class="{"good" if good else "bad"}">{escape(text)}</b>')


def _image(encoded: bytes) -> str:
    kind = "png" if encoded.startswith(b"\x89PNG") else "jpeg"
    return f'<img alt="" src="data:image/{kind};base64,{base64.b64encode(encoded).decode()}">'


def _svg(drawing: Figure) -> str:
    """A figure as SVG whose black and white adapt to the page's theme."""
    import matplotlib

    buffer = io.StringIO()
    with matplotlib.rc_context({"svg.fonttype": "none"}):
        drawing.savefig(buffer, format="svg", transparent=True, metadata={"Date": None})
    text = re.sub(r"<metadata>.*?</metadata>", "", buffer.getvalue(), flags=re.S)
    text = re.sub(r'width="([\d.]+pt)" height="[\d.]+pt"', r'style="--width: \1"', text, count=1)
    text = text.replace("#000000", "currentColor").replace("#ffffff", "var(--panel)")
    return text[text.index("<svg") :]


def _section(section: Section) -> str:
    body = _paragraphs(section.text) + f'<div class="pictures">{"".join(section.pictures)}</div>'
    body += "".join(_table(table) for table in section.tables)
    return f"<section><h2>{escape(section.title)}</h2>{body}</section>"


def _paragraphs(text: str) -> str:
    return "".join(f"<p>{_html(part.strip())}</p>" for part in text.split("\n\n") if part.strip())


def _table(table: Table) -> str:
    numeric = {i for row in table.rows for i, cell in enumerate(row) if isinstance(cell, int | float)}
    kinds = [" class=number" if i in numeric else "" for i in range(len(table.columns))]
    head = "".join(f"<th{k}>{escape(column)}</th>" for k, column in zip(kinds, table.columns, strict=True))
    rows = (zip(kinds, row, strict=True) for row in table.rows)
    body = "\n".join(f"<tr>{''.join(f'<td{kind}>{_html(c)}</td>' for kind, c in row)}</tr>" for row in rows)
    return f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def _html(cell: object) -> str:
    if isinstance(cell, Html):
        return cell
    if isinstance(cell, float):
        return f"{cell:.4g}" if abs(cell) < 1e4 else f"{cell:.0f}"
    return escape("–" if cell is None else str(cell)).replace("\n", "<br>")
