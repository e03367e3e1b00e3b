"""Reports: one self-contained HTML file."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from tactflow.engine.errors import ConfigError, StageError
from tactflow.report import Section, Table, figure, link, mark, picture, write_report


def written(path: Path, *sections: Section) -> str:
    return write_report(path / "report.html", "Times & errors", sections, "On two cores.").read_text()


def test_text_is_escaped_and_numbers_keep_four_digits(tmp_path: Path) -> None:
    table = Table(
        ["method", "time, ms", ""], [["<b>", 1.23456, mark("met", True)], ["slow", None, link("x", "y")]]
    )
    page = written(tmp_path, Section("Which < one?", "First.\n\nSecond.", tables=[table]))
    assert "<h1>Times &amp; errors</h1>" in page
    assert "<h2>Which &lt; one?</h2><p>First.</p><p>Second.</p>" in page
    assert "<td>&lt;b&gt;</td><td class=number>1.235</td>" in page
    assert '<td class=number>–</td><td><a href="y">x</a></td>' in page


def test_pictures_and_plots_stand_in_the_file(tmp_path: Path) -> None:
    drawing, axes = figure()
    axes.plot([1, 2], [3, 4])
    axes.set_xlabel("time, ms")
    page = written(
        tmp_path,
        Section("Plots", pictures=[picture(np.zeros((4, 4, 3), np.uint8), "dark"), picture(drawing)]),
    )
    assert "data:image/png;base64," in page
    assert "<figcaption>dark</figcaption>" in page
    assert "time, ms</text>" in page
    assert not re.search(r"(?:src|href)=[\"']?https?:", page)
    HTMLParser().feed(page)


def test_a_plot_without_matplotlib_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _name: None)
    with pytest.raises(ConfigError, match=re.escape("plots need matplotlib: pip install 'tactflow[plot]'")):
        figure()


def test_a_place_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(StageError, match=r"report\.html: cannot be written: "):
        written(tmp_path / "file")
