"""Which frames are worked on: those that have changed, and some after each change."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.change.probe import ChangeProbe

_COMPARED = 3
"""Last frames of a hold that are compared; those before are worked on in any case. Chosen by hand."""
_FAINT = 2.0
"""Strongest test value over its bound, 1, up to which a change is faint. Chosen by hand."""
_SHORT_REST = 2
"""Length of a rest over that of the hold before it, 1, below which the rest is short. Chosen by hand."""


class ChangeHold:
    """Decides for each frame whether it is worked on, from what a `ChangeProbe` sees.

    There are two states. The scene *rests*, and frames are left out; or something has changed lately, and a
    number of frames is *held*: they are worked on without a further change.

    - A change begins a hold, in either state. The changed frame becomes the probe's anchor.
    - Of the frames that are held, only the last `_COMPARED` are compared with the anchor, so that what moves
      too slowly for one frame adds up. After the last one the scene rests, if that frame is calm; if not, it
      is in doubt and taken for a change.
    - At rest, a frame is worked on if it is a reference frame, or if `at_least_every` frames have passed
      since the last one that was. It becomes the anchor, and the rest goes on.

    A hold takes `frames` frames. A faint change after a short rest is a slow motion: its hold is twice as
    long as the one before, up to `at_least_every` frames, to see more of it. If there was no rest at all, it
    is as long as the one before.

    frames : length of a hold, >= 0. at_least_every : frames, >= 1.

    >>> still = np.full((40, 60, 3), 100, np.uint8)
    >>> probe, hold = ChangeProbe(still), ChangeHold(frames=2, at_least_every=5)
    >>> "".join("-+"[hold.works_on(still, probe)] for _ in range(20))
    '++++++++----+----+--'
    """

    def __init__(self, frames: int, at_least_every: int) -> None:
        self._frames = frames
        self._at_least_every = at_least_every
        self._left = 0
        """Frames of this hold that are still to come; 0 at rest."""
        self._length = frames
        """Length of this hold, or of the last one, frames."""
        self._rested = 0
        """Frames left out since the last hold."""
        self._since_work = 0
        """Compared frames since the last one that was worked on."""

    def works_on(self, frame: NDArray[np.uint8], probe: ChangeProbe, *, reference: bool = False) -> bool:
        """Whether this frame is worked on.

        frame : the next one, as `ChangeProbe.look` takes it. reference : whether it is a reference frame.
        """
        if self._left > _COMPARED and probe.ready:
            self._left -= 1
            return True
        changed = probe.look(frame)
        self._since_work += 1
        in_doubt = self._left == 1 and not probe.calm
        if changed or in_doubt:
            self._begin(faint=probe.strongest <= _FAINT * probe.bound)
        elif self._left > 1:
            self._left -= 1
            self._since_work = 0
            return True
        elif self._left == 1:
            self._left = 0
        elif not reference and self._since_work < self._at_least_every:
            self._rested += 1
            return False
        self._since_work = 0
        probe.anchor_here()
        return True

    def _begin(self, *, faint: bool) -> None:
        """Begin a hold."""
        if not faint or self._rested >= _SHORT_REST * self._length:
            self._length = self._frames
        elif self._rested > 0:
            self._length = min(2 * self._length, max(self._frames, self._at_least_every))
        self._left = self._length
        self._rested = 0
