"""Stage `normals`: unit normals of the gel's surface, as a port and as a picture."""

from __future__ import annotations

from pathlib import Path

import jsonschema
import numpy as np
import pytest

import tactflow
from tactflow.config.shipped import find_pipeline, packaged_pipelines
from tactflow.drawing.results import Annotator
from tactflow.engine.frame import Frame
from tactflow.message.result import Result
from tactflow.message.schema import message_schema
from tactflow.vision.types import Contact, Depth, Scale

GEL = np.full((80, 120, 3), 100, np.uint8)
SCALE = Scale(0.1, 0.1, (0.0, 0.0), (59.5, 39.5))
RADIUS, CONTACT = 4.0, 2.0
X, Y = (
    part.astype(np.float32) * np.float32(0.1)
    for part in np.meshgrid(np.arange(-59.5, 60), np.arange(-39.5, 40))
)
INSIDE = np.hypot(X, Y) < CONTACT
MASK = np.where(INSIDE, 255, 0).astype(np.uint8)


def ball() -> np.ndarray:
    """(80, 120, 3): normals where a ball is pressed into the middle of the gel."""
    height = np.sqrt(np.maximum(RADIUS**2 - X**2 - Y**2, 0)) - (RADIUS**2 - CONTACT**2) ** 0.5
    heights = np.maximum(height, 0).astype(np.float32)
    depth = Depth(heights, float(heights.max()), None, 0.0, None)
    return tactflow.stage("normals").process(depth, SCALE)


def test_normals_point_to_the_middle_of_a_ball_and_out_of_a_gel_at_rest() -> None:
    normals = ball()
    assert np.allclose(np.linalg.norm(normals, axis=2), 1, atol=1e-5)
    well_inside = np.hypot(X, Y) < CONTACT - 0.3
    assert np.allclose(normals[well_inside][:, 0], -X[well_inside] / RADIUS, atol=0.01)
    assert np.allclose(normals[well_inside][:, 1], -Y[well_inside] / RADIUS, atol=0.01)
    assert normals[0, 0].tolist() == [0, 0, 1]


def test_normals_are_those_of_the_published_heights_on_pixels_that_are_not_square() -> None:
    heights = np.random.default_rng(1).uniform(0, 1, (40, 60)).astype(np.float32)
    scale = Scale(0.1, 0.05, (0.0, 0.0), (0.0, 0.0))
    normals = tactflow.stage("normals").process(Depth(heights, 1.0, None, 0.0, None), scale)
    down, across = np.gradient(heights, scale.y, scale.x)
    assert np.allclose(normals[..., 0] / normals[..., 2], across, rtol=1e-4, atol=1e-4)
    assert np.allclose(normals[..., 1] / normals[..., 2], down, rtol=1e-4, atol=1e-4)


def test_without_a_calibration_there_are_none() -> None:
    settings = {"stages.normals": {"when": "touching"}, "calibration": None}
    results = tactflow.stream("mini_plain", source="sim:unmarked?frames=25", settings=settings)
    pressed = [result for result in results if result.contact is not None]
    assert pressed
    assert all(result.normals is None for result in pressed)
    assert pressed[-1].skipped["normals"] == "no_calibration"


WITH_DEPTH = sorted(name for name in packaged_pipelines() if "  depth:" in find_pipeline(name).read_text())


@pytest.mark.parametrize("name", WITH_DEPTH)
def test_every_pipeline_with_depth_takes_the_stage_and_shows_it(name: str, tmp_path: Path) -> None:
    own = tmp_path / "own.yaml"
    own.write_text(
        find_pipeline(name).read_text().replace("  force:", "  normals: {when: touching}\n  force:")
    )
    assert tactflow.check(own, settings={"stages.visualize.view": "normals"}) == []


def test_the_view_of_a_pipeline_without_the_stage_names_it() -> None:
    (mistake,) = tactflow.check("mini", settings={"stages.visualize.view": "normals"})
    assert "normals" in str(mistake)


def test_the_picture_of_normals_is_a_normal_map() -> None:
    normals = ball()
    draw = Annotator(view="normals", text=False)
    picture = draw(GEL, normals=normals)
    assert picture[0, 0].tolist() == draw(GEL)[40, 60].tolist() == [255, 128, 128]
    left, right = picture[40, 60 - 12], picture[40, 60 + 12]
    # To the left of the middle the surface looks to the right: more red.
    assert left[2] > 150 > 110 > right[2]
    above, below = picture[40 - 12, 60], picture[40 + 12, 60]
    assert below[1] > 150 > 110 > above[1]


def test_a_message_has_the_mean_normal_of_the_contact() -> None:
    tilted = np.zeros((80, 120, 3), np.float32) + np.array([0.6, 0, 0.8], np.float32)
    contact = Contact(1256.0, (59.5, 39.5), None, None, np.zeros((0, 2)), None)
    ports = {"image": GEL, "contact": contact, "contact_mask": MASK}
    frame = Frame("main", 0, 0.0, GEL)
    message = Result(frame, {**ports, "normals": tilted}).to_dict()
    assert message["contact"]["normal"] == pytest.approx([0.6, 0, 0.8])
    assert "normal" not in Result(frame, ports).to_dict()["contact"]
    jsonschema.Draft202012Validator(message_schema()).validate(message)
