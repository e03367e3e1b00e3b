"""The page of the bench, and what it shows beside the tables."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from tactflow.config.load import load_pipeline
from tactflow.config.shipped import find_pipeline
from tactflow.sim import open_scene
from tactflow.tools.bench.costs import ENGINE, Costs, Step, measure_costs
from tactflow.tools.bench.growth import Growth
from tactflow.tools.bench.latency import percentiles
from tactflow.tools.bench.page import bench_page, front, points, save_pictures
from tactflow.tools.bench.quantities import QUANTITIES
from tactflow.tools.bench.results import UNSKIPPED, BenchResult


def measured() -> BenchResult:
    """Two pipelines on two scenes: one is exact, the other fast."""
    result = BenchResult(quick=True, machine={"CPU": "one"})
    numbers = {"default": (2.0, 0.01), "classic": (40.0, 0.2), "mine": (0.5, 0.05), "worse": (3.0, 0.1)}
    for name, (ms, error) in numbers.items():
        for factor, scene in ((1.0, "press"), (2.0, "cable")):
            times = {"contact": [factor * ms / 1e3]}
            errors = {"displacement_rms": factor * error}
            result.add("pipeline", name, scene, errors, times=times, frames=10)
    return result


def test_the_front_has_the_methods_that_nothing_beats_in_both_time_and_error() -> None:
    found = points(measured().measurements("pipeline"), QUANTITIES["displacement_rms"])
    (mine,) = [point for point in found if point.name == "mine"]
    assert (mine.ms[1], mine.error[1]) == pytest.approx((0.75, 0.075))
    assert [point.name for point in front(found)] == ["mine", "default"]


def test_a_perfect_overlap_is_an_error_of_0() -> None:
    result = BenchResult(quick=True)
    result.add("pipeline", "default", "press", {"hull_iou": 1.0}, times={"contact": [0.001]}, frames=1)
    (point,) = points(result.measurements("pipeline"), QUANTITIES["hull_iou"])
    assert point.error == (0, 0, 0)


def test_the_page_names_every_method_and_marks_the_classic_script() -> None:
    pytest.importorskip("matplotlib", reason="the extra plot is not installed")
    result = measured()
    result.costs = {"default": {"contact": {"difference": 1.0, ENGINE: 0.5}}}
    result.latency_ms = [1.0, 2.0, 8.0]
    result.growth = [Growth("Dots", "", [9, 30, 80], [1, 2, 4], [1, 2, 4], [1, 2, 4], {"52x39": "0 markers"})]
    result.pictures = {"press": {"truth": b"jpeg", "default": b"jpeg"}}
    page = bench_page(result, ["mine"])
    for words in (
        "displacement error",
        "classic",
        "mine",
        "difference",
        "p99.9",
        "52x39: 0 markers",
        "press",
    ):
        assert words in page
    assert page.count("data:image/jpeg") == 2
    assert re.findall(r'(?:src|href)="(?!data:|#)[^"]*', page) == []


def test_pictures_are_written_of_what_was_measured(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="the extra plot is not installed")
    result = BenchResult(quick=True)
    assert save_pictures(result, tmp_path) == []
    # Names that would cover each other.
    for name, ms in (("default", 1.0), ("lucas_kanade", 1.1), ("nearest_dots", 1.2), ("classic", 9.0)):
        for group, errors in (("tracker", {"displacement_rms": 0.1}), ("difference", {"contact_iou": 0.9})):
            result.add(group, name, "press", errors, times={"contact": [ms / 1e3]}, frames=1)
    steps = [Step(t, "contact", 1.0 + t, {}, 100.0, 2.0) for t in (0.0, 0.1)]
    result.grasp = ("press", {"default": Costs(steps), f"default{UNSKIPPED}": Costs(steps)})
    assert [path.name for path in save_pictures(result, tmp_path)] == ["front.png", "skipping.png"]
    for name in ("front.png", "skipping.png"):
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")


def test_a_pipeline_that_fails_on_a_recording_leaves_the_costs_of_the_others(tmp_path: Path) -> None:
    scene = open_scene("press?frames=24&markers=none")
    np.save(tmp_path / "bare.npy", np.stack([scene.frame(n) for n in range(24)]))
    pipelines = {name: load_pipeline(find_pipeline(name)) for name in ("default", "markerless")}
    failures: dict[str, str] = {}
    costs = measure_costs(pipelines, tmp_path / "bare.npy", failures)
    assert list(costs) == ["markerless"]
    assert costs["markerless"].steps
    assert "0 markers found" in failures["default"]


@pytest.mark.parametrize("power", [0.0, 1.0, 2.0])
def test_the_power_of_growth_is_that_of_the_larger_sizes(power: float) -> None:
    x = np.array([1.0, 2, 4, 8, 16, 32])
    ms = 0.01 + x**power
    grown = Growth("", "", x.tolist(), ms.tolist(), ms.tolist(), ms.tolist(), {})
    assert grown.exponent == pytest.approx(power, abs=0.02)
    assert Growth("", "", [1, 2], [1, 2], [1, 2], [1, 2], {}).exponent is None


def test_percentiles_of_no_frames_are_none() -> None:
    assert percentiles([]) == {}
    assert percentiles([1.0] * 10) == {"p50": 1.0, "p99": 1.0, "p99.9": 1.0}


def test_the_cost_of_each_frame_is_that_of_its_stages_and_the_engine(tmp_path: Path) -> None:
    scene = open_scene("press?frames=40")
    np.save(tmp_path / "press.npy", np.stack([scene.frame(n) for n in range(40)]))
    pipeline = load_pipeline(find_pipeline("default"))
    costs = measure_costs({"default": pipeline}, tmp_path / "press.npy")["default"]
    kinds = [step.kind for step in costs.steps]
    assert kinds.count("first touch") == 1
    assert kinds.index("first touch") < kinds.index("contact")
    assert {step.kind for step in costs.steps if step.area > 0} == {"first touch", "contact"}
    for step in costs.steps:
        assert 0 < sum(step.stage_ms.values()) <= step.cpu_ms
    by_stage = costs.by_stage()["contact"]
    assert {"difference", "tracker", "hull", ENGINE} <= by_stage.keys()
