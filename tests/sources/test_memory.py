"""Frames that a program already has."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tactflow.engine.errors import SourceError
from tactflow.sources.memory import MemoryFrames

FRAMES = np.random.default_rng(0).integers(0, 256, (3, 12, 16, 3), np.uint8)


def test_an_iterator_is_asked_for_one_picture_at_a_time() -> None:
    asked = []
    reader = MemoryFrames(asked.append(index) or FRAMES[index] for index in range(3))
    reader.read()
    assert asked == [0]
    reader.close()
    assert reader.read() is None


@pytest.mark.parametrize(
    ("frames", "said"),
    [
        (FRAMES / 255, "got float64"),
        ([FRAMES[0], FRAMES[0, :5]], "16 x 5 pixels, the ones before it are 16 x 12"),
        ([np.zeros(5, np.uint8)], "channels"),
    ],
)
def test_what_is_no_picture_is_an_error_that_says_what_came(frames: Any, said: str) -> None:
    with pytest.raises(SourceError, match=said):
        list(iter(MemoryFrames(frames).read, None))
