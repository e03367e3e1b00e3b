"""Stage `slip`."""

from __future__ import annotations

import numpy as np
import pytest

from tactflow.engine.frame import Frame
from tactflow.engine.ports import read_ports
from tactflow.stages.slip import SlipPorts, SlipStage
from tactflow.vision.flow import FieldModel
from tactflow.vision.types import Markers

X, Y = np.meshgrid(np.arange(10.0, 200, 20), np.arange(10.0, 200, 20))
ORIGIN = np.column_stack([X.ravel(), Y.ravel()])
MARKERS = Markers(ORIGIN, ORIGIN + np.array([3.0, 0]), np.zeros(100, np.uint8), np.full(100, 0.02))
FIELD = FieldModel(ORIGIN, (200, 200))(MARKERS)
NOTHING = np.zeros((200, 200), np.uint8)
REST = np.zeros((200, 200, 3), np.uint8)


def step(stage: SlipStage, left: int, seq: int = 0) -> SlipPorts:
    mask, picture = NOTHING.copy(), REST.copy()
    mask[70:130, left : left + 60] = picture[70:130, left : left + 60, 0] = 255
    return stage.process(Frame("main", seq, seq / 60, picture), True, mask, picture, REST, None, FIELD)


def test_it_gives_a_signal_for_gates_and_how_far_the_object_has_slid() -> None:
    ports = read_ports(SlipStage, "process")
    assert [(port.name, port.optional) for port in ports.outputs] == [("slipping", False), ("slip", True)]
    stage = SlipStage(SlipStage.Params())
    first, second, third = step(stage, 60), step(stage, 70, 1), step(stage, 80, 2)
    assert (first.slipping, first.slip.stick_ratio, first.slip.speed) == (False, 1.0, None)
    assert (second.slipping, second.slip.kind, second.slip.onset) == (False, None, None)
    assert (third.slipping, third.slip.stick_ratio, third.slip.since) == (True, 0.0, 0)
    assert (third.slip.kind, third.slip.onset) == ("sliding", 1 / 60)
    assert third.slip.translation == pytest.approx((20, 0), abs=0.5)


def test_without_a_contact_or_a_field_nothing_slips_and_the_last_contact_is_forgotten() -> None:
    stage, frame = SlipStage(SlipStage.Params()), Frame("main", 0, 0.0, REST)
    step(stage, 60)
    assert stage.process(frame, False, NOTHING, REST, REST) == SlipPorts(False, None)
    assert not step(stage, 70).slipping
    assert stage.process(frame, True, NOTHING, REST, REST) == SlipPorts(False, None)
    assert not step(stage, 80).slipping
    stage.reset()
    assert not step(stage, 90).slipping
