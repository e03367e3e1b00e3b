"""`explain` and `graph` tell what a pipeline does and why."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any

import pytest

from tests.terminal import Terminal

PARTS = Path(__file__).resolve().parents[1] / "config" / "parts.py"
TEXT = """\
stages:
  capture: {use: './parts.py:Source'}
  prepare: {use: './parts.py:Prepare'}
  unused: {use: './parts.py:Needy', path: a}
  compare: {use: './parts.py:Compare', segment: heavy, queue: {capacity: 2, when_full: drop_oldest}}
  outline: {use: './parts.py:Outline', when: touching}
  refine: {use: './parts.py:Refine', in: {flow: null}}
sinks:
  out: {use: './parts.py:Publish', max_rate: 5}
  view: {use: './parts.py:Viewer'}
"""
STATISTICS: dict[str, Any] = {
    "frames": 100,
    "dropped": 2,
    "wall_s": 1.5,
    "end": "eos",
    "stages": {
        "capture": {"runs": 102, "skips": {}, "total_ms": 12.0, "p50_ms": 0.1, "p99_ms": 0.2},
        "outline": {
            "runs": 40,
            "skips": {"unchanged": 15, "no_contact": 44, "error": 1, "unused": 0},
            "total_ms": 12.0,
            "p50_ms": 0.25,
            "p99_ms": 0.5,
        },
        "compare": {"runs": 0, "skips": {}, "total_ms": 0.0, "p50_ms": None, "p99_ms": None},
    },
    "sinks": {},
    "links": {},
    "latency_ms": {"p50": 2.0, "p99": 5.0},
}


@pytest.fixture
def pipeline(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a pipeline whose parts are gated, pruned, stateful."""
    shutil.copy(PARTS, tmp_path / "parts.py")
    (tmp_path / "pipeline.yaml").write_text(TEXT)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def paragraphs(text: str) -> dict[str, dict[str, str]]:
    """Node -> fact -> text."""
    found = {}
    for block in text.strip().split("\n\n")[1:]:
        title, *lines = block.splitlines()
        facts = (tuple(re.split(r" {2,}", line.strip(), maxsplit=1)) for line in lines)
        found[title.split()[0]] = dict(facts)
    return found


@pytest.mark.usefixtures("pipeline")
def test_each_stage_says_why_it_runs_and_when_it_is_skipped(terminal: Terminal) -> None:
    assert terminal("explain") == 0
    facts = paragraphs(terminal.out)
    assert list(facts) == ["capture", "prepare", "unused", "compare", "outline", "refine", "out", "view"]
    assert facts["capture"]["runs because"] == "it captures the frames"
    assert facts["prepare"]["runs because"] == "out and view need it"
    assert facts["compare"]["runs because"] == "out needs it"
    assert facts["compare"]["memory"].startswith("stateful")
    assert facts["compare"]["segment"] == "heavy"
    assert facts["outline"]["memory"].startswith("pure:")
    assert facts["out"]["runs because"] == "it is a sink, at most 5 times a second"
    assert facts["unused"] == {
        "left out because": "no sink needs its output",
        "memory": "pure: runs only when its result is needed",
        "is": "./parts.py:Needy",
    }
    assert facts["outline"]["skipped when"] == (
        "compare.touching is false (its outputs are absent: no_contact); compare gives no contact_mask"
    )
    assert facts["refine"]["skipped when"] == "outline gives no contact"
    assert "skipped when" not in facts["prepare"]
    assert "skipped when" not in facts["out"]
    terminal("explain", "--set", "skipping=false")
    out = terminal.out
    assert "skipping is off" in out
    assert "touching" not in out


def test_statistics_say_how_often_and_what_it_cost(pipeline: Path, terminal: Terminal) -> None:
    (pipeline / "run.json").write_text(json.dumps(STATISTICS))
    assert terminal("explain", "--stats", "run.json") == 0
    out = terminal.out
    assert "the run: 100 frames in 1.5 s, 2 dropped, latency p50 2 ms, p99 5 ms, ended: end of source" in out
    facts = paragraphs(out)
    # 59 frames left out at 0.3 ms each, over 100 frames; the failed one is no gain.
    assert facts["outline"]["statistics"] == (
        "ran 40 %, skipped 44 % no contact, 15 % unchanged, 1 % error; "
        "a run: mean 0.3 ms, p50 0.25 ms, p99 0.5 ms; saved 0.177 ms of 0.297 ms a frame"
    )
    assert facts["compare"]["statistics"] == "never reached by a frame"
    assert facts["prepare"]["statistics"] == "not part of that run"
    assert "statistics" not in facts["unused"]


@pytest.mark.parametrize("content", ["{", "{}"])
def test_a_file_without_statistics_is_refused(content: str, pipeline: Path, terminal: Terminal) -> None:
    (pipeline / "run.json").write_text(content)
    assert terminal("explain", "--stats", "run.json") == 2
    assert terminal.err.startswith("tactflow: --stats run.json: not ")


@pytest.mark.usefixtures("pipeline")
def test_the_graph_shows_segments_edges_gates_queues_and_pruned_stages(terminal: Terminal) -> None:
    assert terminal("graph") == 0
    lines = [line.strip() for line in terminal.out.splitlines()]
    assert lines[0] == "flowchart LR"
    assert 'subgraph s1["segment compute"]' in lines
    assert any(re.fullmatch(r'subgraph s\d\["segment heavy"\]', line) for line in lines)
    ids = {name: key for line in lines for key, name in re.findall(r'(n\d)[\[(/]+"(\w+)"', line)}
    assert set(ids) == {"capture", "prepare", "unused", "compare", "outline", "refine", "out", "view"}
    assert f'{ids["capture"]} -->|"frame"| {ids["prepare"]}' in lines
    assert f'{ids["compare"]} -.->|"when touching"| {ids["outline"]}' in lines
    assert f'{ids["unused"]}["unused"]:::pruned' in lines
    assert any('"queue: drop_oldest, 2"' in line for line in lines)
    assert lines.count("end") == sum(line.startswith("subgraph") for line in lines)
