"""Pages to look at: one template and one style of plots for every command that writes a page.

A page is one file: no script, font or picture from elsewhere. Text, tables and plots follow the reader's
light or dark colours.

    sections = [
        Section("Noise", "Error against noise.", [
            key(["default", "classic"]),
            multiples([plot(draw, caption="centre, px") for draw in drawings]),
            table(["scene", "error"], [["press", 0.12]]),
        ]),
    ]
    path.write_text(page("Stability", sections), encoding="utf-8")

`draw` takes a `matplotlib.figure.Figure` that has the style already: `axes = figure.subplots()`, and
`axes.plot(x, y, color=series(0))` for the colour of the first name of a `key`. Without matplotlib, `plot` is
empty, and the page says once how to install it. `save_plot` writes the same drawing as a picture of the docs.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from html import escape
from importlib.resources import files
from io import StringIO
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING, Any, Final

from tactflow.system.extras import missing

if TYPE_CHECKING:
    from collections.abc import Iterator

    from matplotlib.figure import Figure


class Html(str):
    """Text that is HTML already; any other text is escaped."""

    __slots__ = ()


COLOURS: Final = {
    "ground": ("#f4f6f8", "#0e1216"),
    "panel": ("#fefefe", "#171c22"),
    "line": ("#d9dfe5", "#2a323a"),
    "grid": ("#e6eaee", "#262e36"),
    "text": ("#12181e", "#e9eef2"),
    "quiet": ("#56626e", "#98a5b1"),
    "good": ("#007a57", "#2fc596"),
    "warn": ("#a05a00", "#f0b040"),
    "bad": ("#b84a00", "#ff8a4c"),
    "series-1": ("#0072b2", "#56b4e9"),
    "series-2": ("#d55e00", "#ee9b4b"),
    "series-3": ("#00805c", "#30c598"),
    "series-4": ("#b0558f", "#e08fc0"),
    "series-5": ("#8f7400", "#e6d84a"),
    "series-6": ("#5a6672", "#b8bcc0"),
    "series-7": ("#3d4db7", "#a3b0ff"),
    "series-8": ("#9b2d30", "#ff9c9f"),
}
"""Name -> (light, dark). The series are Okabe and Ito's colours, distinct for all types of colour vision."""
SERIES: Final = tuple(name for name in COLOURS if name.startswith("series"))
DASHES: Final = ("-", "--", "-.", ":")
"""Line styles once the colours are used up."""
WIDTH, HEIGHT = 360, 240
"""Size of a small plot, CSS pixels."""
_DPI: Final = 72
"""One point of matplotlib is one CSS pixel."""
PICTURE_DPI: Final = 144
"""Of pictures of the docs: two pixels for a CSS pixel, for sharp screens."""


@dataclass(frozen=True, slots=True)
class Section:
    """A part of a page: a heading, a text, and fragments of HTML below."""

    title: str
    text: str = ""
    body: Sequence[Html] = field(default_factory=tuple)


def page(title: str, sections: Sequence[Section], lead: str = "") -> str:
    """A whole page, HTML. lead : text below the title; paragraphs are separated by an empty line."""
    ids = [re.sub(r"\W+", "-", section.title.lower()).strip("-") for section in sections]
    titled = [(id_, section) for id_, section in zip(ids, sections, strict=True) if section.title]
    links = "".join(f'<a href="#{id_}">{escape(section.title)}</a>' for id_, section in titled)
    parts = []
    for id_, section in zip(ids, sections, strict=True):
        heading = f'<h2 id="{id_}">{escape(section.title)}</h2>' if section.title else ""
        parts.append(f"<section>{heading}{paragraphs(section.text)}{''.join(section.body)}</section>")
    remedy = missing("plots", "plot", ["matplotlib"]) if any("multiples" in part for part in parts) else None
    note = f'<p class="warn">{escape(remedy[0].upper() + remedy[1:])}</p>' if remedy else ""
    template = Template(files("tactflow.tools").joinpath("page.html").read_text(encoding="utf-8"))
    light, dark = ("; ".join(f"--{name}: {pair[i]}" for name, pair in COLOURS.items()) for i in (0, 1))
    return template.substitute(
        title=escape(title),
        lead=paragraphs(lead) + note + (f"<nav>{links}</nav>" if len(titled) > 1 else ""),
        sections="\n".join(parts),
        light=light,
        dark=dark,
    )


def paragraphs(text: str) -> Html:
    """Paragraphs of a text, which are separated by an empty line."""
    return Html("".join(f"<p>{escape(part)}</p>" for part in text.split("\n\n") if part))


