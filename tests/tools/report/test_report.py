"""`tactflow report`: a page for any run."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

import tactflow
from tactflow.drawing.curves import QUANTITIES, collected
from tactflow.tools.report.page import collect
from tactflow.tools.report.results import read_results
from tests.terminal import Terminal

FRAMES = 70


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one run as lines, tables and a recording, and its statistics."""
    pytest.importorskip("pyarrow", reason="the extra parquet is not installed")
    pytest.importorskip("mcap", reason="the extra record is not installed")
    folder = tmp_path_factory.mktemp("run")
    sinks = {
        "jsonl": {"path": str(folder / "run.jsonl"), "detail": True},
        "parquet": {"path": str(folder / "run")},
        "record": {"path": str(folder / "run.mcap")},
    }
    done = tactflow.run("default", source="sim:press", settings={"sinks": sinks}, max_frames=FRAMES)
    (folder / "stats.json").write_text(json.dumps(done.stats))
    return folder


@pytest.mark.parametrize("name", ["run", "run/frames", "run.mcap"])
def test_every_format_gives_the_numbers_of_the_lines(run: Path, name: str) -> None:
    lines, other = (collect(read_results(run / file))["main"] for file in ("run.jsonl", name))
    assert lines.frames == FRAMES
    assert lines.summary.touching > 20
    assert other.frames == lines.frames
    assert other.skipped == lines.skipped
    assert other.curves.contacts() == lines.curves.contacts()
    assert [q.title for q in other.curves.present()] == [q.title for q in lines.curves.present()]
    for quantity in lines.curves.present():
        for label in quantity.curves:
            values = (report.curves.values(quantity, label) for report in (lines, other))
            assert next(values).tolist() == pytest.approx(next(values).tolist(), nan_ok=True, abs=1e-3)


def test_the_page_has_curves_pictures_what_was_skipped_and_where_time_went(
    run: Path, terminal: Terminal
) -> None:
    pytest.importorskip("matplotlib", reason="the extra plot is not installed")
    arguments = ("report", str(run / "run.mcap"), "--stats", str(run / "stats.json"), "--out", "page.html")
    assert terminal(*arguments) == 0
    page = Path("page.html").read_text(encoding="utf-8")
    titles = ("Area of the contact", "Mean flow in contact", "Largest contacts", "Where time went")
    assert [title for title in titles if title not in page] == []
    assert page.count("<svg") >= 5
    assert page.count("data:image/jpeg;base64,") == 1
    assert re.search(r"<td>hull</td>", page)
    assert re.search(r"no_contact", page)
    assert re.findall(r'(?:src|href)="(?!data:|#)[^"]*', page) == []
    assert terminal(*arguments) == 2
    assert "page.html" in terminal.err


def test_without_matplotlib_the_page_has_its_tables_and_says_what_to_install(
    run: Path, terminal: Terminal, monkeypatch: pytest.MonkeyPatch
) -> None:
    remedy = "plots need matplotlib: pip install 'tactflow[plot]'"
    monkeypatch.setattr("tactflow.tools.page.missing", lambda *_: remedy)
    assert terminal("report", str(run / "run.jsonl"), "--out", "page.html") == 0
    page = Path("page.html").read_text(encoding="utf-8")
    assert "<svg" not in page
    assert "tactflow[plot]" in page
    assert "begins, s" in page


def test_a_line_that_a_kill_cut_off_is_left_out_and_a_damaged_one_is_named(run: Path, tmp_path: Path) -> None:
    whole = (run / "run.jsonl").read_bytes()
    (tmp_path / "cut.jsonl").write_bytes(whole[:-20])
    assert len(list(read_results(tmp_path / "cut.jsonl"))) == FRAMES - 1
    (tmp_path / "damaged.jsonl").write_bytes(b"{}\n" + whole)
    with pytest.raises(tactflow.ConfigError, match=r"damaged.jsonl: line 1: required a message"):
        list(read_results(tmp_path / "damaged.jsonl"))


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("gone.jsonl", None, "there is no such file"),
        ("empty.jsonl", b"", "holds no results"),
        ("film.avi", b"RIFF", "required results as .jsonl, .mcap and .parquet"),
        ("bad.parquet", b"no table", "bad.parquet: "),
        ("bad.mcap", b"no recording", "bad.mcap: "),
    ],
)
def test_what_holds_no_results_is_refused(
    name: str, content: bytes | None, words: str, terminal: Terminal
) -> None:
    if content is not None:
        Path(name).write_bytes(content)
    assert terminal("report", name) == 2
    assert words in terminal.err
    assert not Path(name).with_suffix(".html").exists()


@pytest.mark.parametrize("text", ["{}", "[1]", "no JSON"])
def test_a_file_without_statistics_is_refused(run: Path, text: str, terminal: Terminal) -> None:
    Path("stats.json").write_text(text)
    assert terminal("report", str(run / "run.jsonl"), "--stats", "stats.json") == 2
    assert "--stats stats.json: not a statistics file" in terminal.err


def test_results_are_plotted_in_a_notebook(run: Path) -> None:
    pytest.importorskip("matplotlib", reason="the extra plot is not installed")
    figure = tactflow.plot(read_results(run / "run.jsonl"))
    assert figure.axes[0].get_title(loc="left") == "Area of the contact, px²"
    with pytest.raises(ValueError, match="no results to plot"):
        tactflow.plot([])


def test_only_quantities_that_a_run_has_are_plotted() -> None:
    contact = {"area": 3.0, "center": [1.0, 2.0], "depth_mm": 0.5}
    force = {"value": [None, None, 4.0]}
    curves = collected([{"t": 5.0, "contact": None}, {"t": 5.5, "contact": contact, "force": force}])
    assert [quantity.unit for quantity in curves.present()] == ["px²", "px", "mm", "N"]
    assert curves.values(QUANTITIES[5], "z").tolist() == pytest.approx([float("nan"), 4.0], nan_ok=True)
    assert curves.contacts() == [(0.5, 0.5)]
