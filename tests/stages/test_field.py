"""Stage `field`."""

from __future__ import annotations

import numpy as np

from tactflow.engine.contract import StageParams
from tactflow.engine.frame import Absent
from tactflow.stages.field import Field, FieldPorts
from tactflow.vision.types import Markers, MarkerStatus

ORIGIN = np.array([[20.0, 20], [40, 20], [20, 40], [40, 40], [80, 50]])
IMAGE = np.zeros((60, 90, 3), np.uint8)


def markers(shift: float, status: int = MarkerStatus.TRACKED, origin: np.ndarray = ORIGIN) -> Markers:
    count = len(origin)
    return Markers(origin, origin + shift, np.full(count, status, np.uint8), np.full(count, 0.02))


def test_it_gives_the_field_over_the_frame() -> None:
    made = Field(StageParams()).process(markers(1.5), IMAGE)
    assert isinstance(made, FieldPorts)
    points = made.field.grid.points
    assert points.min() >= 0
    assert points[..., 0].max() <= 89
    assert points[..., 1].max() <= 59
    # Close to the markers the gel moves as they do; the field stays within three of its standard errors.
    near = np.hypot(*(points - ORIGIN[0]).transpose(2, 0, 1)) < 6
    off = np.abs(made.field.displacement - 1.5).max(axis=2)
    assert near.any()
    assert (off[near] < 3 * made.field.stderr[near]).all()


def test_another_reference_is_noticed_by_its_markers() -> None:
    stage = Field(StageParams())
    stage.process(markers(1.0), IMAGE)
    other = ORIGIN + 3
    again = stage.process(markers(1.0, origin=other), IMAGE)
    fresh = Field(StageParams()).process(markers(1.0, origin=other), IMAGE)
    assert isinstance(again, FieldPorts)
    assert isinstance(fresh, FieldPorts)
    np.testing.assert_array_equal(again.field.displacement, fresh.field.displacement)


def test_without_markers_that_are_seen_there_is_no_field() -> None:
    stage = Field(StageParams())
    assert stage.process(markers(1.0, origin=ORIGIN[:2]), IMAGE) == Absent("no_markers")
    assert stage.process(markers(1.0, MarkerStatus.INFERRED), IMAGE) == Absent("no_markers")
