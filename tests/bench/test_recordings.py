from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tactflow.bench.pipelines import Bench
from tactflow.bench.quantities import Tally
from tactflow.bench.recordings import add_identity_signs, check, judged_by_force, measure_recordings
from tactflow.bench.results import BenchResult
from tactflow.bench.timing import CopyUnit
from tactflow.config.load import load_pipeline
from tactflow.config.shipped import find_pipeline
from tactflow.engine.errors import ConfigError
from tactflow.vision.types import Markers, MarkerStatus

GRID = np.array([(x, y) for y in range(0, 280, 20) for x in range(0, 200, 20)], dtype=np.float64)


def test_a_step_of_the_force_stays_where_it_is_and_a_stray_sample_is_not_trusted() -> None:
    force = np.array([0.1, 0.1, 5.0, 0.1, 0.1, 0.1, 2.0, 2.0, 2.0, 0.0, 2.0, 2.0])
    contact, trusted = judged_by_force(force)
    assert list(contact) == [False] * 6 + [True] * 6
    assert list(np.flatnonzero(~trusted)) == [2, 9]


def test_a_swap_of_two_markers_a_shared_dot_and_lost_markers_are_signs_of_wrong_identities() -> None:
    swapped, shared = GRID.copy(), GRID.copy()
    swapped[[55, 56]] = swapped[[56, 55]]
    shared[100] = shared[101]
    status = np.where(np.arange(len(GRID)) < 14, MarkerStatus.LOST, MarkerStatus.TRACKED).astype(np.uint8)
    tally = Tally()
    for position in (GRID + np.array((13, 4)), swapped, shared, GRID):
        add_identity_signs(tally, Markers(GRID, position, status, np.zeros(len(GRID))))
    # In two of four frames two markers move unlike their neighbours, or one does; in one, two share a dot.
    errors = tally.errors()
    assert errors == {
        "shared_dots": 0.5,
        "flow_jumps": 0.75,
        "frames_with_jumps": 50,
        "lost_share": 10,
        "markers_short": 0,
    }


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
    measure_recordings(bench, {"default": default, "again": default}, {}, data)
    assert not result.failures
    first, second = result.measured
    assert first.key == "pipeline/default/data:wedge_ball"
    assert first.errors == second.errors
    assert first.errors["found_percent"] == 100
    # Three labelled presses; the label's own offset is taken out.
    assert first.errors["label_center_p50"] < 5
