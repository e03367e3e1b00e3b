"""The messages of `tactflow calibrate` while a ball is pressed, and the keys that it understands."""

from __future__ import annotations

import queue
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from itertools import product
from typing import Any

from tactflow.calibration.presses import Press, PressFinder, usual_radius
from tactflow.calibration.progress import PARTS, fault, part, part_name, progress

NAMED = 3
"""Parts of the gel without a press that are named; more are counted. Chosen by hand."""


class Guide:
    """Tells whether each press was good, and where one is missing.

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
        self._told: int | None = None
        self._seen = (0, False)
        self._asked: queue.SimpleQueue[str] = queue.SimpleQueue()
        self.state: Mapping[str, Any] = progress([], False, wanted)

    def undo(self) -> None:
        """Undo the last press, as `u` does."""
        self._asked.put("u")

    def __call__(self, finder: PressFinder) -> bool:
        """Look at the presses so far; whether they are enough."""
        presses, lasts = finder.presses, finder.lasts
        over = len(presses) - lasts
        if self._told is None:
            self._told = over
            if over:
                self._say(f"going on with {over} presses of before; {_missing(presses[:over])}")
        for number in range(self._told, over):
            # A recording may show more than are wanted.
            of = f" of {self._wanted}" if number < self._wanted else ""
            self._say(f"press {number + 1}{of}: {judged(presses[:over], number)}")
        self._told = over
        ended = False
        for word in (*self._typed(), *(self._asked.get() for _ in range(self._asked.qsize()))):
            ended = ended or word == "q"
            if word == "u" and self._told:
                self._told -= 1
                del presses[self._told]
                self._say(f"press {self._told + 1} is undone; press again")
        if self._seen != (len(presses), lasts):
            self._seen = (len(presses), lasts)
            self.state = progress(presses, lasts, self._wanted)
        return ended or self._told >= self._wanted


def judged(presses: Sequence[Press], number: int) -> str:
    """Whether a press was good, and what to do next.

    >>> import numpy as np
    >>> gel, mask = np.zeros((60, 60, 3), np.uint8), np.zeros((60, 60), np.uint8)
    >>> judged([Press(0, gel, mask, mask > 0, (30, 30), 9.0)], 0)
    'good, radius 9 px; 8 of 9 parts of the gel have none yet'
    """
    press = presses[number]
    usual = usual_radius(presses)
    wrong = fault(press, usual)
    if wrong is not None:
        return f"{wrong} (u: undo)"
    return f"good, radius {press.radius:.0f} px; {_missing(presses)}"


def _missing(presses: Sequence[Press]) -> str:
    """Which parts of the gel have no press yet."""
    there = {part(press) for press in presses}
    everywhere = product(range(PARTS), repeat=2)
    empty = [part_name(row, column) for row, column in everywhere if (row, column) not in there]
    if not empty:
        return "all parts of the gel have one"
    if len(empty) > NAMED:
        return f"{len(empty)} of {PARTS**2} parts of the gel have none yet"
    return f"nothing yet at the {', '.join(empty)}"


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
