"""What is lines while a ball is pressed."""

from __future__ import annotations

import numpy as np

from tactflow.calibration.presses import Press, PressFinder
from tactflow.cli.guide import Guide

GEL = np.zeros((90, 90, 3), np.uint8)
MASK = np.zeros((90, 90), np.uint8)


def press(x: float, y: float, radius: float = 10.0) -> Press:
    return Press(0, GEL, MASK, MASK > 0, (x, y), radius)


def finder(presses: list[Press], *, lasts: bool = False) -> PressFinder:
    """A session with these presses."""
    session = PressFinder()
    session.presses, session.lasts = presses, lasts
    return session


def test_each_press_is_judged_and_the_next_place_is_named() -> None:
    lines: list[str] = []
    guide = Guide(9, lines.append)
    guide(finder([]))
    guide(finder([press(45, 45), press(20, 20), press(20, 70, radius=4), press(5, 45)]))
    assert lines[0] == "press 1 of 9: good, radius 10 px. Press the ball firmly at the upper left."
    assert lines[2].startswith(
        "press 3 of 9: light, radius 4 px where 10 px is usual; press harder. Press the ball"
    )
    assert lines[3].startswith("press 4 of 9: cut off by the border of the picture at (5, 45)")


def test_the_last_press_is_undone_and_the_session_ends_with_enough() -> None:
    lines: list[str] = []
    guide = Guide(3, lines.append)
    assert not guide(finder([]))
    assert not guide(finder([press(45, 45)], lasts=True))
    assert not lines
    assert not guide(finder([press(45, 45)]))
    assert lines[-1].startswith("press 1 of 3: good")
    guide.undo()
    session = finder([press(45, 45), press(20, 20)], lasts=True)
    assert not guide(session)
    assert [found.center for found in session.presses] == [(20, 20)], "the one that lasts stays"
    assert lines[-1] == "press 1 is undone; press again"
    assert guide(finder([*session.presses, press(70, 20), press(70, 70)]))
