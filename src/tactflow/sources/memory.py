"""Frames in memory: an array, a list, or any iterator of pictures."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sized
from itertools import count
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactflow.engine.errors import SourceError
from tactflow.sources.base import DEFAULT_FPS, FrameReader, check_array


class MemoryFrames(FrameReader):
    """Pictures in memory as a recording; the time of frame i is i / fps.

    `tactflow.stream(source=frames)` uses this reader. It requests pictures of an iterator one at a time, when
    the pipeline is ready for the next one.

    Parameters
    ----------
    frames : (N, H, W, 3) BGR or (N, H, W) gray array of uint8 or uint16, or an iterable of pictures
        (H, W, 3) or (H, W), all of one size. They are not copied: do not modify them afterwards.
    fps : frames per second; 30 by default.
    numbers : index of each picture, if some are missing; 0, 1, 2, ... by default.

    Raises
    ------
    SourceError
        From `read`, if a picture is not an array of such pixels or of another size than the first one.

    Examples
    --------
    >>> reader = MemoryFrames(np.zeros((2, 48, 64), np.uint8), fps=10)
    >>> reader.total, [(image.shape, t) for image, t in iter(reader.read, None)]
    (2, [((48, 64, 3), 0.0), ((48, 64, 3), 0.1)])
    """

    def __init__(
        self,
        frames: Iterable[NDArray[Any]],
        fps: float | None = None,
        numbers: Iterable[int] | None = None,
    ) -> None:
        super().__init__("frames in memory")
        if isinstance(frames, np.ndarray):
            check_array(frames, "an array")
        self.fps = fps or DEFAULT_FPS
        self.total = len(frames) if isinstance(frames, Sized) else None
        self.description = f"{'' if self.total is None else f'{self.total} '}frames in memory"
        self._pictures = frames
        self._numbers = count() if numbers is None else numbers

    def _frames(self) -> Iterator[tuple[NDArray[Any], float, int]]:
        for index, image in zip(self._numbers, self._pictures, strict=False):
            self._picture = f"picture {index}"
            if not isinstance(image, np.ndarray):
                raise SourceError(f"picture {index}: required an array, got {type(image)}")
            yield image, index / (self.fps or DEFAULT_FPS), index
