from __future__ import annotations

from pathlib import Path

import pytest

from tactflow.bench.pipelines import Bench
from tactflow.bench.recordings import check, measure_presses
from tactflow.bench.results import BenchResult
from tactflow.bench.timing import CopyUnit
from tactflow.config.load import load_pipeline
from tactflow.config.shipped import find_pipeline
from tactflow.engine.errors import ConfigError


def test_a_folder_without_known_recordings_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="wedge_ball"):
        check(tmp_path)


def test_real_presses_are_measured_against_their_labels(shared_data: Path, tmp_path: Path) -> None:
    data = tmp_path / "data"
    (data / "wedge_ball").mkdir(parents=True)
    source = shared_data / "wedge_ball"
    lines = (source / "labels.csv").read_text().splitlines()[:4]
    for name in ["reference.jpg", *(line.split(",")[0] for line in lines[1:])]:
        (data / "wedge_ball" / name).write_bytes((source / name).read_bytes())
    (data / "wedge_ball" / "labels.csv").write_text("\n".join(lines) + "\n")
    default = load_pipeline(find_pipeline("default"))
    result = BenchResult(quick=False)
    bench = Bench(result, CopyUnit(), tmp_path)
    measure_presses(bench, {"default": default, "again": default}, data / "wedge_ball")
    assert not result.failures
    first, second = result.measured
    assert first.key == "pipeline/default/data:wedge_ball"
    assert first.errors == second.errors
    assert first.errors["found_percent"] == 100
    # Three labelled presses; the label's own offset is taken out.
    assert first.errors["label_center_p50"] < 5
