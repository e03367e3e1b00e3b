"""The messages of `tactflow calibrate` while a ball is pressed, and the keys that it understands."""

from __future__ import annotations

import queue
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from tactflow.calibration.presses import PressFinder
from tactflow.calibration.progress import progress


class Guide:
    """Tells whether each press was good, and where to press next.

    wanted : number of presses that are enough. say : shows a line. typed : the lines typed since the last
        call: `u` undoes the last press, `q` ends the session.

    `state` (see `progress`) may be read, and `undo` called, from any thread: that is what the live page does.
    """

    def __init__(
        self, wanted: int, say: Callable[[str], None], typed: Callable[[], Sequence[str]] = tuple
    ) -> None:
        self._wanted = wanted
        self._say = say
        self._typed = typed
        self._reported: int | None = None
        self._undo: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._shown = (0, False)
        self.state: Mapping[str, Any] = progress([], False, wanted)

    def undo(self) -> None:
        """Undo the last press, as `u` does."""
        self._undo.put("u")

    def __call__(self, finder: PressFinder) -> bool:
        """Look at the presses so far; whether they are enough."""
        presses = finder.presses
        over = len(presses) - finder.lasts
        if self._reported is None:
            self._reported = over
            if over:
                self._say(f"saved presses so far: {over}")
        for number in range(self._reported, over):
            self._report(finder, number)
        self._reported = over
        words = [*self._typed(), *(self._undo.get() for _ in range(self._undo.qsize()))]
        for _ in range(min(words.count("u"), self._reported)):
            self._reported -= 1
            del presses[self._reported]
            self._say(f"press {self._reported + 1} is undone; press again")
        if self._shown != (len(presses), finder.lasts):
            self._shown = (len(presses), finder.lasts)
            self.state = progress(presses, finder.lasts, self._wanted)
        return "q" in words or self._reported >= self._wanted

    def _report(self, finder: PressFinder, number: int) -> None:
        """Say whether a press was good, and what to do next."""
        state = progress(finder.presses[: number + 1], False, self._wanted)
        press = state["presses"][number]
        verdict = (
            f"{press['fault']} (u: undo)" if press["fault"] else f"good, radius {press['radius']:.0f} px"
        )
        # A recording may show more than are wanted.
        of = f" of {self._wanted}" if number < self._wanted else ""
        self._say(f"press {number + 1}{of}: {verdict}. {state['now']}")


def typed_lines() -> Callable[[], Sequence[str]]:
    """Lines typed at the terminal, without waiting for them; always empty without a terminal."""
    if not sys.stdin.isatty():
        return tuple
    lines: queue.SimpleQueue[str] = queue.SimpleQueue()

    def listen() -> None:
        for line in sys.stdin:
            lines.put(line.strip().lower())

    threading.Thread(target=listen, name="tactflow-typed", daemon=True).start()
    return lambda: [lines.get() for _ in range(lines.qsize())]
