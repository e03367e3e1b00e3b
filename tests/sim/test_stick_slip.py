"""The scene in which the gel slips at the edge of the contact first."""

from __future__ import annotations

import numpy as np
import pytest

from tactflow.sim import open_scene
from tactflow.sim.gel import displacement


def test_the_true_stick_ratio_falls_to_nothing_before_the_ball_slides() -> None:
    scene = open_scene("stick_slip?frames=150")
    told = [(scene.truth(index), scene.presses(index)) for index in range(26, 105, 3)]
    ratio = [1.0 if truth.stick_ratio is None else truth.stick_ratio for truth, _ in told]
    assert ratio == sorted(ratio, reverse=True)
    assert ratio[0] == pytest.approx(1, abs=0.05)
    sliding = [truth.slipping for truth, _ in told]
    assert sliding == sorted(sliding)
    assert sliding[-1]
    assert all(value == 0 for value, slips in zip(ratio, sliding, strict=True) if slips)


def test_gel_moves_with_the_ball_on_the_part_that_is_said_to_stick() -> None:
    scene = open_scene("stick_slip?frames=150")
    press = scene.presses(60)[0]
    assert press.stick is not None
    assert 0.5 < press.stick < 0.9
    middle = np.array([press.x, press.y]) - press.shear
    around = middle + press.radius * np.array([[0.0, 0], [0.9 * press.stick, 0], [1.0, 0]])
    moved = displacement([press], around) - displacement([scene.presses(26)[0]], around)
    # Pressing moves the gel along x in both; across, there is the drag alone.
    assert moved[1, 1] == pytest.approx(moved[0, 1], rel=0.02)
    assert abs(moved[2, 1]) < 0.95 * abs(moved[0, 1])
