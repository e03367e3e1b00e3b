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


def identity_signs(*frames: np.ndarray, lost: int = 0) -> dict[str, float]:
    """What is counted of markers at these positions, the first of them lost."""
    tally = Tally()
    status = np.where(np.arange(len(GRID)) < lost, MarkerStatus.LOST, MarkerStatus.TRACKED).astype(np.uint8)
    for position in frames:
        add_identity_signs(tally, Markers(GRID, position, status, np.zeros(len(GRID))))
    return tally.errors()


def test_a_step_of_the_force_stays_where_it_is_and_a_stray_sample_is_not_trusted() -> None:
    force = np.array([0.1, 0.1, 5.0, 0.1, 0.1, 0.1, 2.0, 2.0, 2.0, 0.0, 2.0, 2.0])
    contact, trusted = judged_by_force(force)
    assert list(contact) == [False] * 6 + [True] * 6
    assert list(np.flatnonzero(~trusted)) == [2, 9]


def test_a_gel_that_moves_as_one_has_kept_its_identities() -> None:
    assert set(identity_signs(GRID + np.array((13, 4))).values()) == {0.0}


def test_two_markers_that_swapped_tear_the_gel() -> None:
    position = GRID.copy()
    position[[55, 56]] = position[[56, 55]]
    errors = identity_signs(GRID, position)
    assert errors["flow_jumps"] == 1  # two in one of two frames
    assert errors["frames_with_jumps"] == 50
    assert errors["shared_dots"] == 0


def test_two_markers_on_one_dot_share_it_and_giving_markers_up_is_counted() -> None:
    position = GRID.copy()
    position[55] = position[56]
    assert identity_signs(position)["shared_dots"] == 2
    assert identity_signs(GRID, lost=14)["lost_share"] == 10


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
    first, second = result.measurements()
    assert first.key == "pipeline/default/data:wedge_ball"
    assert first.errors == second.errors
    assert first.errors["found_percent"] == 100
    # Three labelled presses; the label's own offset is taken out.
    assert first.errors["label_center_p50"] < 5