def table(columns: Sequence[str], rows: Iterable[Sequence[Any]], *, sortable: bool = False) -> Html:
    """A table. A cell that is `Html` is put in as it is; a number is aligned to the right.

    >>> "<td>a &lt; b</td>" in table(["what"], [["a < b"]])
    True
    """
    head = "".join(f"<th>{escape(column)}</th>" for column in columns)
    body = "\n".join(f"<tr>{''.join(map(_cell, row))}</tr>" for row in rows)
    kind = ' class="sortable"' if sortable else ""
    return Html(
        f'<div class="scroll"><table{kind}><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'
    )


def _cell(value: Any) -> str:
    if isinstance(value, Html):
        return f"<td>{value}</td>"
    text = str(value)
    kind = ' class="number"' if re.fullmatch(r"[-+−]?[\d.,]+(e[-+]?\d+)?( %)?", text) else ""
    return f"<td{kind}>{escape(text)}</td>"


def marked(text: str, kind: str) -> Html:
    """Text in one of the colours good, warn, bad, quiet."""
    return Html(f'<b class="{kind}">{escape(text)}</b>')


def details(summary: str, *body: Html) -> Html:
    """Fragments that are folded away until the reader opens them."""
    return Html(f"<details><summary>{escape(summary)}</summary>{''.join(body)}</details>")


def colour(name: str) -> str:
    """A colour of `COLOURS` in plots; in the page it follows the reader's light or dark scheme."""
    return COLOURS[name][0]


def series(index: int) -> str:
    """Colour of a series in plots, as in `key`."""
    return colour(SERIES[index % len(SERIES)])


def dashes(index: int) -> str:
    """Line style of a series in plots: solid until the colours repeat."""
    return DASHES[index // len(SERIES) % len(DASHES)]


def key(names: Sequence[str]) -> Html:
    """Which colour is which name, in the order of `series`, for all plots below."""
    items = (
        f'<span><i style="background: var(--{SERIES[i % len(SERIES)]})"></i>{escape(name)}</span>'
        for i, name in enumerate(names)
    )
    return Html(f'<div class="key">{"".join(items)}</div>')


def multiples(plots: Iterable[Html]) -> Html:
    """Small plots in as many columns as there is room for."""
    return Html(f'<div class="multiples">{"".join(plots)}</div>')


def plot(
    draw: Callable[[Figure], object],
    *,
    caption: str = "",
    width: int = WIDTH,
    height: int = HEIGHT,
) -> Html:
    """A plot as SVG in the page; empty without matplotlib.

    draw : draws on a figure. caption : below it. width, height : CSS pixels; one wider than `WIDTH` scrolls
    on narrow screens.
    """
    if missing("plots", "plot", ["matplotlib"]):
        return Html("")
    written = StringIO()
    with _figure(width, height) as figure:
        draw(figure)
        figure.savefig(written, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    svg = written.getvalue()
    svg = svg[svg.index("<svg") :].replace("<svg", f'<svg role="img" aria-label="{escape(caption)}"', 1)
    for name, (light, _) in COLOURS.items():
        svg = svg.replace(light, f"var(--{name})")
    # Fixed sizes in points would keep it from following the width of its column.
    svg = re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", svg, count=1)
    svg = re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", svg, count=1)
    wide = ' class="wide"' if width > WIDTH else ""
    below = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
    return Html(f"<figure{wide}>{svg}{below}</figure>")


def save_plot(path: Path, draw: Callable[[Figure], object], *, width: int, height: int) -> None:
    """Write a plot as a PNG in light colours, for the docs. width, height : CSS pixels."""
    with _figure(width, height) as figure:
        draw(figure)
        figure.savefig(path, dpi=PICTURE_DPI, metadata={"Software": None})


@contextmanager
def _figure(width: int, height: int) -> Iterator[Figure]:
    """A figure with the style of all plots, without the global state of pyplot."""
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context(_style()):
        yield Figure(figsize=(width / _DPI, height / _DPI), dpi=_DPI, layout="constrained")


def _style() -> Any:
    from cycler import cycler

    cycle = cycler(color=[colour(name) for name in SERIES])
    names = ("xtick.color", "ytick.color", "axes.labelcolor")
    return {
        **dict.fromkeys(names, colour("quiet")),
        **dict.fromkeys(("text.color", "axes.titlecolor"), colour("text")),
        **dict.fromkeys(("figure.facecolor", "axes.facecolor", "savefig.facecolor"), colour("panel")),
        **dict.fromkeys(("axes.spines.top", "axes.spines.right"), False),
        **{"axes.edgecolor": colour("line"), "axes.grid": True, "grid.color": colour("grid")},
        **{"axes.prop_cycle": cycle, "axes.axisbelow": True, "axes.titlelocation": "left"},
        **{"font.size": 10, "axes.titlesize": 11, "axes.labelsize": 10, "legend.fontsize": 9},
        **{"font.family": "sans-serif", "lines.linewidth": 1.6, "lines.markersize": 4},
        **{"legend.frameon": False, "svg.fonttype": "none", "svg.hashsalt": "tactflow"},
    }
