"""What `tactflow calibrate` says while a ball is pressed, and what can be typed meanwhile."""

from __future__ import annotations

import queue
import sys
import threading
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np

from tactflow.calibration.presses import Press

LIGHT: Final = 0.5
"""Radius of a contact over the usual one, below which a press is called light. Chosen by hand."""
PARTS: Final = 3
"""Columns and rows of parts of the gel that should each have a press. Chosen by hand."""
_ROWS: Final = ("upper", "middle", "lower")
_COLUMNS: Final = ("left", "centre", "right")


class Guide:
    """A `Report` that tells whether each press was good, and where one is missing.

    wanted : so many presses are enough. say : shows a line. typed : what was typed since the last call: `u`
        undoes the last press, `q` ends the session.
    """

    def __init__(
        self, wanted: int, say: Callable[[str], None], typed: Callable[[], Sequence[str]] = tuple
    ) -> None:
        self._wanted = wanted
        self._say = say
        self._typed = typed
        self._told: int | None = None

    def __call__(self, _frames: int, presses: list[Press], lasts: bool) -> bool:
        """Look at the presses so far; whether they are enough."""
        over = len(presses) - lasts
        if self._told is None:
            self._told = over
            if over:
                self._say(f"going on with {over} presses of before; {_missing(presses[:over])}")
        for number in range(self._told, over):
            self._say(f"press {number + 1} of {self._wanted}: {judged(presses[:over], number)}")
        self._told = over
        ended = False
        for word in self._typed():
            ended = ended or word == "q"
            if word == "u" and self._told:
                self._told -= 1
                del presses[self._told]
                self._say(f"press {self._told + 1} is undone; press again")
        return ended or self._told >= self._wanted


def judged(presses: Sequence[Press], number: int) -> str:
    """Whether a press was good, and what to do next.

    >>> gel, mask = np.zeros((60, 60, 3), np.uint8), np.zeros((60, 60), np.uint8)
    >>> judged([Press(0, gel, mask, mask > 0, (30, 30), 9.0)], 0)
    'good, radius 9 px; nothing yet at the upper left, upper centre, upper right, middle left, ...'
    """
    press = presses[number]
    usual = float(np.median([other.radius for other in presses]))
    height, width = press.mask.shape
    x, y = press.center
    if press.radius < LIGHT * usual:
        return f"light, radius {press.radius:.0f} px where {usual:.0f} px is usual; press harder (u: undo)"
    if min(x, y, width - 1 - x, height - 1 - y) < press.radius:
        return f"cut off by the border of the picture at ({x:.0f}, {y:.0f}); press further inside (u: undo)"
    return f"good, radius {press.radius:.0f} px; {_missing(presses)}"


def _missing(presses: Sequence[Press]) -> str:
    """Which parts of the gel have no press yet."""
    height, width = presses[0].mask.shape
    there = {(int(PARTS * p.center[1] / height), int(PARTS * p.center[0] / width)) for p in presses}
    empty = [f"{_ROWS[r]} {_COLUMNS[c]}" for r in range(PARTS) for c in range(PARTS) if (r, c) not in there]
    if not empty:
        return "all parts of the gel have one"
    return f"nothing yet at the {', '.join(empty[:4])}{', ...' if len(empty) > 4 else ''}"


def typed_lines() -> Callable[[], Sequence[str]]:
    """What is typed at the terminal, line by line, without waiting; nothing where there is no terminal."""
    if not sys.stdin.isatty():
        return tuple
    lines: queue.SimpleQueue[str] = queue.SimpleQueue()

    def listen() -> None:
        for line in sys.stdin:
            lines.put(line.strip().lower())

    threading.Thread(target=listen, name="tactflow-typed", daemon=True).start()
    return lambda: [lines.get() for _ in range(lines.qsize())]
