"""A calibration made without pictures, for tests of what it holds."""

from __future__ import annotations

from typing import Any

import numpy as np

from tactflow.calibration.file import Calibration, ScaleEntry
from tactflow.vision.types import Scale

SCALE = Scale(0.1, 0.1, (0.0, 0.0), (0.0, 0.0))


def bare_calibration(size: tuple[int, int] = (32, 24), scale: Scale = SCALE, **parts: Any) -> Calibration:
    """One of an even gray gel, with a scale. size : of raw and processed frames. parts : what else it has."""
    given = {"look": np.full((12, 16, 3), 90, np.float32)} | parts
    return Calibration(
        sensor="main",
        made_from="a.mcap",
        raw_size=size,
        size=size,
        corners=[(0.0, 0.0)] * 4,
        scale=ScaleEntry.of(scale, "pitch"),
        **given,
    )
