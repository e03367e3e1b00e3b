"""What is no finite number is refused with words, by functions and in pipeline files alike."""

from __future__ import annotations

import math
import re
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin

import numpy as np
import pytest
from pydantic import BaseModel

from tactflow.config.load import load_pipeline
from tactflow.config.registry import names, resolve
from tactflow.drawing.results import Annotator
from tactflow.engine.errors import ConfigError
from tactflow.vision.change import ChangeProbe
from tactflow.vision.contact import ContactDetector, chi_square_threshold
from tactflow.vision.flow import flow_in_mask
from tactflow.vision.geometry import PixelMapping, Preprocessor, check_lens, find_homography
from tactflow.vision.geometry.hull import contact_geometry
from tactflow.vision.markers.detection import detect_markers
from tactflow.vision.markers.inpaint import remove_markers
from tactflow.vision.markers.mask import Dot, find_dot
from tactflow.vision.markers.tracking import MarkerTracker
from tactflow.vision.smooth import ContactSmoother, OneEuro
from tactflow.vision.types import Markers
from tests.stress.builders import gel

REPOSITORY = Path(__file__).resolve().parents[2]

MASK = np.full((20, 30), 255, np.uint8)
IMAGE = np.full((20, 30, 3), 100, np.uint8)
NO_MARKERS = Markers(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, np.uint8), np.zeros(0))
SQUARE = np.array([[0.0, 0], [29, 0], [0, 19], [29, 19]])
CAMERA = np.array([[30.0, 0, 15], [0, 30, 10], [0, 0, 1]])


def spoiled(points: Any, value: float) -> Any:
    """The points with one coordinate replaced."""
    copy = np.array(points, np.float64)
    copy.flat[1] = value
    return copy


FUNCTIONS: dict[str, Callable[[float], Any]] = {
    "contact_geometry.min_area": lambda v: contact_geometry(MASK, min_area=v),
    "flow_in_mask.dilate": lambda v: flow_in_mask(NO_MARKERS, MASK, dilate=v),
    "remove_markers.radius": lambda v: remove_markers(IMAGE, MASK // 255 * 0, radius=v),
    "remove_markers.radius (telea)": lambda v: remove_markers(IMAGE, MASK, radius=v, method="telea"),
    "Dot.radius": lambda v: Dot(v),
    "find_dot.radius": lambda v: find_dot(IMAGE, radius=v),
    "MarkerTracker.max_displacement": lambda v: MarkerTracker(
        gel().reference, detect_markers(gel().reference), max_displacement=v
    ),
    "chi_square_threshold": chi_square_threshold,
    "ContactDetector.false_alarms": lambda v: ContactDetector(false_alarms=v),
    "ContactDetector.distance": lambda v: ContactDetector("colour", distance=v),
    "ChangeProbe.false_alarms": lambda v: ChangeProbe(IMAGE, false_alarms=v),
    "ChangeProbe.tile": lambda v: ChangeProbe(IMAGE, tile=v),  # type: ignore[arg-type]
    "Annotator.arrow_scale": lambda v: Annotator(arrow_scale=v),
    "OneEuro.min_cutoff": lambda v: OneEuro(min_cutoff=v),
    "OneEuro.period": lambda v: OneEuro(period=v),
    "ContactSmoother.min_cutoff": lambda v: ContactSmoother(min_cutoff=v),
    "find_homography.source": lambda v: find_homography(spoiled(SQUARE, v), SQUARE),
    "check_lens.camera_matrix": lambda v: check_lens(spoiled(CAMERA, v), [0, 0, 0, 0], False),
    "check_lens.distortion": lambda v: check_lens(CAMERA, [0, v, 0, 0], False),
    "Preprocessor.downsample": lambda v: Preprocessor((30, 20), downsample=v),  # type: ignore[arg-type]
    "Preprocessor.crop": lambda v: Preprocessor((30, 20), crop=(0, 0, v, 5)),  # type: ignore[arg-type]
    "PixelMapping.to_processed": lambda v: PixelMapping.identity((30, 20)).to_processed([[1.0, v]]),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_function_refuses_nan_and_infinity_and_says_what_is_required(name: str) -> None:
    for value in (math.nan, math.inf, -math.inf):
        with pytest.raises(ValueError, match="required") as caught:
            FUNCTIONS[name](value)
        # The value that came is named, or the kind of what came.
        assert re.search(r"nan|inf|got", str(caught.value))


# -- pipeline files ---------------------------------------------------------------------------------------


def numbers_of(params: type[BaseModel], path: tuple[str, ...] = ()) -> list[tuple[str, ...]]:
    """The paths of all parameters that take a float, those of nested mappings included."""
    found = []
    for name, field in params.model_fields.items():
        here = (*path, field.alias or name)
        for annotation in _alternatives(field.annotation):
            if annotation is float:
                found.append(here)
            elif isinstance(annotation, type) and issubclass(annotation, BaseModel):
                found += numbers_of(annotation, here)
    return found


def _alternatives(annotation: Any) -> list[Any]:
    if get_origin(annotation) in (Union, types.UnionType):
        return [inner for part in get_args(annotation) for inner in _alternatives(part)]
    if get_origin(annotation) not in (None, Literal, list, dict, tuple) and get_args(annotation):
        return _alternatives(get_args(annotation)[0])
    return [annotation]


COMPONENTS = [(section, name) for section in ("stages", "sinks") for name in names(section)]
NUMBERS = [
    pytest.param(section, name, path, id=f"{name}.{'.'.join(path)}")
    for section, name in COMPONENTS
    for path in numbers_of(resolve(name, section, REPOSITORY).params)
]


@pytest.mark.parametrize(("section", "name", "path"), NUMBERS)
def test_a_pipeline_file_refuses_nan_and_infinity_with_their_place(
    section: str, name: str, path: tuple[str, ...]
) -> None:
    for value in (".nan", ".inf", "-.inf"):
        overrides = [f"{section}.{name}.use={name}", f"{section}.{name}.{'.'.join(path)}={value}"]
        with pytest.raises(ConfigError, match=path[-1]):
            load_pipeline(REPOSITORY / "pipeline.yaml", overrides)


def test_the_table_of_numbers_is_not_empty() -> None:
    found = {parameter.id for parameter in NUMBERS}
    assert {"hull.min_area", "tracker.dot", "smooth.min_cutoff", "probe.false_alarms"} <= found
