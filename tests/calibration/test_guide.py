"""What a person reads while a ball is pressed."""

from __future__ import annotations

import cv2
import numpy as np

from tactflow.calibration.guide import Guide, fault, progress
from tactflow.calibration.presses import Press, PressFinder

GEL = np.zeros((90, 90, 3), np.uint8)


def press(x: int, y: int, axes: tuple[int, int] = (10, 10)) -> Press:
    mask = np.zeros((90, 90), np.uint8)
    cv2.ellipse(mask, (x, y), axes, 0, 0, 360, 255, cv2.FILLED)
    return Press(0, GEL, mask, mask > 0, (x, y), float(np.sqrt(axes[0] * axes[1])))


def test_what_is_not_a_press_of_the_ball_is_called_so() -> None:
    assert fault(press(45, 45), 10) is None
    assert fault(press(45, 45, (13, 9)), 10) is None, "outlines of balls are this much off"
    found = [fault(one, 10) for one in (press(45, 45, (30, 4)), press(45, 45, (4, 4)), press(86, 45))]
    assert [words and words.split()[0] for words in found] == ["not", "light,", "cut"]


def test_the_part_with_the_fewest_good_presses_is_asked_for_next() -> None:
    presses = [press(15 + 30 * column, 15 + 30 * row) for row in range(3) for column in range(3)]
    said = progress(presses[:-1], False, 20)
    assert (said["next"], said["now"]) == ((2, 2), "Press the ball firmly at the lower right.")
    assert progress([*presses[:-1], press(86, 75)], False, 20)["next"] == (2, 2), "one at the rim is none"
    assert progress(presses, False, 20)["now"] == "Press the ball lightly in the centre."
    lasting = progress(presses, True, 9)
    assert (lasting["now"], lasting["done"], lasting["good"]) == ("Lift the ball.", 8, 8)
    assert progress(presses, False, 9)["now"] == "These are enough presses."


def finder(presses: list[Press], *, lasts: bool = False) -> PressFinder:
    """A session with these presses."""
    session = PressFinder()
    session.presses, session.lasts = presses, lasts
    return session


def test_each_press_is_judged_and_the_next_place_is_named() -> None:
    lines: list[str] = []
    guide = Guide(9, lines.append)
    guide(finder([]))
    guide(finder([press(45, 45), press(20, 20), press(20, 70, (4, 4)), press(5, 45)]))
    assert lines[0] == "press 1 of 9: good, radius 10 px. Press the ball firmly at the upper left."
    assert lines[2].startswith(
        "press 3 of 9: light, radius 4 px where 10 px is usual; press harder. Press the ball"
    )
    assert lines[3].startswith("press 4 of 9: cut off by the border of the picture at (5, 45)")


def test_a_press_is_reported_once_it_is_over_and_the_session_ends_with_enough() -> None:
    lines: list[str] = []
    guide = Guide(3, lines.append)
    assert not guide(finder([]))
    assert not guide(finder([press(45, 45)], lasts=True))
    assert not lines
    assert not guide(finder([press(45, 45)]))
    assert lines[-1].startswith("press 1 of 3: good")
    # A new reference has dropped the press.
    assert not guide(finder([]))
    assert guide(finder([press(45, 45), press(70, 20), press(70, 70)]))
    assert lines[1].startswith("press 1 of 3: good")
