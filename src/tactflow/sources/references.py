"""Which frames of a source show the untouched gel, and come first as the reference."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Final

from tactflow.engine.errors import SourceError
from tactflow.sources.base import Arrival, BgrImage, FrameReader, log
from tactflow.sources.files import ImageFiles
from tactflow.vision.change import Settling

MEMORY: Final = 128_000_000
"""Bytes of frames that are held at most while they are examined. Chosen by hand."""


class References:
    """Chooses the reference frames, and tells the user if they are not the very first ones.

    name : of the source, in messages. count : of frames. settle : time after which the light must be steady,
    s; 0 takes the very first frames. retakes : whether a reconnection begins a new epoch.

    left_out : frames of a live source that were examined and not handed over.
    """

    def __init__(self, name: str, count: int, settle: float, *, retakes: bool = False) -> None:
        self._name = name
        self._count = count
        self._settle = settle
        self._retakes = retakes
        self._requested = threading.Event()
        self._left = 0
        self._epoch = 0
        self.left_out = 0

    def retake(self) -> None:
        """Make the next frames the new reference, in a new epoch: `count` of them. From any thread."""
        self._requested.set()

    def arranged(
        self, arrivals: Iterator[Arrival], source: FrameReader, image: BgrImage | None
    ) -> Iterator[Arrival]:
        """The frames of a source with their references marked.

        The first ones are held back until it is known which of them is the reference. If it is not the very
        first one, it comes before all others, with number -1; of a live source, the others are left out.

        image : (H, W, 3) uint8 BGR, the reference in place of the first frames; or None.
        """
        first = None
        if image is None:
            first = self._begin_settling()
            self._left = self._count if first is None else 0
        held: list[Arrival] = []
        connection, failure = 0, None
        try:
            for arrival in arrivals:
                if arrival.connection != connection and self._retakes:
                    self.retake()
                    first, held = self._begin_settling(), []
                connection = arrival.connection
                if image is not None:
                    yield self._shown_before(image, arrival)
                    image = None
                held.append(arrival)
                if first is not None and self._goes_on(first, held):
                    continue
                yield from self._released(first, held, source)
                first, held = None, []
        except SourceError as error:
            failure = error
        if not source.live:
            yield from self._released(first, held, source)
        if failure is not None:
            raise failure

    def marked(self, arrival: Arrival) -> Arrival:
        """The next frame, as a reference if it is one."""
        if arrival.seq >= 0 and self._requested.is_set():
            self._begin(self._count)
        reference = self._left > 0
        self._left -= reference
        return arrival._replace(reference=reference or arrival.reference, epoch=arrival.epoch + self._epoch)

    def _begin(self, count: int) -> None:
        """Make the next frames references; in a new epoch if that was requested."""
        if self._requested.is_set():
            self._requested.clear()
            self._epoch += 1
        self._left = count

    def _begin_settling(self) -> Settling | None:
        """What examines the first frames; None if they are handed out at once."""
        return Settling() if self._settle > 0 else None

    def _goes_on(self, first: Settling, held: list[Arrival]) -> bool:
        """Examine the newest frame; whether more frames are needed."""
        image, t = held[-1].image, held[-1].t
        first.add(image, t)
        decided = first.touched or first.unrelated or (first.steady and len(first) >= self._count)
        full = sum(arrival.image.nbytes for arrival in held) > MEMORY
        return not (decided or full or t - held[0].t >= self._settle)

    def _released(
        self, first: Settling | None, held: list[Arrival], source: FrameReader
    ) -> Iterator[Arrival]:
        """The frames that were held back; of a live source, the references alone."""
        if first is not None and held:
            chosen = self._choose(first, source)
            if source.live:
                self.left_out += len(held) - len(chosen)
                held = [held[index] for index in chosen]
            if source.live or chosen == list(range(len(chosen))):
                self._begin(len(chosen))
            else:
                yield from (self._shown_before(held[index].image, held[0]) for index in chosen)
        yield from map(self.marked, held)

    def _choose(self, first: Settling, source: FrameReader) -> list[int]:
        """Indices of the frames that show the untouched gel, in order: `count` of them, or as many as do."""
        best, alike = first.best(), first.alike()
        begin = max(0, min(alike.index(best) - self._count // 2, len(alike) - self._count))
        chosen = alike[begin : begin + self._count]
        self._report(first, best, source)
        return chosen

    def _report(self, first: Settling, best: int, source: FrameReader) -> None:
        """Say in one line which frame is the reference and why, unless it is clearly the very first."""
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
        """A reference that comes before the first frame, and as large as that."""
        (height, width), (high, wide) = image.shape[:2], first.image.shape[:2]
        if (height, width) != (high, wide):
            raise SourceError(
                f"stages.capture.reference is an image of {width} x {height} pixels, the frames of "
                f"{self._name} have {wide} x {high}; they must be equally large"
            )
        return Arrival(image, first.t, -1, reference=True, paced=False)
