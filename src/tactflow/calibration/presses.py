"""Presses of a ball in a recording: found by the pipeline's own contact detector."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from tactflow.calibration.collecting import collect
from tactflow.engine.contract import Sink, StageParams
from tactflow.engine.control import Control
from tactflow.engine.errors import ConfigError
from tactflow.engine.frame import Tick
from tactflow.engine.graph import Node, Pipeline
from tactflow.ports import ContactMask, MarkerMask, Unmarked
from tactflow.vision.geometry import PixelMapping
from tactflow.vision.types import Contact, Markers

logger = logging.getLogger("tactflow")

SAME: Final = 0.03
"""RMS difference of the untouched gel, relative to its brightness, up to which presses belong to one session.
Chosen by hand, between what presses of one session differ by (0.01) and what a calibration bears (0.1)."""
MOVED_ON: Final = 0.5
"""How far a contact lies from the one before, in its own radii, to be another press. Chosen by hand."""


@dataclass(frozen=True, eq=False, slots=True)
class Press:
    """One press of the ball, at the moment when its contact was largest.

    seq : of the frame. image : (H, W, 3) uint8, without markers. mask : (H, W) uint8, 255 in contact.
    hidden : (H, W) bool, where a marker was. center : (x, y) of the contact, px. radius : of a disc of its
    area, px.
    """

    seq: int
    image: NDArray[np.uint8]
    mask: NDArray[np.uint8]
    hidden: NDArray[np.bool_]
    center: tuple[float, float]
    radius: float


@dataclass(frozen=True, eq=False, slots=True)
class Session:
    """What a recording shows that a calibration needs.

    untouched : (H, W, 3) uint8, mean of the reference frames without markers; of those that were taken last,
        where a new reference was taken meanwhile. mapping : of the pixels.
    presses : in order. dots : (N, 2) float64, markers of the untouched gel, px; empty without markers.
    frames : how many there were.
    """

    untouched: NDArray[np.uint8]
    mapping: PixelMapping
    presses: list[Press]
    dots: NDArray[np.float64]
    frames: int


Report = Callable[[int, list["Press"], bool], bool]
"""Called with each frame: how many there were, the presses so far, and whether the last one still lasts.
Returns whether that is enough for a live source, which then ends when its reference is complete; of a
recording all is read. A press that is over may be taken out of the list: it was undone."""


class Keeper(Protocol):
    """Where presses of a live source are kept, see `tactflow.calibration.keeping`."""

    @property
    def presses(self) -> list[Press]:
        """Those of before."""

    def check(self, untouched: NDArray[np.uint8], mapping: PixelMapping) -> None:
        """Raise ConfigError if the session cannot go on with these frames."""

    def sync(self, presses: Sequence[Press]) -> None:
        """Save those that are new, forget those that are no more."""

    def clear(self) -> None:
        """Forget all of them, and the untouched gel that they are compared with."""


def find_presses(
    pipeline: Pipeline,
    report: Report = lambda _frames, _presses, _lasts: False,
    keeper: Keeper | None = None,
    watchers: Mapping[str, Node] | None = None,
) -> Session:
    """Run a pipeline on its source and collect the presses in it.

    A press lasts as long as something touches at about one place; of each, the frame with the largest
    contact is kept. Pictures of separate presses one after the other will do. A signal such as Ctrl-C ends
    it; what was found until then counts.

    Parameters
    ----------
    pipeline : with stages that give `unmarked` and `contact`. report : see `Report`. keeper : has the presses
        of before, and keeps the new ones, of a live source. watchers : sinks that look on, by their ids.

    Raises
    ------
    ConfigError : the pipeline lacks one of the stages, or its source has no frames.
    TactflowError : a stage or the source failed.
    """
    needed = {"unmarked": "preprocess", "contact": "hull"}
    values = {"report": report, "keeper": lambda: keeper}
    return _session(collect(pipeline, _Collect, values, needed, watchers=watchers))


class _Collect(Sink):
    """Keeps the largest contact of each press."""

    # A better reference than the first frame comes before it, as a reference image does: see capture.
    takes_references = True
    report: Report
    keeper: Callable[[], Keeper | None]

    def __init__(self, params: StageParams, control: Control) -> None:
        super().__init__(params)
        self._control = control
        self.rest: list[NDArray[np.uint8]] = []
        self.presses: list[Press] = []
        self.mapping: PixelMapping | None = None
        self.dots = np.zeros((0, 2))
        self.frames = 0
        self._epoch = 0
        self._before: NDArray[np.uint8] | None = None
        self._open = False
        self._keeper: Keeper | None = None
        self._checked = False
        self._enough = False

    def open(self) -> None:
        """Go on with the presses of before."""
        if self._control.source is not None and self._control.source.live:
            self._keeper = self.keeper()
            self.presses = [] if self._keeper is None else self._keeper.presses

    def write(
        self,
        tick: Tick,
        unmarked: Unmarked,
        contact: Contact | None,
        contact_mask: ContactMask | None,
        marker_mask: MarkerMask | None,
        markers: Markers | None,
        mapping: PixelMapping | None,
    ) -> None:
        """Look at one frame."""
        self.frames += tick.frame.seq >= 0
        if not self.rest or tick.frame.reference:
            self._compare_with(unmarked, tick.frame.epoch)
            self.mapping = mapping
        elif self._before is not None:
            self._keep_what_belongs(self._before)
            self._before = None
        if markers is not None:
            self.dots = markers.origin
        if contact is None or contact_mask is None or tick.frame.reference:
            self._open = False
        else:
            radius = float(np.sqrt(np.count_nonzero(contact_mask) / np.pi))
            hidden = np.zeros(unmarked.shape[:2], np.bool_) if marker_mask is None else marker_mask > 0
            if self._keeper is not None and not self._checked:
                self._checked = True
                self._keeper.check(self.untouched(), mapping or PixelMapping.identity(self.size()))
            self._add(Press(tick.frame.seq, unmarked, contact_mask, hidden, contact.center, radius))
        self._enough = self.report(self.frames, self.presses, self._open) or self._enough
        if self._keeper is not None:
            self._keeper.sync(self.presses[: len(self.presses) - self._open])
        live = self._control.source is not None and self._control.source.live
        # All frames of the reference count, whenever it is said that there is enough.
        if self._enough and live and not tick.frame.reference:
            self._control.stop()

    def _compare_with(self, unmarked: NDArray[np.uint8], epoch: int) -> None:
        """Another frame of the reference, or the first of a new one, which replaces the one before."""
        if self.rest and epoch != self._epoch:
            self._before, self.rest = self.untouched(), []
        self._epoch = epoch
        self.rest.append(unmarked.copy())

    def _keep_what_belongs(self, before: NDArray[np.uint8]) -> None:
        """Leave out the presses so far, if the gel looked different `before` the new reference."""
        differs = difference(self.untouched(), before)
        if differs <= SAME:
            return
        logger.warning(
            "calibrate: the new reference differs by %.0f %% of its brightness from the one before (%.0f %% "
            "at most); the presses before it, %d, are left out: press there again",
            100 * differs,
            100 * SAME,
            len(self.presses),
        )
        self.presses.clear()
        self._checked = False
        if self._keeper is not None:
            self._keeper.clear()

    def untouched(self) -> NDArray[np.uint8]:
        """(H, W, 3): mean of the reference frames."""
        return np.asarray(np.rint(np.mean(self.rest, axis=0)), np.uint8)

    def size(self) -> tuple[int, int]:
        """Width and height of the frames, px."""
        return self.rest[0].shape[1], self.rest[0].shape[0]

    def _add(self, press: Press) -> None:
        """A press of its own, or another moment of the last one."""
        if self._open:
            last = self.presses[-1]
            away = np.hypot(press.center[0] - last.center[0], press.center[1] - last.center[1])
            if away < MOVED_ON * last.radius:
                if press.radius > last.radius:
                    self.presses[-1] = press
                return
        self._open = True
        self.presses.append(press)


def difference(untouched: NDArray[np.uint8], before: NDArray[np.uint8]) -> float:
    """RMS difference of two pictures (H, W, 3) uint8 of a gel, relative to the brightness of the second.

    >>> difference(np.full((2, 2, 3), 120, np.uint8), np.full((2, 2, 3), 100, np.uint8))
    0.2
    """
    return float(np.sqrt(np.mean((untouched.astype(float) - before) ** 2)) / max(before.mean(), 1))


def _session(collected: _Collect) -> Session:
    if not collected.rest:
        raise ConfigError("calibrate: the source has no frames")
    return Session(
        collected.untouched(),
        collected.mapping or PixelMapping.identity(collected.size()),
        collected.presses,
        collected.dots,
        collected.frames,
    )
