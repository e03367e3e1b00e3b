"""The original script as stages: each is its function, and the pipeline names them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from tactflow.classic import functions
from tactflow.classic.stages import ConvexHull, Difference, FlowMask, MaskMarker, Tracker
from tactflow.config.load import load_pipeline
from tactflow.engine.frame import Absent, Frame
from tactflow.sim import open_scene
from tactflow.vision.types import Contact, Markers, MarkerStatus
from tests.vision.dots import grid, render

PIPELINE = Path(__file__).resolve().parents[2] / "pipelines" / "classic.yaml"
GREY = np.full((40, 60, 3), 100, np.uint8)


def frame(seq: int, *, reference: bool = False) -> Frame:
    return Frame("test", seq, seq / 60, GREY, reference=reference)


def touched() -> np.ndarray:
    image = GREY.copy()
    image[10:30, 10:40] += 20
    return image


def test_the_pipeline_is_the_script_in_the_places_of_the_built_in_stages() -> None:
    nodes = load_pipeline(PIPELINE).nodes
    classes = {name: node.component.cls for name, node in nodes.items()}
    assert classes["marker_mask"] is MaskMarker
    assert classes["difference"] is Difference
    assert classes["hull"] is ConvexHull
    assert classes["tracker"] is Tracker
    assert classes["flow_in_mask"] is FlowMask
    assert nodes["preprocess"].params.model_dump()["method"] == "pyramid"
    assert nodes["inpaint"].params.model_dump() == {"method": "telea", "radius": 7.0}


def test_the_marker_mask_is_that_of_the_function() -> None:
    image = open_scene("idle?frames=2").frame(0)
    assert np.array_equal(MaskMarker(MaskMarker.Params()).process(image), functions.mask_marker(image))


def test_the_difference_is_taken_from_the_last_reference_until_a_reset() -> None:
    stage = Difference(Difference.Params())
    assert not stage.process(GREY - np.uint8(50), frame(0, reference=True)).touching
    assert not stage.process(GREY, frame(1, reference=True)).touching
    result = stage.process(touched(), frame(2))
    assert result.touching
    assert np.array_equal(result.contact_mask, functions.difference(touched(), GREY))
    stage.reset()
    assert not stage.process(touched(), frame(3)).touching


def test_the_hull_has_the_area_of_the_polygon_of_pixel_centres() -> None:
    mask = np.zeros((60, 80), np.uint8)
    mask[10:20, 5:55] = 255
    contact = ConvexHull(ConvexHull.Params()).process(mask)
    assert isinstance(contact, Contact)
    assert contact.area == 49 * 9
    assert ConvexHull(ConvexHull.Params()).process(0 * mask) == Absent("no_contact")


def test_the_tracker_follows_the_markers_of_its_first_frame() -> None:
    centers = grid(6, 6, 30.0, corner=(25.0, 28.0), jitter=0.4)
    stage = Tracker(Tracker.Params())
    stage.process(render((205, 210), centers, 4.2))
    markers = stage.process(render((205, 210), centers + np.array([3.0, 2.0]), 4.2))
    np.testing.assert_allclose(markers.displacement, np.tile([3.0, 2.0], (36, 1)), atol=1.0)
    assert (markers.status == MarkerStatus.TRACKED).all()
    stage.reset()
    assert np.abs(stage.process(render((205, 210), centers + 5, 4.2)).displacement).max() == 0


def test_the_flow_is_cut_to_whole_pixels() -> None:
    origin = np.array([[20.0, 15.0], [30.0, 15.0]])
    markers = Markers(origin, origin + np.array([1.5, -0.5]), np.zeros(2, np.uint8), np.full(2, np.nan))
    mask = np.full((40, 60), 255, np.uint8)
    assert FlowMask(FlowMask.Params()).process(markers, mask).mean == (1.0, 0.0)


@pytest.mark.parametrize("wrong", [{"dilate": -1}, {"dilate": 2.5}, {"dilation": 3}], ids=str)
def test_wrong_parameters_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        FlowMask.Params(**wrong)  # type: ignore[arg-type]
