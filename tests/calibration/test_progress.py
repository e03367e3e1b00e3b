"""How a session of presses goes."""

from __future__ import annotations

import cv2
import numpy as np

from tactflow.calibration.presses import Press
from tactflow.calibration.progress import fault, progress

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
