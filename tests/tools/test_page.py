"""Pages: one file, escaped text, plots that follow the colours of the page."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path
from typing import Any

import cv2
import pytest

from tactflow.tools.page import (
    Html,
    Section,
    colour,
    key,
    marked,
    multiples,
    page,
    plot,
    save_plot,
    series,
    table,
)


def draw(figure: Any) -> None:
    axes = figure.subplots()
    axes.plot([1, 10, 100], [1, 4, 16], color=series(1))
    axes.plot([1, 10, 100], [1, 2, 4], color=colour("quiet"))
    axes.set(xscale="log", title="<error>", xlabel="noise")


def test_text_is_escaped_and_html_is_not() -> None:
    found = table(["<what>"], [["a < b", marked("broken & bad", "bad"), 1.5, Html("<i>x</i>")]])
    assert "<th>&lt;what&gt;</th>" in found
    assert '<td>a &lt; b</td><td><b class="bad">broken &amp; bad</b></td>' in found
    assert '<td class="number">1.5</td><td><i>x</i></td>' in found


def test_a_page_needs_nothing_from_elsewhere_and_links_its_sections() -> None:
    sections = [
        Section("Same answer", "Two.\n\nParagraphs."),
        Section("Noise & light", body=[key(["a", "b"])]),
    ]
    written = page("Stability of <x>", sections, "lead")
    assert "<h1>Stability of &lt;x&gt;</h1>" in written
    assert re.findall(r'<a href="#([^"]*)"', written) == re.findall(r'<h2 id="([^"]*)"', written)
    assert not re.findall(r'(?:src|href)="(?!#)', written)
    assert "prefers-color-scheme: dark" in written


def test_a_plot_has_the_colours_of_the_page_and_no_size_of_its_own() -> None:
    written = plot(draw, caption="error")
    assert written.startswith("<figure><svg")
    assert "var(--series-2)" in written
    assert "var(--quiet)" in written
    assert "&lt;error&gt;" in written
    assert not re.search(r'<svg[^>]* (width|height)="', written)
    assert plot(draw, caption="error") == written


def test_without_matplotlib_the_page_says_once_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *a: None if name == "matplotlib" else find(name, *a)
    )
    written = page("Stability", [Section("Noise", body=[multiples([plot(draw)]), multiples([plot(draw)])])])
    assert written.count("pip install &#x27;tactflow[plot]&#x27;") == 1
    assert "tactflow[plot]" in page("Map", [Section("Surface", body=[plot(draw)])])
    assert "tactflow[plot]" not in page("Map", [Section("Surface", "no plots here")])


def test_a_plot_may_shrink_with_the_screen_instead_of_being_scrolled() -> None:
    assert plot(draw, width=500).startswith('<figure class="wide">')
    assert plot(draw, width=500, shrinks=True).startswith('<figure style="max-width: 500px">')


def test_a_plot_can_be_saved_for_the_docs(tmp_path: Path) -> None:
    save_plot(tmp_path / "plot.png", draw, width=300, height=200)
    picture = cv2.imread(str(tmp_path / "plot.png"))
    assert picture is not None
    assert picture.shape == (400, 600, 3)
