"""Stage `depth`: what is known about the gel bounds its heights."""

from __future__ import annotations

import numpy as np
import pytest

from tactflow.calibration import KINDS
from tactflow.calibration.file import Calibration
from tactflow.stages.depth import Depth

GEL = np.full((240, 320, 3), 100, np.uint8)
Y, X = np.mgrid[:240, :320].astype(np.float32)
MASK = np.full((240, 320), 255, np.uint8)


@pytest.mark.parametrize(("own", "most"), [(None, 4.0), (2.0, 2.0), (50.0, None)])
def test_no_depth_exceeds_the_gel_of_the_calibration_or_that_of_the_pipeline(
    own: float | None, most: float | None
) -> None:
    mini = Calibration.load(KINDS / "mini.yaml")
    # A cone, 7 mm deep.
    away = np.maximum(np.hypot(X - 160, Y - 120), 1)
    gradients = np.stack([(160 - X) / away, (120 - Y) / away], axis=2)
    stage = Depth(Depth.Params(gel_thickness=own), mini)
    depth = stage.process(GEL, GEL, MASK, mini.scale, gradients)
    if most is None:
        assert depth.greatest > 5
    else:
        assert depth.greatest == most
    unknown = mini.model_copy(update={"gel_thickness": None})
    assert Depth(Depth.Params(), unknown).process(GEL, GEL, MASK, mini.scale, gradients).greatest > 5
