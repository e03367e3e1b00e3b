"""Pictures for LeRobot's camera."""

from __future__ import annotations

import base64
import json

import cv2
import numpy as np
import pytest
import zmq
from pydantic import ValidationError

from tactflow.adapters.lerobot_camera import LerobotCamera
from tactflow.engine.frame import Frame, Tick
from tests.clock import until

IMAGE = np.full((48, 64, 3), (200, 100, 20), np.uint8)


def test_a_reader_gets_the_picture_with_its_time_and_colours_as_lerobot_takes_them() -> None:
    sink = LerobotCamera(LerobotCamera.Params(endpoint="tcp://127.0.0.1:*"), "left")
    sink.open()
    tick = Tick(Frame("left", 3, 0.1, IMAGE))
    sink.write(tick, IMAGE)
    assert sink.counters() == {"pictures": 0}
    with zmq.Context() as context, context.socket(zmq.SUB) as reader:
        reader.subscribe(b"")
        reader.setsockopt(zmq.CONFLATE, 1)
        reader.connect(sink.endpoint)

        def arrived() -> int:
            sink.write(tick, IMAGE)
            return reader.poll(10)

        until(arrived)
        message = json.loads(reader.recv_string())
        sink.close()
    assert message["timestamps"] == {"left": 0.1}
    jpeg = np.frombuffer(base64.b64decode(message["images"]["left"]), np.uint8)
    red_first = cv2.imdecode(jpeg, cv2.IMREAD_COLOR)
    assert np.allclose(red_first.mean((0, 1)), (20, 100, 200), atol=3)


def test_an_address_that_others_reach_is_refused_because_lerobot_knows_no_keys() -> None:
    with pytest.raises(ValidationError, match="knows no keys"):
        LerobotCamera.Params(endpoint="tcp://*:5555")
    assert LerobotCamera.Params(endpoint="tcp://*:5555", open_to_all=True).open_to_all
