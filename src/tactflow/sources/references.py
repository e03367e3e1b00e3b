"""Choosing the reference: frames that show the untouched gel."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Final

from tactflow.engine.errors import SourceError
from tactflow.sources.base import Arrival, BgrImage, FrameReader, log
from tactflow.sources.files import ImageFiles
from tactflow.vision.change import Settling

MEMORY: Final = 128_000_000
"""Maximum size of the frames held back while they are examined, bytes. Chosen by hand."""


class References:
    """Chooses the reference frames, and reports if they are not the first ones.

    name : of the source, for messages. count : number of reference frames. settle : longest time until the
    light is steady, s; 0 takes the first frames.

    left_out : number of frames of a live source that were examined but not delivered.
    """

    def __init__(self, name: str, count: int, settle: float) -> None:
        self._name = name
        self._count = count
        self._settle = settle
        self._requested = threading.Event()
        self._left = 0
        self._epoch = 0
        self.left_out = 0

    def retake(self) -> None:
        """Make the next `count` frames the reference of a new epoch. Thread-safe."""
        self._requested.set()

    def arranged(
        self, arrivals: Iterator[Arrival], source: FrameReader, image: BgrImage | None
    ) -> Iterator[Arrival]:
        """Mark the references among the frames of a source.

        The first frames are held back until the reference is chosen. If it is not the first frame, it is also
        delivered before all others, with number -1; for a live source, the others are omitted.

        image : (H, W, 3) uint8 BGR, a reference that replaces the first frames; or None.
        """
        if image is not None:
            first = next(arrivals, None)
            if first is None:
                return
            yield self._shown_before(image, first)
            yield self.marked(first)
        elif self._settle > 0:
            yield from self._settled(arrivals, source)
        else:
            self._left = self._count
        yield from map(self.marked, arrivals)

    def _settled(self, arrivals: Iterator[Arrival], source: FrameReader) -> Iterator[Arrival]:
        """The first frames, once the reference is chosen; for a live source, only the references."""
        settling, goes_on, failure = Settling(), True, None
        held: list[Arrival] = []
        try:
            while goes_on and (arrival := next(arrivals, None)) is not None:
                held.append(arrival)
                goes_on = self._goes_on(settling, held)
        except SourceError as error:
            # The frames before it are delivered first.
            failure = error
        if held and not (source.live and goes_on):
            chosen = self._choose(settling, source)
            if source.live:
                self.left_out += len(held) - len(chosen)
                held = [held[index] for index in chosen]
            if source.live or chosen == list(range(len(chosen))):
                self._begin(len(chosen))
            else:
                yield from (self._shown_before(held[index].image, held[0]) for index in chosen)
            yield from map(self.marked, held)
        if failure is not None:
            raise failure

    def marked(self, arrival: Arrival) -> Arrival:
        """The next frame, marked if it is a reference."""
        if arrival.seq >= 0 and self._requested.is_set():
            self._begin(self._count)
        reference = self._left > 0
        self._left -= reference
        return arrival._replace(reference=reference or arrival.reference, epoch=arrival.epoch + self._epoch)

    def _begin(self, count: int) -> None:
        """Make the next frames references, in a new epoch if requested."""
        if self._requested.is_set():
            self._requested.clear()
            self._epoch += 1
        self._left = count

    def _goes_on(self, settling: Settling, held: list[Arrival]) -> bool:
        """Examine the newest frame; returns whether more frames are needed."""
        image, t = held[-1].image, held[-1].t
        settling.add(image, t)
        steady = settling.steady and len(settling) >= self._count
        decided = settling.touched or settling.unrelated or steady
        full = sum(arrival.image.nbytes for arrival in held) > MEMORY
        return not (decided or full or t - held[0].t >= self._settle)

    def _choose(self, first: Settling, source: FrameReader) -> list[int]:
        """Indices of frames that show the untouched gel, in order: `count` of them, or fewer."""
        best, alike = first.best(), first.alike()
        begin = max(0, min(alike.index(best) - self._count // 2, len(alike) - self._count))
        chosen = alike[begin : begin + self._count]
        self._report(first, best, source)
        return chosen

    def _report(self, first: Settling, best: int, source: FrameReader) -> None:
        """Log which frame is the reference and why, unless it is clearly the first one."""
        if first.changing:
            log.warning(
                "%s: the light is not steady, it changed by %.0f %% within the last frames; the reference is "
                "frame %d. Fix exposure and white balance of the camera, or raise settle",
                *(self._name, 100 * first.drift, best),
            )
            return
        if isinstance(source, ImageFiles) and first.scattered and best == 0:
            log.info(
                "%s: separate pictures; %s, the first by name, is taken for the untouched gel. "
                "If another one shows that, name it: stages.capture.reference",
                *(self._name, source.first),
            )
            return
        if first.undecided:
            why = (
                f", although the gel came to rest in another state at frame {first.begins}; if it was "
                "touched until then, name a picture of the untouched gel: stages.capture.reference"
            )
        elif first.touched_before(best):
            why = "; the gel was touched or moved before"
        elif best > 0:
            why = "; the camera was setting exposure and white balance until then"
        else:
            return
        log.info("%s: the reference is frame %d%s", self._name, best, why)

    def _shown_before(self, image: BgrImage, first: Arrival) -> Arrival:
        """A reference delivered before the first frame, whose size it must have."""
        (height, width), (high, wide) = image.shape[:2], first.image.shape[:2]
        if (height, width) != (high, wide):
            raise SourceError(
                f"stages.capture.reference is an image of {width} x {height} pixels, the frames of "
                f"{self._name} have {wide} x {high}; they must be equally large"
            )
        return Arrival(image, first.t, -1, reference=True, paced=False)
