from __future__ import annotations

from pathlib import Path

from tactflow.config.load import load_pipeline
from tactflow.config.shipped import find_pipeline
from tactflow.sim import scene_descriptions
from tactflow.tools.bench.methods import measure_methods
from tactflow.tools.bench.results import BenchResult
from tactflow.tools.bench.scenes import FULL, FULL_STAGES, QUICK, QUICK_STAGES, TROUBLES, Case

OWN_TRACKER = """
import numpy as np
from tactflow import Markers, Stage
from tactflow.ports import MarkerMask, Unmarked


class Own(Stage):
    memory = "stateful"

    def process(self, marker_mask: MarkerMask, unmarked: Unmarked) -> Markers:
        place = np.argwhere(marker_mask)[:1, ::-1].astype(float)
        return Markers(place, place, np.zeros(1, np.uint8), np.full(1, np.nan))


class Broken(Own):
    def process(self, marker_mask: MarkerMask) -> Markers:
        raise ValueError("never works")
"""


def test_a_tracker_of_ones_own_is_measured_whichever_ports_it_takes_and_a_broken_one_stops_no_other(
    tmp_path: Path,
) -> None:
    (tmp_path / "own.py").write_text(OWN_TRACKER)
    measured = {"default": load_pipeline(find_pipeline("default"))}
    for name in ("Own", "Broken"):
        use = f"stages.tracker={{use: {tmp_path / 'own.py'}:{name}}}"
        measured[name] = load_pipeline(find_pipeline("default"), overrides=[use])
    result = BenchResult(quick=True)
    measure_methods(result, tmp_path, measured, Case("press", 3))
    found = {m.method: m.errors for m in result.measurements("tracker")}
    assert found.keys() == {"default", "Own"}
    assert found["Own"]["displacement_rms"] >= 0
    assert "never works" in result.failures["tracker/Broken/press"]


def test_all_scenes_exist_and_have_names_of_their_own() -> None:
    for cases in (QUICK, FULL, TROUBLES, QUICK_STAGES, FULL_STAGES):
        assert {case.name for case in cases} <= set(scene_descriptions())
    labels = [case.label for case in (*FULL, *TROUBLES)]
    assert len(labels) == len(set(labels))
