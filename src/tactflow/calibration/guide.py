"""What to do next while presses of a ball are collected, for the terminal and the live page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.calibration.presses import Press, Wish

LIGHT: Final = 0.3
"""Radius of a contact over the median of all, below which a press is called light. Chosen by hand."""
ROUND: Final = 1.7
"""Longer over shorter axis of a contact, from which on it is not called a ball's. Chosen by hand: presses of
a ball on a real gel (mini_ball) reach 1.57."""
PARTS: Final = (
    ("upper left", "top", "upper right"),
    ("left", "middle", "right"),
    ("lower left", "bottom", "lower right"),
)
"""Names of the parts of the gel that all want presses, row by row."""
_FIRST: Final = ((1, 1), (0, 0), (2, 2), (0, 2), (2, 0), (0, 1), (2, 1), (1, 0), (1, 2))
"""The parts, as (row, column), in the order in which they are asked for."""


def fault(press: Press, usual: float) -> str | None:
    """What is wrong with a press, and what to do; None if it is good.

    usual : radius of the other contacts, px.

    >>> mask = np.zeros((60, 60), np.uint8)
    >>> mask[:, 20:30] = 255
    >>> fault(Press(1, np.zeros((60, 60, 3), np.uint8), mask, mask > 0, (25.0, 30.0), 14.0), 14.0)
    'cut by the border of the picture: press further inside'
    """
    touched = press.mask > 0
    if touched[[0, -1]].any() or touched[:, [0, -1]].any():
        return "cut by the border of the picture: press further inside"
    if press.radius < LIGHT * usual:
        return "light: press harder"
    if _elongation(touched.view(np.uint8)) > ROUND:
        return "not round: press the ball straight, and nothing else"
    return None


class Guide:
    """Follows the presses of a session, as `find_presses` reports them, and says what is wanted next.

    enough : so many good presses will do. `state` may be read, and `undo` called, from any thread.

    >>> guide = Guide(20)
    >>> guide(1, [], False), guide.state["now"]
    (None, 'Press the ball firmly into the middle of the gel.')
    """

    def __init__(self, enough: int) -> None:
        self._enough = enough
        self._undo = False
        self.state: Mapping[str, Any] = self._described([], False)
        """now : what to do, in words. good, enough : presses. parts : 3 rows of how many good ones each part
        of the gel has, and next : (row, column) of that which wants the next. presses : center and radius of
        each, px, and fault: null if it is good. lasts : whether the last one still does. Replaced as a whole.
        """

    def __call__(self, _frames: int, presses: Sequence[Press], lasts: bool) -> Wish:
        """The `Report` of `find_presses`."""
        if self._undo:
            self._undo = False
            return "undo"
        known = self.state["presses"]
        if lasts or lasts != self.state["lasts"] or len(presses) != len(known):
            self.state = self._described(presses, lasts)
        return "enough" if self.state["good"] >= self._enough and not lasts else None

    def undo(self) -> None:
        """Forget the last press."""
        self._undo = True

    def _described(self, presses: Sequence[Press], lasts: bool) -> dict[str, Any]:
        usual = float(np.median([press.radius for press in presses])) if presses else 0.0
        faults = [fault(press, usual) for press in presses]
        parts = np.zeros((3, 3), int)
        over = len(presses) - lasts
        for press, wrong in zip(presses[:over], faults[:over], strict=True):
            if wrong is None:
                parts[_part(press)] += 1
        row, column = min(_FIRST, key=lambda part: int(parts[part]))
        now = f"Press the ball {_firmly(int(parts[row, column]))} into the {PARTS[row][column]} of the gel."
        if lasts:
            now = "Lift the ball."
        elif parts.sum() >= self._enough:
            now = "These are enough presses."
        return {
            "now": now,
            "good": int(parts.sum()),
            "enough": self._enough,
            "parts": parts.tolist(),
            "next": [row, column],
            "lasts": lasts,
            "presses": [
                {"center": list(press.center), "radius": press.radius, "fault": wrong}
                for press, wrong in zip(presses, faults, strict=True)
            ],
        }


def _firmly(before: int) -> str:
    """How deep to press where there are already so many presses: a calibration wants several depths."""
    return ("firmly", "lightly", "half as deep")[before % 3]


def _part(press: Press) -> tuple[int, int]:
    """(row, column) of the part of the gel that a press lies in."""
    height, width = press.mask.shape
    x, y = press.center
    return min(2, max(0, int(3 * y / height))), min(2, max(0, int(3 * x / width)))


def _elongation(mask: NDArray[np.uint8]) -> float:
    """Longer over shorter axis of a region (H, W) uint8, not 0 inside."""
    moments = cv2.moments(mask, binaryImage=True)
    across, both, down = moments["mu20"], moments["mu11"], moments["mu02"]
    apart = float(np.hypot(across - down, 2 * both))
    return float(np.sqrt((across + down + apart) / max(across + down - apart, 1e-9)))
