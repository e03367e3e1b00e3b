"""Calling a stage without the engine: a `Frame` is created from the picture."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import wraps
from itertools import count
from typing import Any

import numpy as np

from tactflow.engine.frame import NO_PICTURE, Frame
from tactflow.engine.ports import Port

FPS = 30.0
"""Rate of the created frames, Hz: the default of recordings."""


def with_frames_made(process: Callable[..., Any], inputs: Sequence[Port]) -> Callable[..., Any]:
    """`process` with an optional parameter `frame: Frame`; the first call is the reference.

    Positional arguments are the other inputs, in order; the frame is created from the first array among them.
    A stage whose only input is the frame takes the picture instead.

    process : of a stage. inputs : its ports.

    >>> def process(frame: Frame) -> tuple[int, ...]:
    ...     return frame.image.shape
    >>> with_frames_made(process, [Port("frame", Frame)])(np.zeros((4, 6, 3), np.uint8))
    (4, 6, 3)
    """
    frame = next((port.name for port in inputs if port.annotation is Frame), None)
    if frame is None:
        return process
    names = [port.name for port in inputs if port.name != frame] or [frame]
    numbers = count()

    @wraps(process)
    def call(*args: Any, **kwargs: Any) -> Any:
        values = dict(zip(names, args, strict=False)) | kwargs
        if len(args) > len(names) or any(isinstance(value, Frame) for value in values.values()):
            return process(*args, **kwargs)
        picture = next((value for value in values.values() if isinstance(value, np.ndarray)), NO_PICTURE)
        seq = next(numbers)
        return process(**values | {frame: Frame("main", seq, seq / FPS, picture)})

    return call
