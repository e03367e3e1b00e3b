"""The messages of `tactflow calibrate` while a ball is pressed."""

from __future__ import annotations

import queue
from collections.abc import Callable, Mapping
from typing import Any

from tactflow.calibration.presses import PressFinder
from tactflow.calibration.progress import progress


class Guide:
    """Reports whether each press was good, and where to press next.

    wanted : number of presses that are enough. say : shows a line.

    `state` (see `progress`) may be read, and `undo` called, from any thread: that is what the live page does.
    """

    def __init__(self, wanted: int, say: Callable[[str], None]) -> None:
        self._wanted = wanted
        self._say = say
        self._reported: int | None = None
        self._undos: queue.SimpleQueue[None] = queue.SimpleQueue()
        self._shown = (0, False)
        self.state: Mapping[str, Any] = progress([], False, wanted)

    def undo(self) -> None:
        """Undo the last press."""
        self._undos.put(None)

    def __call__(self, finder: PressFinder) -> bool:
        """Report new presses; returns whether there are enough."""
        presses = finder.presses
        over = len(presses) - finder.lasts
        if self._reported is None:
            self._reported = over
            if over:
                self._say(f"saved presses so far: {over}")
        for number in range(self._reported, over):
            self._report(finder, number)
        self._reported = over
        for _ in range(self._undos.qsize()):
            self._undos.get()
            if self._reported:
                self._reported -= 1
                del presses[self._reported]
                self._say(f"press {self._reported + 1} is undone; press again")
        if self._shown != (len(presses), finder.lasts):
            self._shown = (len(presses), finder.lasts)
            self.state = progress(presses, finder.lasts, self._wanted)
        return self._reported >= self._wanted

    def _report(self, finder: PressFinder, number: int) -> None:
        """Report whether a press was good, and what to do next."""
        state = progress(finder.presses[: number + 1], False, self._wanted)
        press = state["presses"][number]
        verdict = press["fault"] or f"good, radius {press['radius']:.0f} px"
        # A recording may show more than are wanted.
        of = f" of {self._wanted}" if number < self._wanted else ""
        self._say(f"press {number + 1}{of}: {verdict}. {state['now']}")
