from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.peers import contact, depth, dots, page
from benchmarks.peers.__main__ import CONTACTS, SCENES, available, cases
from benchmarks.peers.common import errors_of, recording
from tactflow.bench.scenes import Case
from tactflow.calibration.presses import Press
from tactflow.sim import open_scene
from tactflow.vision.types import Scale

DOCS = Path(__file__).resolve().parents[2] / "docs"


def test_every_number_of_the_page_is_in_the_file_beside_it() -> None:
    numbers = json.loads((DOCS / "peers.json").read_text())
    assert (DOCS / "peers.md").read_text(encoding="utf-8") == page.text(numbers, "peers.jpg")


def test_what_a_peer_does_better_is_bold() -> None:
    numbers = {"error": {"tactflow": 0.2, "better": 0.1, "equal when shown": 0.199, "worse": 0.3}}
    methods = [*numbers["error"], "unknown"]
    rows = list(page.table(numbers, [("where: error", "error|*", ".2f", -1)], methods))
    assert [row.split(" | ")[-1] for row in rows[2:]] == ["0.20 |", "**0.10** |", "0.20 |", "0.30 |", "- |"]


def test_tactflow_is_measured_where_no_peer_is_installed(tmp_path: Path) -> None:
    case = Case("press", 24)
    found = dots.on_named([case], tmp_path, ["tactflow"])
    assert found["all"]["tactflow"]["displacement_rms"] < 0.05
    assert found["all"]["tactflow"]["lost_percent"] == 0
    assert found["ms"]["tactflow"] > 0
    found = contact.on_named([case], tmp_path, ["OpenCV difference"])
    assert found["all"]["tactflow"]["contact_iou"] > found["all"]["OpenCV difference"]["contact_iou"]
    assert found["all"]["tactflow"]["false_contacts"] == 0


def test_a_method_that_raises_has_lost_its_dots(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    class Failing(dots.Tactflow):
        def track(self, picture: object) -> None:
            raise RuntimeError(f"cannot go on with {type(picture).__name__}")

        def __init__(self, reference: object) -> None:
            """Nothing to prepare."""

    monkeypatch.setitem(dots.METHODS, "failing", Failing)
    errors = errors_of(dots.follow, recording(Case("press", 3), tmp_path), "failing", {})
    assert errors["lost_percent"] == 100
    assert "displacement_rms" not in errors


def test_a_perfect_answer_to_a_ball_has_no_error_wherever_its_outline_says_that_it_is() -> None:
    scale, radius, (x, y) = Scale(0.1, 0.1, (0.0, 0.0), (0.0, 0.0)), 3.0, np.mgrid[:80, :100][::-1]
    dx, dy = (x - 52.0) * scale.x, (y - 41.0) * scale.y
    mask = np.where(np.hypot(dx, dy) < 2.0, 255, 0).astype(np.uint8)
    picture, hidden = np.zeros((80, 100, 3), np.uint8), np.zeros((80, 100), np.bool_)
    press = Press(1, picture, mask, hidden, (50.0, 40.0), 20.0)
    height = np.sqrt(np.maximum(radius**2 - dx**2 - dy**2, 1.0))
    slopes = np.dstack([-dx, -dy]) / height[..., None]
    angle, cap = depth.errors_on(press, (slopes, height), scale, radius)
    assert angle < 1e-4
    assert abs(cap) < 1e-9
    flatter = depth.errors_on(press, (0.5 * slopes, 0.5 * height), scale, radius)
    assert flatter[0] > 5
    assert flatter[1] == pytest.approx(-0.5, abs=0.01)


def test_the_scenes_of_the_command_exist_and_tactflow_is_always_measured() -> None:
    for case in cases(f"{SCENES} {CONTACTS}", 4):
        assert len(open_scene(f"{case.name}?frames=4&{case.query}".rstrip("&"))) == 4
    assert "tactflow" in available(dots.METHODS)
    assert {"classic script", "OpenCV difference"} <= set(available(contact.PEERS))
