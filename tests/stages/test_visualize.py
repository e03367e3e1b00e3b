"""Stage `visualize`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.config.load import load_pipeline
from tactflow.engine.errors import ConfigError
from tactflow.engine.plan import make_plan
from tactflow.stages.visualize import Visualize
from tactflow.vision.flow import FieldModel
from tactflow.vision.geometry.hull import contact_geometry
from tactflow.vision.types import Depth, Flow, Markers, Scale

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
    picture = Visualize(Visualize.Params(text=False)).process(IMAGE, None, None, None, None)
    np.testing.assert_array_equal(picture, IMAGE)
    assert picture.flags.writeable


@pytest.mark.parametrize(
    "params",
    [
        {"arrow_scale": 10.0},
        {"view": "contact"},
        {"text": False},
    ],
    ids=str,
)
def test_every_parameter_changes_the_picture(params: dict[str, Any]) -> None:
    assert not np.array_equal(run(**params), run())
    assert (IMAGE == 90).all()


def test_the_field_between_the_markers_is_drawn_where_there_is_one() -> None:
    known = Markers(ORIGIN, ORIGIN + np.array([3.0, -2.0]), np.zeros(3, np.uint8), np.full(3, 0.1))
    field = FieldModel(ORIGIN, (160, 120))(known)
    stage = Visualize(Visualize.Params(text=False, field=True))
    picture = stage.process(IMAGE, None, None, None, None, field=field)
    assert (picture[30:70, 55:75] != IMAGE[30:70, 55:75]).any()  # no marker there


def test_heights_take_the_place_of_the_picture_on_one_scale_of_colours() -> None:
    y, x = np.mgrid[:120, :160]
    heights = np.maximum(0, 0.6 - ((x - 80) ** 2 + (y - 60) ** 2) / 1000).astype(np.float32)
    scale = Scale(0.1, 0.1, (0, 0), (0, 0))
    stage = Visualize(Visualize.Params(text=False, view="depth", deepest=0.6))

    def drawn(part: float, known: Scale | None = scale) -> NDArray[np.uint8]:
        depth = Depth(part * heights, part * 0.6, None, 1.0, None)
        return stage.process(IMAGE, None, None, None, None, depth=depth, scale=known)

    rest = stage.process(IMAGE, None, None, None, None, scale=scale)
    assert (rest == rest[0, 0]).all(), "untouched, the gel is flat"
    picture = drawn(1.0)
    assert (picture[:20] == rest[0, 0]).all()
    assert picture[60, 80].tolist() == [37, 231, 253], "the deepest place has the lightest colour"
    assert drawn(0.5)[60, 80].sum() < picture[60, 80].sum()
    # The lamp stands at the upper left.
    assert picture[48, 68].sum() > 1.5 * picture[72, 92].sum()
    assert (drawn(1.0, None) == rest[0, 0]).all()


def test_what_is_not_shown_is_not_computed(tmp_path: Path) -> None:
    def computed(visualize: str, stages: str = "depth: {when: touching}\n  ") -> set[str]:
        file = tmp_path / "pipeline.yaml"
        file.write_text(
            "stages:\n  capture: {source: 'sim:press'}\n  preprocess:\n  marker_mask:\n  inpaint:\n"
            f"  difference:\n  untouched:\n  scale:\n  tracker:\n  hull:\n  field:\n  {stages}"
            f"visualize: {{{visualize}}}\nsinks:\n  images:\n"
        )
        return {node for nodes in make_plan(load_pipeline(file)).segments.values() for node in nodes}

    for_the_picture = computed("")
    assert {"tracker", "hull"} <= for_the_picture
    assert computed("field: true") == for_the_picture | {"field"}
    assert computed("view: depth") == for_the_picture | {"depth", "scale", "untouched"}
    with pytest.raises(ConfigError, match=r"visualize\.view: depth needs depth, which no stage gives"):
        computed("view: depth", "")
