from __future__ import annotations

from pathlib import Path

import pytest

from tactflow.bench import compare
from tactflow.bench.quantities import QUANTITIES
from tactflow.bench.results import Measurement, Result, load_errors
from tactflow.engine.errors import ConfigError


def run(scene: str = "press", quick: bool = True, **errors: float) -> Result:
    return Result(quick=quick, measurements=[Measurement("tracker", "pattern", scene, errors=errors)])


def stored(tmp_path: Path, result: Result) -> Path:
    path = tmp_path / "stored.json"
    result.save_errors(path)
    return path


def test_the_same_errors_are_no_regression(tmp_path: Path) -> None:
    result = run(displacement_rms=0.02, marker_recall=0.99, shared_dots=0.0)
    assert compare.against(result, stored(tmp_path, result)) == []


def test_a_whole_result_can_be_compared_with_as_well(tmp_path: Path) -> None:
    result = run(displacement_rms=0.02)
    result.save(tmp_path / "bench.json")
    assert compare.against(result, tmp_path / "bench.json") == []
    assert load_errors(tmp_path / "bench.json") == (
        True,
        {"tracker/pattern/press": {"displacement_rms": 0.02}},
    )


def test_what_got_worse_by_more_than_its_tolerance_is_named(tmp_path: Path) -> None:
    path = stored(tmp_path, run(displacement_rms=0.02))
    within = QUANTITIES["displacement_rms"].allowed(0.02)
    assert compare.against(run(displacement_rms=within), path) == []
    (found,) = compare.against(run(displacement_rms=within + 1e-6), path)
    assert "tracker/pattern/press" in str(found)
    assert "was 0.02" in str(found)


def test_a_recall_that_falls_is_worse_and_one_that_rises_is_not(tmp_path: Path) -> None:
    path = stored(tmp_path, run(marker_recall=0.9))
    assert compare.against(run(marker_recall=1.0), path) == []
    assert len(compare.against(run(marker_recall=0.8), path)) == 1


def test_a_quantity_that_is_no_longer_measured_is_a_regression(tmp_path: Path) -> None:
    path = stored(tmp_path, run(displacement_rms=0.02))
    (found,) = compare.against(run(wrong_percent=0.0), path)
    assert found.now is None
    assert len(compare.against(run(scene="cable", displacement_rms=0.02), path)) == 1


def test_scenes_that_were_not_chosen_are_not_missed(tmp_path: Path) -> None:
    path = stored(tmp_path, run(displacement_rms=0.02))
    assert compare.against(run(scene="cable", displacement_rms=0.02), path, scenes={"cable"}) == []
    assert len(compare.against(run(scene="cable"), path, scenes={"cable", "press"})) == 1


def test_recordings_that_are_not_here_are_not_missed(tmp_path: Path) -> None:
    path = stored(tmp_path, run(scene="data:wedge_ball", found_percent=100.0))
    assert compare.against(run(), path) == []
    assert len(compare.against(run(scene="data:wedge_ball", found_percent=90.0), path)) == 1


def test_a_quick_run_is_not_compared_with_a_full_one(tmp_path: Path) -> None:
    path = stored(tmp_path, run(quick=False, displacement_rms=0.02))
    with pytest.raises(ConfigError, match="full run"):
        compare.against(run(displacement_rms=0.02), path)


@pytest.mark.parametrize("text", ["", "{}", "[1]", '{"schema": "other/1"}'])
def test_a_file_that_is_not_a_result_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "x.json"
    path.write_text(text)
    with pytest.raises(ConfigError, match=r"x\.json"):
        load_errors(path)


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be read"):
        load_errors(tmp_path / "nothing.json")
