from __future__ import annotations

from pathlib import Path

import pytest

from tactflow.bench.quantities import QUANTITIES
from tactflow.bench.results import BenchResult, load_errors, regressions
from tactflow.engine.errors import ConfigError


def run(scene: str = "press", quick: bool = True, **errors: float) -> BenchResult:
    result = BenchResult(quick, copy_ms=0.1)
    result.add("tracker", "pattern", scene, errors, times={"contact": [0.003, 0.001, 0.002]}, frames=3)
    return result


def worse(result: BenchResult, stored: BenchResult, scenes: set[str] | None = None) -> list[str]:
    return regressions(result, {m.key: m.errors for m in stored.measured}, scenes)


def test_what_got_worse_by_more_than_its_tolerance_is_named() -> None:
    stored = run(displacement_rms=0.02)
    within = QUANTITIES["displacement_rms"].allowed(0.02)
    assert worse(run(displacement_rms=within), stored) == []
    (line,) = worse(run(displacement_rms=within + 1e-6), stored)
    assert line.startswith("tracker/pattern/press: marker displacement error, RMS: was 0.02, allowed 0.026")
    assert len(worse(run(marker_recall=0.8), run(marker_recall=0.9))) == 1
    assert worse(run(marker_recall=1.0), run(marker_recall=0.9)) == []


def test_a_quantity_that_is_no_longer_measured_is_a_regression_unless_its_scene_was_not_chosen() -> None:
    stored = run(displacement_rms=0.02)
    (line,) = worse(run(wrong_percent=0.0), stored)
    assert line.endswith("no longer measured")
    assert len(worse(run(scene="cable", displacement_rms=0.02), stored)) == 1
    assert worse(run(scene="cable", displacement_rms=0.02), stored, {"cable"}) == []


@pytest.mark.parametrize("text", ["", "[1]", '{"schema": "other/1"}', '{"schema": "tactflow.bench/3"}'])
def test_a_file_that_is_not_a_result_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "x.json"
    path.write_text(text)
    with pytest.raises(ConfigError, match=r"x\.json"):
        load_errors(path, quick=True)
