"""The stage fusion, and what it does for a pipeline."""

from __future__ import annotations

import numpy as np

import tactflow
from tactflow.stages.fusion import FusedPorts, Fusion
from tactflow.vision.types import Markers

ORIGIN = np.array([[x, y] for y in range(20, 220, 25) for x in range(20, 300, 25)], np.float64)
EVERYWHERE = np.full((240, 320), 255, np.uint8)
RESTING = Markers(ORIGIN, ORIGIN.copy(), np.zeros(len(ORIGIN), np.uint8), np.full(len(ORIGIN), 0.02))


def test_without_markers_the_light_is_passed_on() -> None:
    stage = Fusion(Fusion.Params())
    assert stage.process(EVERYWHERE, True) == FusedPorts(EVERYWHERE, True, "light")
    assert stage.process(EVERYWHERE * 0, False).evidence is None


def test_a_light_that_stays_changed_while_nothing_moves_calls_for_a_new_reference() -> None:
    stage = Fusion(Fusion.Params(patience=3))
    asked = []
    for _ in range(5):
        assert not stage.process(EVERYWHERE, True, RESTING).touching
        asked.append(stage.wants_reference)
        stage.wants_reference = None
    assert asked == [None, None, "light_changed", None, None]


def test_a_flash_calls_for_none() -> None:
    stage = Fusion(Fusion.Params(patience=3))
    for _ in range(4):
        for mask in (EVERYWHERE, EVERYWHERE, EVERYWHERE * 0):
            stage.process(mask, bool(mask.any()), RESTING)
    assert stage.wants_reference is None


def test_a_simulated_press_is_shown_by_both() -> None:
    shown = [
        result.contact.evidence
        for result in tactflow.stream(source="sim:press?frames=90")
        if result.contact is not None
    ]
    assert shown.count("both") > 0.8 * len(shown) > 30


def test_a_marker_that_joins_is_taken_into_account() -> None:
    stage = Fusion(Fusion.Params())
    fewer = Markers(ORIGIN[:-1], ORIGIN[:-1], np.zeros(len(ORIGIN) - 1, np.uint8), RESTING.stderr[:-1])
    for markers in (fewer, RESTING):
        assert not stage.process(EVERYWHERE * 0, False, markers).touching
