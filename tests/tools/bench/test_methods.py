from __future__ import annotations

from pathlib import Path

import pytest

from tactflow.config.load import load_pipeline
from tactflow.config.shipped import find_pipeline
from tactflow.sim import scene_descriptions
from tactflow.tools.bench import methods
from tactflow.tools.bench.methods import measure_methods
from tactflow.tools.bench.results import LEFT_OUT, BenchResult, load_errors
from tactflow.tools.bench.scenes import FULL, FULL_STAGES, QUICK, QUICK_STAGES, TROUBLES, Case
from tactflow.tools.bench.tables import lines

OWN_TRACKER = """
import numpy as np
from tactflow import Markers, Stage
from tactflow.ports import Image, MarkerMask, Unmarked


class Own(Stage):
    memory = "stateful"

    def process(self, marker_mask: MarkerMask, unmarked: Unmarked) -> Markers:
        place = np.argwhere(marker_mask)[:1, ::-1].astype(float)
        return Markers(place, place, np.zeros(1, np.uint8), np.full(1, np.nan))


class Broken(Own):
    def process(self, marker_mask: MarkerMask) -> Markers:
        raise ValueError("never works")


class Unused(Stage):
    memory = "pure"

    def process(self, image: Image) -> Markers:
        return Markers(np.zeros((1, 2)), np.zeros((1, 2)), np.zeros(1, np.uint8), np.full(1, np.nan))
"""
REGISTERED = {"classic_tracker", "dis_flow", "lucas_kanade", "nearest_dots", "rlof"}


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
    # Also the registered ones, and what else the file has with the same ports.
    assert found.keys() == {"default", "Own", *REGISTERED, f"{tmp_path / 'own.py'}:Unused"}
    assert found["Own"]["displacement_rms"] >= 0
    assert "never works" in result.failures["tracker/Broken/press"]


SLOW = """
import time

from tactflow import Stage
from tactflow.ports import Image, MarkerMask, Unmarked


class Slow(Stage):
    memory = "%s"

    def process(self, image: Image, marker_mask: MarkerMask) -> Unmarked:
        began = time.thread_time()
        while time.thread_time() - began < 0.01:
            pass
        return image
"""


@pytest.mark.parametrize("memory", ["pure", "stateful"])
def test_a_slow_method_is_measured_on_fewer_frames_and_the_table_says_so(
    memory: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "slow.py").write_text(SLOW % memory)
    monkeypatch.setattr(methods, "QUICK_BUDGET_S", 0.025)
    monkeypatch.setattr(methods, "STAGES", {"inpaint": methods.STAGES["inpaint"]})
    use = f"stages.inpaint={{use: {tmp_path / 'slow.py'}}}"
    slow = load_pipeline(find_pipeline("default"), overrides=[use])
    result = BenchResult(quick=True)
    measure_methods(
        result,
        tmp_path,
        {"default": load_pipeline(find_pipeline("default")), "slow": slow},
        Case("press", 12),
    )
    measured = {m.method: m.values for m in result.measurements("inpaint")}
    assert measured["none"]["frames"] == 12
    assert 1 < measured["slow"]["frames"] < 12
    assert measured["slow"]["frames"] + measured["slow"][LEFT_OUT] == 12
    assert "slow (" in "".join(lines(result))
    # Which frames these are depends on the machine: no later run is compared with them.
    result.save(tmp_path / "stored.json")
    stored = load_errors(tmp_path / "stored.json", quick=True)
    assert "inpaint/none/press" in stored
    assert "inpaint/slow/press" not in stored


def test_all_scenes_exist_and_have_names_of_their_own() -> None:
    for cases in (QUICK, FULL, TROUBLES, QUICK_STAGES, FULL_STAGES):
        assert {case.name for case in cases} <= set(scene_descriptions())
    labels = [case.label for case in (*FULL, *TROUBLES)]
    assert len(labels) == len(set(labels))
