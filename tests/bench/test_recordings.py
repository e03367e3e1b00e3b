from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tactflow.bench.recordings import (
    IdentityTally,
    judged_by_force,
    label_errors,
    measure_recordings,
    rectified,
    without_markers,
)
from tactflow.bench.timing import CopyUnit
from tactflow.config.load import load_pipeline
from tactflow.config.shipped import find_pipeline
from tactflow.engine.errors import ConfigError
from tactflow.engine.graph import Pipeline

GRID = np.array([(x, y) for y in range(0, 280, 20) for x in range(0, 200, 20)], dtype=np.float64)
NONE_LOST = np.zeros(len(GRID), dtype=bool)


@pytest.fixture
def default() -> Pipeline:
    return load_pipeline(find_pipeline("default"))


def test_a_constant_offset_of_the_labels_is_taken_out() -> None:
    random = np.random.default_rng(2)
    labels = random.uniform(0, 200, (100, 2))
    errors = label_errors(labels + np.array((5, -3)), labels)
    assert errors == {
        "found_percent": 100,
        "label_center_p50": pytest.approx(0),
        "label_center_p95": pytest.approx(0),
    }


def test_contacts_that_were_not_found_lower_the_share_and_nothing_else() -> None:
    labels = np.zeros((10, 2))
    centers = np.tile((1.0, 1.0), (10, 1))
    centers[:3] = np.nan
    errors = label_errors(centers, labels)
    assert errors["found_percent"] == 70
    assert errors["label_center_p95"] == 0
    assert label_errors(np.full((4, 2), np.nan), np.zeros((4, 2))) == {"found_percent": 0}


def test_a_step_of_the_force_stays_where_it_is_and_a_stray_sample_is_not_trusted() -> None:
    force = np.array([0.1, 0.1, 5.0, 0.1, 0.1, 0.1, 2.0, 2.0, 2.0, 0.0, 2.0, 2.0])
    contact, trusted = judged_by_force(force)
    assert list(contact) == [False] * 6 + [True] * 6
    assert list(np.flatnonzero(~trusted)) == [2, 9]


def test_a_gel_that_moves_as_one_has_kept_its_identities() -> None:
    tally = IdentityTally()
    tally.add(GRID, GRID + np.array((13, 4)), NONE_LOST)
    assert set(tally.errors().values()) == {0.0}


def test_two_markers_that_swapped_tear_the_gel() -> None:
    position = GRID.copy()
    position[[55, 56]] = position[[56, 55]]
    tally = IdentityTally()
    tally.add(GRID, GRID, NONE_LOST)
    tally.add(GRID, position, NONE_LOST)
    errors = tally.errors()
    assert errors["flow_jumps"] == 1  # two in one of two frames
    assert errors["frames_with_jumps"] == 50
    assert errors["shared_dots"] == 0


def test_two_markers_on_one_dot_share_it() -> None:
    position = GRID.copy()
    position[55] = position[56]
    tally = IdentityTally()
    tally.add(GRID, position, NONE_LOST)
    assert tally.errors()["shared_dots"] == 2


def test_giving_markers_up_is_counted() -> None:
    lost = NONE_LOST.copy()
    lost[:14] = True
    tally = IdentityTally()
    tally.add(GRID, GRID, lost)
    assert tally.errors()["lost_share"] == 10


def test_a_tracker_that_never_answers_is_short_of_all_markers() -> None:
    assert IdentityTally().errors() == {"markers_short": 140.0}


def test_rectifying_replaces_the_preprocessing_only(default: Pipeline) -> None:
    changed = rectified(default)
    assert changed.nodes["preprocess"].params.homography is not None  # type: ignore[attr-defined]
    assert changed.nodes["preprocess"].params.rotate == 0  # type: ignore[attr-defined]
    for name, node in default.nodes.items():
        assert name == "preprocess" or changed.nodes[name] == node


def test_the_script_is_given_no_tracker_for_a_sensor_without_markers() -> None:
    left = without_markers(load_pipeline(find_pipeline("classic")))
    assert "tracker" not in left.nodes
    assert "hull" in left.nodes


def test_a_folder_without_known_recordings_is_refused(default: Pipeline, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="wedge_ball"):
        list(measure_recordings({"default": default}, {}, tmp_path, tmp_path, CopyUnit(), lambda: None))


def test_real_presses_are_measured_against_their_labels(
    default: Pipeline, shared_data: Path, tmp_path: Path
) -> None:
    data = tmp_path / "data"
    (data / "wedge_ball").mkdir(parents=True)
    source = shared_data / "wedge_ball"
    lines = (source / "labels.csv").read_text().splitlines()[:4]
    for name in ["reference.jpg", *(line.split(",")[0] for line in lines[1:])]:
        (data / "wedge_ball" / name).write_bytes((source / name).read_bytes())
    (data / "wedge_ball" / "labels.csv").write_text("\n".join(lines) + "\n")
    pipelines = {"default": default, "again": replace(default, sensor="again")}
    ((first, second),) = measure_recordings(pipelines, {}, data, tmp_path, CopyUnit(), lambda: None)
    assert first.failure is None
    assert first.scene == "data:wedge_ball"
    assert first.frames == 3
    assert first.errors == second.errors
    assert first.errors["found_percent"] == 100
