"""Stage `flow_in_mask`."""

from __future__ import annotations

import numpy as np
import pytest

from tactflow.stages.flow_in_mask import FlowInMask
from tactflow.vision.flow import FieldModel
from tactflow.vision.types import Markers

ORIGIN = np.array([[20.0, 20], [40, 20], [20, 40], [40, 40], [80, 50]])
MASK = np.zeros((60, 90), np.uint8)
MASK[15:45, 15:40] = 255


def test_with_a_field_the_mean_is_an_integral_unless_that_over_markers_is_asked_for() -> None:
    position = ORIGIN + np.array([[2.0, 0], [0, 0], [0, 0], [0, 0], [0, 0]])
    markers = Markers(ORIGIN, position, np.zeros(5, np.uint8), np.full(5, 0.02))
    field = FieldModel(ORIGIN, (90, 60))(markers)
    integral, plain = (
        FlowInMask(FlowInMask.Params(method=method)).process(markers, MASK, field)
        for method in ("field", "mean")
    )
    assert plain == FlowInMask(FlowInMask.Params()).process(markers, MASK)
    assert plain.mean == (1.0, 0.0)  # of the two markers inside, one has moved by 2
    assert 0.1 < integral.mean[0] < 1.0
    assert integral.count == plain.count == 2


def test_where_only_dots_show_a_contact_its_mean_is_as_uncertain_as_the_gel_there_moves_differently() -> None:
    x, y = np.meshgrid(np.arange(10.0, 300, 20), np.arange(10.0, 300, 20))
    origin = np.column_stack([x.ravel(), y.ravel()])
    moved = 0.02 * (origin - 150) @ [[0, 1], [-1, 0]]
    markers = Markers(origin, origin + moved, np.zeros(len(origin), np.uint8), np.full(len(origin), 0.02))
    field = FieldModel(origin, (300, 300))(markers)
    mask = np.zeros((300, 300), np.uint8)
    mask[50:250, 50:250] = 255
    stage = FlowInMask(FlowInMask.Params())
    light, dots = (stage.process(markers, mask, field, evidence) for evidence in ("both", "dots"))
    assert dots.mean == light.mean
    # Each component varies evenly from -2 to 2 px within the square.
    assert dots.stderr == pytest.approx((2 / 3**0.5,) * 2, rel=0.03)
    assert max(light.stderr) < 0.1
