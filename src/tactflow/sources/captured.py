"""The frames of a source with their numbers, references and epochs, as `capture` hands them over."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactflow.engine.errors import SourceError
from tactflow.engine.frame import Frame
from tactflow.sources.base import FrameReader, StampedReader
from tactflow.sources.files import ImageFiles
from tactflow.sources.first import FirstFrames
from tactflow.sources.pace import Pace
from tactflow.sources.watch import Arrival, Watched

logger = logging.getLogger("tactflow")


@dataclass(kw_only=True)
class CapturedFrames:
    """Every frame of a source, in order, until its end or `stop`.

    The first frames of a recording are examined ahead: if one of them is a better reference than the very
    first, it comes before all others, with number -1. Those of a live source are left out until it is steady.
    A recording of tactflow's own knows its references; `count`, `image`, `settle` and `skip` do not apply.

    source, name : the source, and what messages call it. sensor : name given to every frame.
    count : of reference frames, at the start and whenever they are retaken.
    image : (H, W, 3) uint8 BGR, shown before the first frame as the reference; None: the first frames are.
    settle : seconds after which the light must be steady; 0: the reference is taken at once.
    skip : frames left out at the start, and after each reconnection.
    retake_on_reconnect : whether a source that comes back takes a new reference.
    realtime : play a recording at its own pace.
    stop, retake : may be set from any thread: end soon; make the next frames a reference in a new epoch.
    left_out : frames of a live source that were only examined.
    """

    source: FrameReader
    name: str
    sensor: str
    count: int
    image: NDArray[np.uint8] | None
    settle: float
    skip: int
    retake_on_reconnect: bool
    realtime: bool
    stop: threading.Event
    retake: threading.Event
    left_out: int = 0
    _references_left: int = 0
    _epoch: int = 0

    def __iter__(self) -> Iterator[Frame]:
        """Raises SourceError if a frame cannot be read, or is not as large as the reference image."""
        if isinstance(self.source, StampedReader):
            return self._replay(self.source)
        if isinstance(self.source, Watched):
            return self._watch(self.source)
        return self._play(self.source)

    def _play(self, source: FrameReader) -> Iterator[Frame]:
        """Frames of a recording, after those that show the untouched gel if these are not the first ones."""
        for _ in range(self.skip):
            if self.stop.is_set() or source.read() is None:
                return
        shown_before, self._references_left = self._choose(source)
        for seq, (image, t) in enumerate(self._paced(source.read), self.skip):
            for picture in shown_before:
                yield self._shown_before(picture, image, t)
            shown_before = []
            yield self._frame(image, t, seq)

    def _choose(self, source: FrameReader) -> tuple[list[NDArray[np.uint8]], int]:
        """Pictures to show before the first frame, and how many of the first frames are references."""
        if self.image is not None:
            return [self.image], 0
        if self.settle == 0 or source.live:
            return [], self.count
        first = FirstFrames(self.name, self.settle, self.count)
        pictures: list[NDArray[np.uint8]] = []
        while not self.stop.is_set() and (item := source.peek()) is not None:
            pictures.append(item[0])
            if first.look(*item):
                break
        chosen = first.references() if pictures else []
        if isinstance(source, ImageFiles) and first.separate and chosen[0] == 0:
            logger.info(
                "%s: separate pictures; %s, the first by name, is taken for the untouched gel. "
                "If another one shows that, name it: stages.capture.reference",
                self.name,
                source.first,
            )
        if chosen == list(range(len(chosen))):
            return [], len(chosen)
        return [pictures[index] for index in chosen], 0

    def _replay(self, source: StampedReader) -> Iterator[Frame]:
        """Frames as they were captured the first time; references that are retaken now come on top."""
        for image, t, stamp in self._paced(source.read_stamped):
            again = self._is_reference(retake=stamp.seq >= 0)
            reference, epoch = stamp.reference or again, stamp.epoch + self._epoch
            picture = _read_only(image)
            yield Frame(self.sensor, stamp.seq, t, picture, time.perf_counter(), reference, epoch)

    def _watch(self, source: Watched) -> Iterator[Frame]:
        """Frames of a source that numbers them where they arrive, and that may go and come back."""
        image, self._references_left = self.image, self.count if self.image is None else 0
        first = self._first_frames() if image is None else None
        held: list[Arrival] = []
        connection, begins = 0, self.skip
        while not self.stop.is_set() and (arrival := source.read_arrival()) is not None:
            if arrival.connection != connection:
                connection, begins = arrival.connection, arrival.seq + self.skip
                if self.retake_on_reconnect:
                    self.retake.set()
                    first, held = self._first_frames(), []
            if arrival.seq < begins:
                continue
            if image is not None:
                yield self._shown_before(image, arrival.image, arrival.t)
                image = None
            held.append(arrival)
            if first is not None:
                if not first.look(arrival.image, arrival.t):
                    continue
                chosen = first.references()
                self.left_out += len(held) - len(chosen)
                held = [held[index] for index in chosen]
                # Whatever was requested before, these are the references.
                self._is_reference()
                self._references_left = len(chosen)
                first = None
            for arrived in held:
                yield self._frame(arrived.image, arrived.t, arrived.seq, arrived.captured)
            held = []

    def _paced(self, read: Callable[[], Any]) -> Iterator[Any]:
        """What `read` returns, at times that never run back, and at its own pace if that is asked for."""
        pace = Pace(self.stop) if self.realtime and not self.source.live else None
        latest, ahead, steps_back = -math.inf, 0.0, 0
        while not self.stop.is_set():
            if pace is not None and not pace.wait_to_read():
                break
            item = read()
            if item is None:
                break
            image, t, *stamp = item
            t += ahead
            if not stamp or stamp[0].paced:
                if t < latest:
                    if not steps_back:
                        text = "%s: its times run back by %.3g s; they are counted on from there"
                        logger.warning(text, self.name, latest - t)
                    steps_back += 1
                    ahead, t = ahead + latest - t, latest
                latest = t
                if pace is not None and not pace.wait_for(t):
                    break
            yield image, t, *stamp
        if steps_back:
            logger.warning("%s: its times ran back at %d frames", self.name, steps_back)

    def _first_frames(self) -> FirstFrames | None:
        """What examines the first frames of a live source; None if they are handed out at once."""
        return FirstFrames(self.name, self.settle, self.count) if self.settle > 0 else None

    def _is_reference(self, *, retake: bool = True) -> bool:
        """Whether the next frame is a reference. retake : whether a new epoch may begin with it."""
        if retake and self.retake.is_set():
            self.retake.clear()
            self._epoch += 1
            self._references_left = self.count
        reference = self._references_left > 0
        self._references_left -= reference
        return reference

    def _frame(self, image: NDArray[np.uint8], t: float, seq: int, captured: float | None = None) -> Frame:
        reference = self._is_reference()
        captured = time.perf_counter() if captured is None else captured
        return Frame(self.sensor, seq, t, _read_only(image), captured, reference, self._epoch)

    def _shown_before(self, image: NDArray[np.uint8], first: NDArray[np.uint8], t: float) -> Frame:
        """A reference that comes before the first frame, which was taken at t."""
        if image.shape != first.shape:
            raise SourceError(
                f"stages.capture.reference is an image of {image.shape[1]} x {image.shape[0]} pixels, the "
                f"frames of {self.name} have {first.shape[1]} x {first.shape[0]}; they must be equally large"
            )
        return Frame(self.sensor, -1, t, _read_only(image), time.perf_counter(), reference=True)


def _read_only(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    image = image.view()
    image.setflags(write=False)
    return image
