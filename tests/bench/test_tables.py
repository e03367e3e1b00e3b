"""The tables in the terminal."""

from __future__ import annotations

from itertools import pairwise

import pytest

from tactflow.bench.results import BenchResult
from tactflow.bench.tables import sections
from tactflow.report import markdown


@pytest.fixture
def result() -> BenchResult:
    """Methods for trackers, one of which has nothing to say about a scene; whole pipelines."""
    result = BenchResult(quick=True, copy_ms=0.1)
    for method, scene, ms, rms, wrong in (
        ("slow & <exact>", "press", 5.0, 0.01, 0),
        ("slow & <exact>", "cable", 6.0, 0.02, 0),
        ("fast", "press", 0.5, 0.1, 1),
        ("fast", "cable", 0.6, 0.3, 3),
        ("bad", "press", 7.0, 0.5, 9),
        ("bad", "cable", 7.0, 0.5, 9),
        ("only easy scenes", "press", 0.1, 0.001, 0),
    ):
        errors = {"displacement_rms": rms, "wrong_percent": wrong}
        result.add("tracker", method, scene, errors, times={"contact": [ms / 1e3]}, frames=1)
    scored = {"displacement_rms": 0.01, "hull_iou": 0.97, "false_contacts": 0, "missed_contacts": 4}
    result.add(
        "pipeline", "default", "press", scored, times={"contact": [0.0015], "idle": [0.0001]}, frames=2
    )
    result.failures["pipeline/classic/press"] = "no markers\nmore"
    return result


def test_every_kind_of_measurement_has_its_row(result: BenchResult) -> None:
    lines = list(markdown(sections(result)))
    rows = [" ".join(line.split()) for line in lines if line.startswith("|")]
    assert "| fast | 0.55 | 5.5 | - | - | 0.2 (0.3) | - | 2 (3) |" in rows
    assert "| press | default | 1.5 | -, - | 0.01 | -, - | 0, 4, - | 0.97 | - | - | - |" in rows
    assert "| pipeline/classic/press | no markers |" in rows
    for above, below in pairwise(lines):
        if above.startswith("|") and below.startswith("|"):
            assert len(above) == len(below)
