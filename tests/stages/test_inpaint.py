"""Stage `inpaint`: hands its parameters to the vision function."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest

from tactflow.stages.inpaint import Inpaint
from tactflow.vision.markers.inpaint import InpaintMethod, remove_markers

IMAGE = np.random.default_rng(8).integers(0, 256, (40, 30, 3), dtype=np.uint8)
MASK = np.zeros((40, 30), np.uint8)
MASK[10:16, 12:18] = 255


@pytest.mark.parametrize("method", get_args(InpaintMethod))
def test_stage_gives_what_the_function_gives(method: InpaintMethod) -> None:
    stage = Inpaint(Inpaint.Params(method=method, radius=3))
    assert np.array_equal(stage.process(IMAGE, MASK), remove_markers(IMAGE, MASK, method=method, radius=3))
