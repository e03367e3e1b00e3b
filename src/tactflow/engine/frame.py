"""What travels: frames, ticks, and values that are absent for a reason."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

MOST_PIXELS = int(os.environ["OPENCV_IO_MAX_IMAGE_PIXELS"])
"""Pixels of a picture at most; see `tactflow/__init__.py`."""


@dataclass(frozen=True, slots=True)
class Frame:
    """One captured frame. Immutable; the image is read-only.

    sensor : name of the sensor.
    seq : index of the frame at the source, from 0; a dropped frame leaves a gap. -1 for a reference image
        that was loaded from a file and is not part of the source.
    t : capture time, s: for a recording, time from its start; for a live source, Unix time.
    image : (H, W, 3) uint8 BGR, as it came from the source, not writeable.
    captured : monotonic clock (`time.perf_counter`) when the source handed the frame over, s; where it is 0,
        the run says when it got the frame.
    reference : True if this frame shows the untouched gel that later frames are compared with.
    epoch : grows by one each time a new reference is taken; stages are reset between epochs.

    >>> Frame("main", 36, 1.2, np.zeros((600, 800, 3), np.uint8)).seq
    36
    """

    sensor: str
    seq: int
    t: float
    image: NDArray[np.uint8]
    captured: float = 0.0
    reference: bool = False
    epoch: int = 0


@dataclass(frozen=True, slots=True)
class Absent:
    """Stands in the place of a value that this tick does not have.

    reason : a short snake_case word.

    >>> Absent("no_contact")
    Absent(reason='no_contact')
    """

    reason: str


@dataclass(frozen=True, slots=True)
class Tick:
    """What a sink may know about a tick besides the values of its input ports.

    frame : the captured frame (its image is the raw one).
    skipped : input port of this sink -> reason, for values that were not computed in this tick; "reference"
        -> reason, where a stage asked for this frame to become a new reference.

    >>> frame = Frame("main", 0, 0.0, np.zeros((4, 6, 3), np.uint8))
    >>> Tick(frame, {"contact": "no_contact"}).skipped["contact"]
    'no_contact'
    """

    frame: Frame
    skipped: Mapping[str, str] = field(default_factory=dict[str, Any])
