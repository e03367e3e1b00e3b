"""Stage `visualize`."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import ValidationError

from tactflow.engine.ports import read_ports
from tactflow.stages.visualize import Visualize
from tactflow.vision.flow import FieldModel
from tactflow.vision.geometry.hull import contact_geometry
from tactflow.vision.types import Flow, Markers

IMAGE = np.full((120, 160, 3), 90, np.uint8)
IMAGE.flags.writeable = False
MASK = np.zeros((120, 160), np.uint8)
MASK[40:60, 30:110] = 255
ORIGIN = np.array([[40.0, 50], [90, 52], [20, 100]])
MARKERS = Markers(ORIGIN, ORIGIN + np.array([3.0, -2.0]), np.array([0, 1, 2], np.uint8), np.full(3, 0.1))


def run(**params: Any) -> NDArray[np.uint8]:
    stage = Visualize(Visualize.Params(**params))
    return stage.process(IMAGE, contact_geometry(MASK), Flow((3.0, -2.0), 2), MARKERS, MASK)


def test_everything_but_the_image_may_be_absent() -> None:
    ports = read_ports(Visualize, "process")
    assert {port.name: port.optional for port in ports.inputs} == {
        "image": False,
        "contact": True,
        "flow": True,
        "markers": True,
        "contact_mask": True,
        "valid": True,
        "field": True,
    }
    assert [port.name for port in ports.outputs] == ["annotated"]
    picture = Visualize(Visualize.Params(text=False)).process(IMAGE, None, None, None, None)
    np.testing.assert_array_equal(picture, IMAGE)
    assert picture.flags.writeable


def test_results_are_drawn_on_a_new_picture() -> None:
    picture = run()
    assert picture.shape == IMAGE.shape
    assert not np.array_equal(picture, IMAGE)
    assert (IMAGE == 90).all()


@pytest.mark.parametrize(
    "params",
    [{"arrow_scale": 10.0}, {"view": "contact"}, {"ellipse": True}, {"text": False}],
    ids=str,
)
def test_every_parameter_changes_the_picture(params: dict[str, Any]) -> None:
    assert not np.array_equal(run(**params), run())


def test_dilate_widens_the_contact_view() -> None:
    seen = [int(run(view="contact", text=False, dilate=d).any(axis=2).sum()) for d in (0, 10)]
    assert seen[1] > seen[0]


@pytest.mark.parametrize("params", [{"arrow_scale": -1}, {"view": "x"}, {"arrows": 3}], ids=str)
def test_wrong_parameters_are_refused(params: Any) -> None:
    with pytest.raises(ValidationError):
        Visualize.Params(**params)


def test_the_field_between_the_markers_is_drawn_where_it_is_asked_for() -> None:
    known = Markers(ORIGIN, ORIGIN + np.array([3.0, -2.0]), np.zeros(3, np.uint8), np.full(3, 0.1))
    field = FieldModel(ORIGIN, (160, 120))(known)
    plain, asked = (
        Visualize(Visualize.Params(text=False, field=wanted)).process(
            IMAGE, None, None, None, None, field=field
        )
        for wanted in (False, True)
    )
    np.testing.assert_array_equal(plain, IMAGE)
    assert (asked[30:70, 55:75] != IMAGE[30:70, 55:75]).any()  # no marker there
