"""Plain version of the kernel that traces outlines as far as they are seen."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.uint8]


def plain_trace_outlines(
    mask: Mask,
    hidden: Mask,
    beside: Mask,
    marks: Mask,  # noqa: ARG001
    points: NDArray[np.int32],
    ends: NDArray[np.int32],
) -> int:
    """OpenCV's outlines, of whose pixels those are kept that are seen and between others not on a line."""
    found, _ = cv2.findContours(mask | hidden, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    count = 0
    ends[0] = 0
    for outline in found[::-1]:
        x, y = outline[:, 0].T
        seen = beside[y, x] == 0
        before, after = np.roll(outline, 1, axis=0), np.roll(outline, -1, axis=0)
        straight = np.all(outline - before == after - outline, axis=(1, 2)) & (len(outline) > 1)
        kept = outline[seen & ~(straight & np.roll(seen, 1) & np.roll(seen, -1))]
        if len(kept):
            start, count = ends[count, 0], count + 1
            ends[count] = start + len(kept), len(outline)
            points[start : ends[count, 0]] = kept
    return count
