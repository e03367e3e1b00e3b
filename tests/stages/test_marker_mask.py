"""Stage `marker_mask`: finds out how the dots look, once per reference."""

from __future__ import annotations

from typing import Any

import numpy as np

from tactflow.sim import open_scene
from tactflow.stages.marker_mask import MarkerMaskStage
from tactflow.vision.markers.mask import Dot, marker_mask


def _stage(**params: Any) -> MarkerMaskStage:
    return MarkerMaskStage(MarkerMaskStage.Params(**params))


def test_dots_are_looked_for_in_the_first_frame_and_again_after_reset() -> None:
    dark, bright = (open_scene(f"{name}?frames=2").frame(0) for name in ("idle", "bright_dots"))
    stage = _stage()
    first = stage.process(dark)
    assert first.any()
    assert not stage.process(bright).astype(bool).mean() > 0.05
    stage.reset()
    again = stage.process(bright)
    assert (first.astype(bool) & again.astype(bool)).sum() > 0.7 * first.astype(bool).sum()


def test_a_gel_without_markers_gets_an_empty_mask() -> None:
    frame = open_scene("unmarked?frames=2").frame(0)
    mask = _stage().process(frame)
    assert mask.shape == frame.shape[:2]
    assert not mask.any()


def test_given_values_replace_what_would_be_found() -> None:
    frame = open_scene("idle?frames=2").frame(0)
    mask = _stage(dot=9.0, polarity="dark", contrast=30.0).process(frame)
    assert np.array_equal(mask, marker_mask(frame, Dot(9.0, "dark", 30.0)))
