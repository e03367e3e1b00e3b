"""The comparison of stages with their alternatives: its truths, and its page."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from lab import swaps
from lab.judges.judge import settings_of
from lab.judges.judge_dots import pipeline_finder
from tactflow.engine.errors import ConfigError
from tactflow.sim import open_scene
from tactflow.tools.bench.metrics import match_points
from tactflow.vision.markers.detection import detect_markers


def test_a_dragged_picture_shows_the_dots_where_the_truth_says() -> None:
    picture = cv2.resize(
        open_scene("press?frames=2").frame(0), None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA
    )
    rest = detect_markers(picture)
    moved = rest.centers + swaps.displaced(rest.centers, picture.shape, 0.8 * rest.pitch)
    assert np.linalg.norm(moved - rest.centers, axis=1).max() > 0.5 * rest.pitch
    found = detect_markers(
        swaps.warped(picture, 0.8 * rest.pitch, seed=1), dot_radius=rest.dot_radius
    ).centers
    pairs = match_points(found, moved, rest.pitch / 2)
    assert (pairs >= 0).all()
    error = np.linalg.norm(found[pairs] - moved, axis=1)
    assert np.sqrt((error**2).mean()) < 0.1


def test_a_stage_swapped_by_a_setting_is_judged() -> None:
    picture = open_scene("press?frames=2").frame(0)
    for settings, mask in (
        (["stages.tracker.use=nearest_dots"], False),
        (["stages.marker_mask.use=top_hat"], True),
    ):
        assert len(pipeline_finder("default", settings_of(settings), mask)(picture)) == 80
    blank = np.full((80, 90, 3), 100, np.uint8)
    assert len(pipeline_finder("default", {})(blank)) == 0
    with pytest.raises(ConfigError, match=r"required A\.B=VALUE"):
        settings_of(["stages.fusion"])


def test_the_page_has_every_way_to_do_a_stages_work_and_marks_what_is_better(tmp_path: Path) -> None:
    stored = {
        "values": {
            f"tracker/{name}/{scene}": {"displacement_rms": rms, "contact_ms": 2.0, "frames": 5.0}
            for name, rms in (("default", 0.02), ("rlof", 0.01), ("dis_flow", 0.3))
            for scene in ("press", "slide")
        }
    }
    bench = tmp_path / "bench.json"
    bench.write_text(json.dumps(stored))
    page = tmp_path / "swap.md"
    page.with_suffix(".json").write_text(json.dumps({"machine": {"CPU": "x"}}))
    assert swaps.main(["--bench", str(bench), "--page", str(page), "--only", "bench"]) == 0
    text = page.read_text()
    assert "| rlof | 2.00 | **0.010** |" in text
    assert "| dis_flow | 2.00 | 0.300 |" in text
    # Everything registered has a row, measured or not, and says when to take it.
    assert "| nearest_dots | - | - |" in text
    assert "- `otsu`: Use it as the usual first script" in text
