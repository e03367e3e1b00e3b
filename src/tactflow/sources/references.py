"""Choosing the reference: frames that show the untouched gel."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from itertools import groupby
from typing import Final

import numpy as np

from tactflow.engine.errors import SourceError
from tactflow.sources.base import Arrival, FrameReader, log
from tactflow.sources.files import ImageFiles
from tactflow.vision.arrays import ColorImage
from tactflow.vision.change import DamageTest, Settling, shows_gel

MAX_HELD_BYTES: Final = 128_000_000
"""Maximum size of the frames held back while they are examined, bytes. Chosen by hand."""
BLANK_SECONDS: Final = 3.0
"""Time after which a live source that shows no gel is taken as it is, s; a camera's first second is over."""
NOISE_PAIR_COUNT: Final = 3
"""Pairs of frames that show whether a source has noise: an outlier among them has no effect."""
BLOCK_SIDE_PX: Final = 16
"""Side of the blocks that are searched for noise, px: those of video compression."""
MIN_NOISY_SHARE: Final = 0.9
"""Minimum share of blocks that differ between two frames of a source with noise. A codec repeats most of a
still picture, a drawn one is repeated everywhere."""


class _FirstFrames:
    """The first frames of a source, and which of them may be the reference.

    Frames without gel may not, nor may a picture that is repeated bit by bit at first although the source has
    noise: it was left in a buffer.

    Attributes
    ----------
    held : all frames.
    shown : indices in `held` of those that show gel; the first `frozen` of them were repeated.
    settling : has examined those after.
    blank : number of frames without gel.
    """

    def __init__(self, count: int, settle: float, *, keep_blank: bool, video: bool) -> None:
        self._count, self._settle, self._keep_blank, self._video = count, settle, keep_blank, video
        self.held: list[Arrival] = []
        self.shown: list[int] = []
        self.frozen: int | None = None if settle > 0 else 0
        self.settling = Settling()
        self.blank = 0
        self.decided = False
        self._bytes = 0
        self._began: float | None = None

    def add(self, arrival: Arrival) -> bool:
        """Add the next frame; returns whether more frames are needed."""
        if self._began is None:
            self._began = arrival.t
        if not shows_gel(arrival.image):
            self.blank += 1
            if not self._keep_blank:
                return bool(self.held) or arrival.t - self._began < max(self._settle, BLANK_SECONDS)
            self._hold(arrival)
            return self._bytes <= MAX_HELD_BYTES
        self._hold(arrival)
        self.shown.append(len(self.held) - 1)
        if self.frozen is None:
            self.frozen = self._repeated()
        self._examine()
        lasts = arrival.t - self.held[self.shown[0]].t < self._settle
        return not self.decided and lasts and self._bytes <= MAX_HELD_BYTES

    def end(self) -> None:
        """Examine what has not been examined; without any gel, all frames."""
        if not self.shown:
            self.shown = list(range(len(self.held)))
        self.frozen = self.frozen or 0
        self._examine()

    @property
    def outlived(self) -> bool:
        """Whether a later state of the gel than the first one is the reference."""
        return self._video and len(self.settling) > 0 and self.settling.outlived

    def choose(self) -> tuple[int, list[int]]:
        """The best reference, and all frames like it: indices in `held`, in order."""
        first = self.settling
        best, alike = first.latest() if self.outlived else (first.best(), first.alike())
        return self.place(best), [self.place(index) for index in alike]

    def place(self, index: int) -> int:
        """Index in `held` of a frame of `settling`."""
        return self.shown[(self.frozen or 0) + index]

    @property
    def leftovers(self) -> set[int]:
        """Indices in `held` of pictures of an earlier time."""
        old = self.place(self.settling.begins) if self.outlived else self.place(0)
        return {index for index in self.shown if index < old}

    def _hold(self, arrival: Arrival) -> None:
        if self.held and np.array_equal(arrival.image, self.held[-1].image):
            arrival = arrival._replace(image=self.held[-1].image)
        else:
            self._bytes += arrival.image.nbytes
        self.held.append(arrival)

    def _repeated(self) -> int | None:
        """Number of repeated pictures at the start; None if more frames are needed."""
        images = [self.held[index].image for index in self.shown]
        same = next((index for index, image in enumerate(images) if image is not images[0]), len(images))
        if same == 1 and len(images) > 1:
            return 0
        if len(images) < same + NOISE_PAIR_COUNT + 1:
            return None
        shares = [
            _changed_blocks(*images[index : index + 2]) for index in range(same, same + NOISE_PAIR_COUNT)
        ]
        return same if np.median(shares) > MIN_NOISY_SHARE else 0

    def _examine(self) -> None:
        """Show frames to `settling` until it has seen enough."""
        if self.frozen is None:
            return
        settling = self.settling
        for index in self.shown[self.frozen + len(settling) :]:
            if self.decided:
                return
            settling.add(self.held[index].image, self.held[index].t)
            # A state that outlasts a brief first one is watched until it ends.
            steady = settling.steady and len(settling) >= self._count and not self.outlived
            self.decided = settling.touched or settling.unrelated or steady or not self._settle


