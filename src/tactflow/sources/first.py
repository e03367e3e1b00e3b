"""The first frames of a source, examined before they are handed out: which of them are the reference?"""

from __future__ import annotations

from typing import Final

from tactflow.sources.base import BgrImage, log
from tactflow.vision.change import Settling

MEMORY: Final = 128_000_000
"""Bytes of frames that are held at most while they are examined. Chosen by hand."""


class FirstFrames:
    """Chooses the reference among the first frames, and tells the user if it is not the very first.

    name : of the source, in messages. seconds : after which the light must be steady. count : of references.

    >>> import numpy as np
    >>> first = FirstFrames("example", seconds=3.0, count=2)
    >>> [first.look(np.full((48, 64, 3), 100, np.uint8), i / 30) for i in range(10)].index(True)
    9
    >>> first.references()
    [0, 1]
    """

    def __init__(self, name: str, seconds: float, count: int) -> None:
        self._name = name
        self._seconds = seconds
        self._count = count
        self._settling = Settling()
        self._began: float | None = None
        self._bytes = 0

    def look(self, image: BgrImage, t: float) -> bool:
        """Examine the next frame, taken at t, s; True once no more frames are needed."""
        self._began = t if self._began is None else self._began
        self._bytes += image.nbytes
        settling = self._settling
        settling.add(image, t)
        if settling.touched or settling.unrelated or (settling.steady and len(settling) >= self._count):
            return True
        return t - self._began >= self._seconds or self._bytes > MEMORY

    @property
    def separate(self) -> bool:
        """Whether these are separate pictures, most unlike the one before, rather than a video."""
        return self._settling.scattered

    def references(self) -> list[int]:
        """Indices of the frames that show the untouched gel, in order: `count` of them, or as many as do."""
        settling = self._settling
        best, alike = settling.best(), settling.alike()
        begin = max(0, min(alike.index(best) - self._count // 2, len(alike) - self._count))
        self._report(best)
        return alike[begin : begin + self._count]

    def _report(self, best: int) -> None:
        """Say in one line which frame is the reference and why, unless it is clearly the very first."""
        settling = self._settling
        if settling.changing:
            log.warning(
                "%s: the light is not steady, it changed by %.0f %% within the last frames; the reference is "
                "frame %d. Fix exposure and white balance of the camera, or raise settle",
                *(self._name, 100 * settling.drift, best),
            )
            return
        if settling.undecided:
            why = (
                f", although the gel came to rest in another state at frame {settling.begins}; if it was "
                "touched until then, name a picture of the untouched gel: stages.capture.reference"
            )
        elif settling.touched_before(best):
            why = "; the gel was touched or moved before"
        elif best > 0:
            why = "; the camera was setting exposure and white balance until then"
        else:
            return
        log.info("%s: the reference is frame %d%s", self._name, best, why)
