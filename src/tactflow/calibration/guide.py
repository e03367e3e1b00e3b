"""Guides a person through a session: which presses are good, and where to press next."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from tactflow.calibration.presses import Press, PressFinder, usual_radius
from tactflow.vision.geometry.region import measure_region

LIGHT_RADIUS_RATIO: Final = 0.5
"""Radius of a contact over the usual one, below which a press is called light. Chosen by hand."""
MAX_AXIS_RATIO: Final = 1.7
"""Longer over shorter axis of a contact above which it is not a ball's. Chosen by hand: presses of a ball on
a real gel (mini_ball) reach 1.57."""
PARTS_PER_SIDE: Final = 3
"""Columns and rows of parts into which the gel is divided; each part needs presses. Chosen by hand."""
_ROWS: Final = ("upper", "middle", "lower")
_COLUMNS: Final = ("left", "centre", "right")
_FIRST: Final = ((1, 1), (0, 0), (2, 2), (0, 2), (2, 0), (0, 1), (2, 1), (1, 0), (1, 2))
"""The parts in the order in which they are asked for."""
_DEPTHS: Final = ("firmly", "lightly", "half as deep")
"""How to press after zero, one, two presses in a part: a calibration needs several depths."""


def fault(press: Press, usual: float) -> str | None:
    """What is wrong with a press, and what to do; None if it is good. usual : radius of contacts, px.

    >>> import numpy as np
    >>> mask = np.zeros((60, 60), np.uint8)
    >>> fault(Press(1, np.zeros((60, 60, 3), np.uint8), mask, mask > 0, (5.0, 30.0), 9.0), 9.0)
    'cut off by the border of the picture at (5, 30); press further inside'
    """
    height, width = press.mask.shape
    x, y = press.center
    if press.radius < LIGHT_RADIUS_RATIO * usual:
        return f"light, radius {press.radius:.0f} px where {usual:.0f} px is usual; press harder"
    if min(x, y, width - 1 - x, height - 1 - y) < press.radius:
        return f"cut off by the border of the picture at ({x:.0f}, {y:.0f}); press further inside"
    region = measure_region(press.mask)
    if region.pixels:
        major, minor = region.moments().principal
        if major > MAX_AXIS_RATIO**2 * minor:
            return "not round; press the ball straight, and nothing else"
    return None


def progress(presses: Sequence[Press], lasts: bool, wanted: int) -> Mapping[str, Any]:
    """The state of a session, for the live page.

    lasts : whether the last press is not over. wanted : number of presses to reach.

    Returns now : what to do, in words. done, good, wanted : numbers of presses. next : (row, column) of the
    part of the gel with the fewest good ones. lasts. presses : center and radius of each, px, and its fault.

    >>> progress([], False, 20)["now"]
    'Press the ball firmly in the centre.'
    """
    usual = usual_radius(presses)
    faults = [fault(press, usual) for press in presses]
    done = len(presses) - lasts
    good = [press for press, wrong in zip(presses[:done], faults[:done], strict=True) if wrong is None]
    parts = [
        tuple(
            int(PARTS_PER_SIDE * x / side)
            for x, side in zip(press.center[::-1], press.mask.shape, strict=True)
        )
        for press in good
    ]
    row, column = min(_FIRST, key=parts.count)
    where = "in the centre" if (row, column) == (1, 1) else f"at the {_ROWS[row]} {_COLUMNS[column]}"
    now = f"Press the ball {_DEPTHS[parts.count((row, column)) % 3]} {where}."
    if lasts:
        now = "Lift the ball."
    elif done >= wanted:
        now = "These are enough presses."
    return {
        "now": now,
        "done": done,
        "good": len(good),
        "wanted": wanted,
        "next": (row, column),
        "lasts": lasts,
        "presses": [
            {"center": press.center, "radius": press.radius, "fault": wrong}
            for press, wrong in zip(presses, faults, strict=True)
        ],
    }


class Guide:
    """Reports whether each press was good, and where to press next.

    `state` (see `progress`) may be read from any thread, as the live page does.

    Parameters
    ----------
    wanted : number of presses that are enough.
    say : shows a line.
    """

    def __init__(self, wanted: int, say: Callable[[str], None]) -> None:
        self._wanted = wanted
        self._say = say
        self._reported = 0
        self._shown = (0, False)
        self.state: Mapping[str, Any] = progress([], False, wanted)

    def __call__(self, finder: PressFinder) -> bool:
        """Report new presses; returns whether there are enough."""
        presses, shown = finder.presses, (len(finder.presses), finder.lasts)
        # A new reference may have dropped some.
        self._reported = min(self._reported, len(presses))
        for number in range(self._reported, len(presses) - finder.lasts):
            self._report(presses[: number + 1])
            self._reported += 1
        if self._shown != shown:
            self._shown = shown
            self.state = progress(presses, finder.lasts, self._wanted)
        return self._reported >= self._wanted

    def _report(self, presses: Sequence[Press]) -> None:
        """Report whether the last press was good, and what to do next."""
        state, number = progress(presses, False, self._wanted), len(presses)
        press = state["presses"][-1]
        verdict = press["fault"] or f"good, radius {press['radius']:.0f} px"
        # A recording may show more than are wanted.
        of = f" of {self._wanted}" if number <= self._wanted else ""
        self._say(f"press {number}{of}: {verdict}. {state['now']}")