class References:
    """Chooses the reference frames, and reports if they are not the first ones. Finds damaged frames.

    Parameters
    ----------
    name : of the source, for messages.
    count : number of reference frames.
    settle : longest time until the light is steady, s; 0 takes the first frames that show gel.
    skip_damaged : whether to look for damage.

    Attributes
    ----------
    left_out : number of frames of a live source that were examined but not delivered.
    repeated : number of frames if all of them so far are the same picture, else 0.
    """

    def __init__(self, name: str, count: int, settle: float, *, skip_damaged: bool = True) -> None:
        self._name = name
        self._count = count
        self._settle = settle
        self._skip_damaged = skip_damaged
        self._requested = threading.Event()
        self._left = 0
        self._epoch = 0
        self._test: DamageTest | None = None
        self._test_epoch = -1
        self._blank = False
        self._first: ColorImage | None = None
        self.left_out = 0
        self.repeated = 0

    def retake(self) -> None:
        """Make the next `count` frames the reference of a new epoch. Thread-safe."""
        self._requested.set()

    def arranged(
        self, arrivals: Iterator[Arrival], source: FrameReader, image: ColorImage | None
    ) -> Iterator[Arrival]:
        """Mark the references among the frames of a source, and the damaged ones; for each episode anew.

        The first frames are held back until the reference is chosen. If it is not the first frame, it is also
        delivered before all others, with number -1; for a live source, the others are omitted.

        image : (H, W, 3) uint8 BGR, a reference that replaces the first frames; or None.
        """
        for _, episode in groupby(arrivals, key=lambda arrival: arrival.epoch):
            self._left, self._blank = 0, False
            self._test, self._test_epoch = None, -1
            yield from self._arranged(episode, source, image)

    def _arranged(
        self, arrivals: Iterator[Arrival], source: FrameReader, image: ColorImage | None
    ) -> Iterator[Arrival]:
        """`arranged` for the frames of one episode: of one epoch of the source."""
        if image is not None:
            if not shows_gel(image):
                raise SourceError("stages.capture.reference is black or uniform; name one that shows the gel")
            first = next(arrivals, None)
            if first is None:
                return
            yield self._shown_before(image, first)
            yield self.marked(first)
        else:
            yield from self._settled(arrivals, source)
        yield from map(self.marked, arrivals)

    def _settled(self, arrivals: Iterator[Arrival], source: FrameReader) -> Iterator[Arrival]:
        """The first frames, once the reference is chosen; for a live source, only the references."""
        video = not isinstance(source, ImageFiles)
        first = _FirstFrames(self._count, self._settle, keep_blank=not source.live, video=video)
        goes_on, failure = True, None
        try:
            while goes_on and (arrival := next(arrivals, None)) is not None:
                goes_on = first.add(arrival)
                if not (goes_on or first.held):
                    # The source shows no gel for too long: its newest frame has to do.
                    self.left_out += first.blank - 1
                    first = _FirstFrames(self._count, 0, keep_blank=True, video=video)
                    first.add(arrival)
        except SourceError as error:
            # The frames before it are delivered first.
            failure = error
        if first.held and not (source.live and goes_on):
            yield from self._delivered(first, source)
        if failure is not None:
            raise failure

    def _delivered(self, first: _FirstFrames, source: FrameReader) -> Iterator[Arrival]:
        """The first frames, with the references among them."""
        first.end()
        self._blank = first.blank == len(first.held)
        best, chosen = self._choose(first)
        self._report(first, best, source)
        held = first.held
        if source.live:
            # The frames without gel were not even held.
            self.left_out += len(held) - len(chosen) + (0 if self._blank else first.blank)
            held = [held[index] for index in chosen]
        if source.live or chosen == list(range(len(chosen))):
            self._begin(self._count if self._settle == 0 else len(chosen))
            yield from map(self.marked, held)
            return
        yield from [self._shown_before(held[index].image, held[0]) for index in chosen]
        old = first.leftovers
        for index, arrival in enumerate(held):
            yield self.marked(arrival._replace(damaged=self._skip_damaged and index in old))

    def marked(self, arrival: Arrival) -> Arrival:
        """The next frame, marked if it is a reference or damaged."""
        image = arrival.image
        self._count_repeated(image)
        damaged = arrival.damaged or (
            self._test is not None and not arrival.reference and self._test.is_damaged(image)
        )
        if arrival.seq >= 0 and not damaged:
            if self._blank and shows_gel(image):
                self._blank = False
                self._requested.set()
            if self._requested.is_set():
                self._begin(self._count)
        reference = self._left > 0 and not damaged
        self._left -= reference
        arrival = arrival._replace(
            reference=reference or arrival.reference, epoch=arrival.epoch + self._epoch, damaged=damaged
        )
        if arrival.reference and arrival.epoch != self._test_epoch:
            self._learn(image, arrival.epoch)
        return arrival

    def _learn(self, image: ColorImage, epoch: int) -> None:
        """Look for damage by comparison with this reference."""
        self._test = DamageTest(image) if self._skip_damaged else None
        self._test_epoch = epoch

    def _count_repeated(self, image: ColorImage) -> None:
        if self._first is None:
            self._first, self.repeated = image, 1
        elif self.repeated and np.array_equal(image, self._first):
            self.repeated += 1
        else:
            self.repeated = 0

    def _begin(self, count: int) -> None:
        """Make the next frames references, in a new epoch if requested."""
        if self._requested.is_set():
            self._requested.clear()
            self._epoch += 1
        self._left = count

    def _choose(self, first: _FirstFrames) -> tuple[int, list[int]]:
        """The best reference, and `count` frames that show the untouched gel, or fewer: indices, in order."""
        best, alike = first.choose()
        begin = max(0, min(alike.index(best) - self._count // 2, len(alike) - self._count))
        return best, alike[begin : begin + self._count]

    def _report(self, first: _FirstFrames, best: int, source: FrameReader) -> None:
        """Log which frame is the reference and why, unless it is clearly the first one."""
        settling, number = first.settling, first.held[best].seq
        if self._blank:
            log.warning("%s: its pictures are black or uniform, so that no gel is seen in them", self._name)
            return
        if first.blank:
            shows = "shows" if first.blank == 1 else "show"
            log.info("%s: %d of its first pictures %s no gel", self._name, first.blank, shows)
        if settling.changing:
            log.warning(
                "%s: the light is not steady, it changed by %.0f %% within the last frames; the reference is "
                "frame %d. Fix exposure and white balance of the camera, or raise settle",
                *(self._name, 100 * settling.drift, number),
            )
            return
        if isinstance(source, ImageFiles) and settling.scattered and best == 0:
            log.info(
                "%s: separate pictures; %s, the first by name, is taken for the untouched gel. "
                "If another one shows that, name it: stages.capture.reference",
                *(self._name, source.first),
            )
            return
        if first.outlived:
            why = "; the pictures before are of an earlier time, what they show never came back"
        elif settling.undecided:
            begins = first.held[first.place(settling.begins)].seq
            why = (
                f", although the gel came to rest in another state at frame {begins}; if it was "
                "touched until then, name a picture of the untouched gel: stages.capture.reference"
            )
        elif first.leftovers:
            why = "; the same picture was repeated before, without the noise of the camera"
        elif settling.touched_before(best - first.place(0)):
            why = "; the gel was touched or moved before"
        elif best > first.place(0):
            why = "; the camera was setting exposure and white balance until then"
        elif best > 0:
            why = ""
        else:
            return
        log.info("%s: the reference is frame %d%s", self._name, number, why)

    def _shown_before(self, image: ColorImage, first: Arrival) -> Arrival:
        """A reference delivered before the first frame, whose size it must have."""
        (height, width), (high, wide) = image.shape[:2], first.image.shape[:2]
        if (height, width) != (high, wide):
            raise SourceError(
                f"stages.capture.reference is an image of {width} x {height} pixels, the frames of "
                f"{self._name} have {wide} x {high}; they must be equally large"
            )
        epoch = first.epoch + self._epoch
        if self._test_epoch < 0:
            self._learn(image, epoch)
        return Arrival(image, first.t, -1, reference=True, epoch=epoch, paced=False)


def _changed_blocks(before: ColorImage, after: ColorImage) -> float:
    """Share of blocks in which two pictures differ."""
    differs = (before != after).any(axis=2)
    high, wide = (max(1, side // BLOCK_SIDE_PX) for side in differs.shape)
    rows = np.logical_or.reduceat(differs, np.arange(high) * BLOCK_SIDE_PX, axis=0)
    return float(np.logical_or.reduceat(rows, np.arange(wide) * BLOCK_SIDE_PX, axis=1).mean())
