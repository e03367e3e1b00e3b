"""Stage `slip`."""

from __future__ import annotations

import numpy as np

from tactflow.engine.contract import StageParams
from tactflow.engine.ports import read_ports
from tactflow.stages.slip import SlipPorts, SlipStage
from tactflow.vision.flow import FieldModel
from tactflow.vision.types import Markers, Slip

X, Y = np.meshgrid(np.arange(10.0, 200, 20), np.arange(10.0, 200, 20))
ORIGIN = np.column_stack([X.ravel(), Y.ravel()])
MARKERS = Markers(ORIGIN, ORIGIN + np.array([3.0, 0]), np.zeros(100, np.uint8), np.full(100, 0.02))
FIELD = FieldModel(ORIGIN, (200, 200))(MARKERS)
NOTHING = np.zeros((200, 200), np.uint8)


def step(stage: SlipStage, left: int) -> SlipPorts:
    mask = NOTHING.copy()
    mask[70:130, left : left + 60] = 255
    assert FIELD is not None
    return stage.process(True, mask, FIELD)


def test_it_gives_a_signal_for_gates_and_how_much_sticks() -> None:
    ports = read_ports(SlipStage, "process")
    assert [(port.name, port.optional) for port in ports.outputs] == [("slipping", False), ("slip", True)]
    stage = SlipStage(StageParams())
    assert step(stage, 60) == SlipPorts(False, Slip(False, 1.0))
    assert step(stage, 70) == SlipPorts(True, Slip(True, 0.0))


def test_without_a_contact_or_a_field_nothing_slips_and_the_last_contact_is_forgotten() -> None:
    stage = SlipStage(StageParams())
    step(stage, 60)
    assert stage.process(False, NOTHING) == SlipPorts(False, None)
    assert not step(stage, 70).slipping
    assert stage.process(True, NOTHING, None) == SlipPorts(False, None)
    assert not step(stage, 80).slipping
    stage.reset()
    assert not step(stage, 90).slipping
