"""Stage `normals`: unit normals of the gel's surface, as a port and as a picture."""

from __future__ import annotations

from pathlib import Path

import jsonschema
import numpy as np
import pytest

import tactflow
from tactflow.config.shipped import find_pipeline
from tactflow.drawing.results import Annotator
from tactflow.engine.contract import StageParams
from tactflow.engine.frame import Absent, Frame
from tactflow.message.result import Result
from tactflow.message.schema import message_schema
from tactflow.stages.normals import SurfaceNormals
from tactflow.vision.types import Contact, Scale

GEL = np.full((80, 120, 3), 100, np.uint8)
SCALE = Scale(0.1, 0.1, (0.0, 0.0), (59.5, 39.5))
RADIUS, CONTACT = 4.0, 2.0
X, Y = (
    part.astype(np.float32) * np.float32(0.1)
    for part in np.meshgrid(np.arange(-59.5, 60), np.arange(-39.5, 40))
)
INSIDE = np.hypot(X, Y) < CONTACT
MASK = np.where(INSIDE, 255, 0).astype(np.uint8)


def gradients() -> np.ndarray:
    """How much deeper a ball in the middle of the gel pushes it, to the right and down."""
    height = np.sqrt(np.maximum(RADIUS**2 - X**2 - Y**2, 1))
    return np.where(INSIDE[..., None], np.stack([-X / height, -Y / height], axis=2), 0).astype(np.float32)


def test_normals_point_to_the_middle_of_a_ball_and_out_of_a_gel_at_rest() -> None:
    normals = SurfaceNormals(StageParams()).process(GEL, GEL, MASK, SCALE, gradients())
    assert np.allclose(np.linalg.norm(normals, axis=2), 1, atol=1e-5)
    well_inside = np.hypot(X, Y) < CONTACT - 0.3
    assert np.allclose(normals[well_inside][:, 0], -X[well_inside] / RADIUS, atol=0.01)
    assert np.allclose(normals[well_inside][:, 1], -Y[well_inside] / RADIUS, atol=0.01)
    assert normals[0, 0].tolist() == [0, 0, 1]


def test_without_a_calibration_and_a_network_there_are_none() -> None:
    stage = SurfaceNormals(StageParams())
    assert stage.process(GEL, GEL, MASK, SCALE) == Absent("no_calibration")
    assert stage.process(GEL, GEL, np.zeros_like(MASK), SCALE, gradients()) == Absent("no_contact")


def test_a_pipeline_with_the_stage_shows_them_and_one_without_it_names_it(tmp_path: Path) -> None:
    shipped = find_pipeline("mini").read_text()
    own = tmp_path / "own.yaml"
    own.write_text(shipped.replace("  force:", "  normals: {when: touching}\n  force:"))
    assert tactflow.check(own, settings={"stages.visualize.view": "normals"}) == []
    (mistake,) = tactflow.check("mini", settings={"stages.visualize.view": "normals"})
    assert "normals" in str(mistake)


def test_the_picture_of_normals_is_a_normal_map() -> None:
    normals = SurfaceNormals(StageParams()).process(GEL, GEL, MASK, SCALE, gradients())
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
