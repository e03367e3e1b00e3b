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
`axes.plot(x, y, color=series(0))` for the colour of the first name of a `key`. Without matplotlib, plots are
omitted, and the page says once how to install it. `save_plot` writes the same drawing as a picture of the
docs.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from html import escape
from importlib.resources import files
from io import StringIO
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING, Any

from tactflow.drawing.plots import COLOURS, PICTURE_DPI, SERIES, styled_figure
from tactflow.drawing.plots import colour as colour
from tactflow.drawing.plots import dashes as dashes
from tactflow.drawing.plots import series as series
from tactflow.system.extras import missing

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


class Html(str):
    """Text that is HTML already; any other text is escaped."""

    __slots__ = ()


WIDTH, HEIGHT = 360, 240
"""Size of a small plot, CSS pixels."""
OMITTED = Html("<!-- a plot, without matplotlib -->")
"""Stands for a plot that cannot be drawn."""
DECADES_FROM = 30
"""Range of an axis, highest over lowest value, from which powers of ten are marks enough."""


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
    remedy = missing("plots", "plot", ["matplotlib"]) if any(OMITTED in part for part in parts) else None
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
    """A table. A cell that is `Html` is put in as it is; a number, or a dash for none, is
    aligned to the right.

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
    kind = ' class="number"' if re.fullmatch(r"-|([<>] )?[-+−]?[\d.,]+(e[-+]?\d+)?( %)?", text) else ""
    return f"<td{kind}>{escape(text)}</td>"


def marked(text: str, kind: str) -> Html:
    """Text in one of the colours good, warn, bad, quiet."""
    return Html(f'<b class="{kind}">{escape(text)}</b>')


def details(summary: str, *body: Html) -> Html:
    """Fragments that are folded away until the reader opens them."""
    return Html(f"<details><summary>{escape(summary)}</summary>{''.join(body)}</details>")


def key(names: Sequence[str]) -> Html:
    """Which colour is which name, in the order of `series`, for all plots below; striped once the colours
    repeat."""
    items = (
        f"<span><i{' class=striped' if i >= len(SERIES) else ''} "
        f'style="--ink: var(--{SERIES[i % len(SERIES)]})"></i>{escape(name)}</span>'
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
    label: str = "",
    width: int = WIDTH,
    height: int = HEIGHT,
    shrinks: bool = False,
) -> Html:
    """A plot as SVG in the page; without matplotlib `OMITTED`, for which `page` says what is missing.

    draw : draws on a figure. caption : below it. label : for readers who cannot see it.
    width, height : CSS pixels. shrinks : on narrow screens, one wider than `WIDTH` is made narrower instead
    of being scrolled; elsewhere it has this width.
    """
    if missing("plots", "plot", ["matplotlib"]):
        return OMITTED
    written = StringIO()
    with styled_figure(width, height) as figure:
        draw(figure)
        figure.savefig(written, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    svg = written.getvalue()
    svg = svg[svg.index("<svg") :].replace(
        "<svg", f'<svg role="img" aria-label="{escape(label or caption)}"', 1
    )
    for name, (light, _) in COLOURS.items():
        svg = svg.replace(light, f"var(--{name})")
    # Fixed sizes in points would keep it from following the width of its column.
    svg = re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", svg, count=1)
    svg = re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", svg, count=1)
    wide = ' class="wide"' if width > WIDTH else ""
    if shrinks:
        wide = f' style="max-width: {width}px"'
    below = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
    return Html(f"<figure{wide}>{svg}{below}</figure>")


def plain_numbers(axes: Axes) -> None:
    """Write 0.2 instead of a power of ten on the logarithmic axes of a plot, whose limits are known."""
    from matplotlib.ticker import LogLocator

    for axis in (axes.xaxis, axes.yaxis):
        if axis.get_scale() == "log":
            low, high = sorted(axis.get_view_interval())
            axis.set_major_locator(LogLocator(subs=(1.0,) if high > DECADES_FROM * low else (1.0, 2.0, 5.0)))
            axis.set_major_formatter(lambda value, _: f"{value:,.10g}")
            axis.set_minor_formatter("")


def save_plot(path: Path, draw: Callable[[Figure], object], *, width: int, height: int) -> None:
    """Write a plot as a PNG in light colours, for the docs. width, height : CSS pixels."""
    with styled_figure(width, height) as figure:
        draw(figure)
        figure.savefig(path, dpi=PICTURE_DPI, metadata={"Software": None})
