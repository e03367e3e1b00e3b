"""What the page of a batch shows of a recording."""

from __future__ import annotations

import numpy as np
import pytest

from tactflow import Frame, Result
from tactflow.tools.batch.summary import TRACE_POINTS, Trace


@pytest.mark.parametrize("frames", [1, 2 * TRACE_POINTS, 10_000])
def test_a_curve_of_a_recording_of_any_length_is_short_and_spans_it(frames: int) -> None:
    trace = Trace()
    for seq in range(frames):
        trace.add(Result(Frame("main", seq, seq / 30, np.zeros((4, 6, 3), np.uint8)), {}))
    times = trace.values["t"]
    assert min(frames, TRACE_POINTS) <= len(times) <= 2 * TRACE_POINTS
    assert times[0] == 0
    assert times[-1] > 0.98 * (frames - 1) / 30 - 1e-9
    assert trace.values["area"] == [None] * len(times)
