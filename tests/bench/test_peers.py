from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks.peers import contact, dots, page
from benchmarks.peers.common import another, lines, recording, search
from tactflow.bench.scenes import Case

DOCS = Path(__file__).resolve().parents[2] / "docs"


def test_every_number_of_the_page_is_in_the_file_beside_it() -> None:
    numbers = json.loads((DOCS / "peers.json").read_text())
    assert (DOCS / "peers.md").read_text(encoding="utf-8") == page.text(numbers, "peers.jpg")


def test_what_a_peer_does_better_is_bold() -> None:
    errors = {"tactflow": 0.2, "better": 0.1, "equal when shown": 0.199, "worse": 0.3}
    rows = list(page.table([("error", errors.get, ".2f", -1)], [*errors, "unknown"]))
    assert [row.split(" | ")[-1] for row in rows[2:]] == ["0.20 |", "**0.10** |", "0.20 |", "0.30 |", "- |"]


def test_tactflow_is_measured_where_no_peer_is_installed(tmp_path: Path) -> None:
    case = Case("press", 24)
    found = dots.on_scenes([case], tmp_path, ["tactflow"])
    assert found["all"]["tactflow"]["displacement_rms"] < 0.05
    assert found["all"]["tactflow"]["lost_percent"] == 0
    assert found["ms"]["tactflow"] > 0
    found = contact.on_scenes([case], tmp_path, ["OpenCV difference"])
    assert found["all"]["tactflow, noise"]["contact_iou"] > found["all"]["OpenCV difference"]["contact_iou"]
    assert found["all"]["tactflow, noise"]["false_contacts"] == 0


def test_a_method_that_raises_has_lost_its_dots(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    class Failing(dots.Tactflow):
        def track(self, picture: object) -> None:
            raise RuntimeError(f"cannot go on with {type(picture).__name__}")

        def __init__(self, reference: object) -> None:
            """Nothing to prepare."""

    monkeypatch.setitem(dots.METHODS, "failing", Failing)
    _, pictures, truths = recording(Case("press", 3), tmp_path)
    errors = dots.errors_of(pictures, truths, "failing", {})
    assert errors["lost_percent"] == 100
    assert "displacement_rms" not in errors


def test_the_search_changes_one_setting_after_the_other() -> None:
    best = search({"a": (1, 2, 3), "b": (5, 4)}, lambda tried: abs(tried["a"] - 3) + abs(tried["b"] - 4))
    assert best == {"a": 3, "b": 4}


def test_lines_of_an_adapter_are_those_of_code() -> None:
    def adapter(x: int) -> int:
        """Not counted."""

        # Nor is this.
        return x + 1

    assert lines(adapter) == 2


def test_another_recording_is_half_as_long_and_of_another_seed() -> None:
    assert another(Case("jumps", 40, "worn=0.05")) == Case("jumps", 20, "worn=0.05&seed=11")
