from __future__ import annotations

from pathlib import Path
from typing import Literal

import pytest
from pydantic import Field

from tactflow.bench.methods import alternatives, measure_methods, methods_of
from tactflow.bench.scenes import (
    FULL,
    FULL_STAGES,
    NOMINAL,
    QUICK,
    QUICK_STAGES,
    TROUBLES,
    Case,
    Rendered,
)
from tactflow.bench.timing import CopyUnit
from tactflow.config.load import load_pipeline
from tactflow.config.shipped import find_pipeline
from tactflow.engine.contract import StageParams
from tactflow.engine.graph import Pipeline
from tactflow.sim import scene_names
from tactflow.vision.geometry import PixelMapping, Preprocessor


class WithMethods(StageParams):
    method: Literal["a", "b"] = Field("a", description="")


class Without(StageParams):
    level: int = 3


@pytest.fixture(scope="module")
def pipelines() -> dict[str, Pipeline]:
    return {name: load_pipeline(find_pipeline(name)) for name in ("default", "classic")}


def test_methods_are_read_from_the_parameter_of_that_name() -> None:
    assert methods_of(WithMethods) == ["a", "b"]
    assert methods_of(Without) == []


def test_every_method_of_a_stage_is_an_alternative_and_the_scripts_is_the_yardstick(
    pipelines: dict[str, Pipeline],
) -> None:
    ways = alternatives(pipelines, "inpaint")
    assert ways.keys() >= {"telea", "ns", "none"}
    assert [name for name, way in ways.items() if way.yardstick] == ["telea"]
    assert ways["telea"].params == pipelines["classic"].nodes["inpaint"].params


OWN_TRACKER = """
import numpy as np
from tactflow import Markers, Stage
from tactflow.ports import MarkerMask, Unmarked


class Own(Stage):
    memory = "stateful"

    def process(self, marker_mask: MarkerMask, unmarked: Unmarked) -> Markers:
        place = np.argwhere(marker_mask)[:1, ::-1].astype(float)
        return Markers(place, place, np.zeros(1, np.uint8), np.full(1, np.nan))
"""


def test_a_tracker_of_ones_own_is_measured_alone_whichever_ports_of_the_chain_it_takes(
    tmp_path: Path,
) -> None:
    (tmp_path / "own.py").write_text(OWN_TRACKER)
    default = find_pipeline("default")
    own = load_pipeline(default, overrides=[f"stages.tracker={{use: {tmp_path / 'own.py'}}}"])
    pipelines = {"default": load_pipeline(default), "own": own}
    made = measure_methods(pipelines, Rendered(Case("press", 3), tmp_path), CopyUnit(), lambda: None)
    found = {m.method: m for m in made if m.group == "tracker"}
    assert found["own"].failure is None
    assert found["own"].errors["displacement_rms"] >= 0
    assert found.keys() == {"default", "own"}


def test_a_scenes_name_tells_its_settings_apart() -> None:
    labels = [case.label for case in (*FULL, *TROUBLES)]
    assert len(labels) == len(set(labels))


def test_all_scenes_exist_and_nominal_ones_are_measured() -> None:
    for cases in (QUICK, FULL, TROUBLES, QUICK_STAGES, FULL_STAGES):
        assert {case.name for case in cases} <= set(scene_names())
    assert {case.label for case in FULL} >= NOMINAL


def test_frames_come_back_from_the_file_as_they_were_rendered(tmp_path: Path) -> None:
    rendered = Rendered(Case("press", 4), tmp_path)
    assert (rendered.frames[2] == rendered.scene.frame(2)).all()
    assert len(rendered) == 4


def test_the_truth_is_that_of_the_mapping_asked_for(tmp_path: Path) -> None:
    rendered = Rendered(Case("press", 4), tmp_path)
    processed = rendered.truths(Preprocessor((800, 600), rotate=90, downsample=2).mapping)
    raw = rendered.truths(PixelMapping.identity((800, 600)))
    assert processed[0].contact_mask.shape == (400, 300)
    assert raw[0].contact_mask.shape == (600, 800)


def test_the_limit_in_processed_pixels_is_half_of_that_in_raw_ones(tmp_path: Path) -> None:
    rendered = Rendered(Case("press", 2), tmp_path)
    raw = rendered.displacement_limit(PixelMapping.identity((800, 600)))
    halved = rendered.displacement_limit(Preprocessor((800, 600), rotate=90, downsample=2).mapping)
    assert raw is not None
    assert halved == pytest.approx(raw / 2)
    # Radius 9.3 px, edge 0.8 px, contrast 80 to 150 in three channels, noise 2: by hand between 4 and 10 mpx.
    assert 0.004 < raw < 0.010


def test_no_limit_is_claimed_where_the_noise_is_not_plain(tmp_path: Path) -> None:
    rendered = Rendered(Case("noisy", 2), tmp_path)
    assert rendered.displacement_limit(PixelMapping.identity((800, 600))) is None


def test_half_depth_is_where_the_indenter_says_so(tmp_path: Path) -> None:
    rendered = Rendered(Case("press", 40), tmp_path)
    deep = [rendered.deep(index) for index in range(40)]
    touching = [t.touching for t in rendered.truths(PixelMapping.identity((800, 600)))]
    assert any(deep)
    assert not any(d and not t for d, t in zip(deep, touching, strict=True))
    assert sum(deep) < sum(touching)
