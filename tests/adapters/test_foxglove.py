"""The live view in Foxglove, read over its WebSocket protocol."""

from __future__ import annotations

import json
import struct
import sys
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

pytest.importorskip("foxglove", reason="the extra foxglove is not installed")

from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from websockets.sync.client import connect

from tactflow.adapters.foxglove import Foxglove
from tactflow.engine.errors import StageError
from tactflow.engine.frame import Frame, Tick
from tactflow.vision.types import Pose
from tests.clock import PATIENCE, until
from tests.messages import CONTACT, FLOW, MARKERS, PROCESSED, Results, result_of

TICK = Tick(Frame("left", 3, 1.5, PROCESSED))
POSE = Pose("tracked", 0, (1.0, 2.0, -0.5), (0.5, 0.0, 0.25), (0.0, 0.0, 90.0), np.eye(6))
FOUND = Results(PROCESSED, CONTACT, FLOW, MARKERS, pose=POSE)


def opened(**params: Any) -> Foxglove:
    sink = Foxglove(Foxglove.Params(port=0, **params), "left")
    sink.open()
    return sink


def test_a_viewer_gets_what_it_subscribes_to_and_nothing_else_is_encoded() -> None:
    sink = opened()
    try:
        assert not sink.wants()
        with connect(sink.address, subprotocols=["foxglove.sdk.v1"], open_timeout=PATIENCE) as viewer:  # type: ignore[list-item]
            channels: dict[str, Any] = {}
            while len(channels) < 4:
                told = json.loads(viewer.recv(PATIENCE))
                if told["op"] == "advertise":
                    channels |= {channel["topic"]: channel for channel in told["channels"]}
            assert channels["/left/image"]["schemaName"] == "foxglove.CompressedImage"
            for number, name in enumerate(("image", "annotations", "pose"), start=1):
                asked = {"id": number, "channelId": channels[f"/left/{name}"]["id"]}
                viewer.send(json.dumps({"op": "subscribe", "subscriptions": [asked]}))
            until(lambda: sum(channel.has_sinks() for channel in sink._channels.values()) == 3)
            assert sink.wants()
            sink.write(result_of(TICK, FOUND))
            assert sink.counters() == {"messages": 3}
            got = {}
            while len(got) < 3:
                data = viewer.recv(PATIENCE)
                if isinstance(data, bytes) and data[0] == 1:
                    number, time = struct.unpack_from("<IQ", data, 1)
                    assert time == 1_500_000_000
                    got[number] = data[13:]
        assert CompressedImage.FromString(got[1]).format == "jpeg"
        dots = [p for one in ImageAnnotations.FromString(got[2]).points if one.type == 1 for p in one.points]
        assert np.array_equal([(p.x, p.y) for p in dots], MARKERS.position + 0.5)
        pose = PoseInFrame.FromString(got[3]).pose
        assert (pose.position.x, pose.position.y, pose.position.z) == (0.0015, 0.002, -0.00025)
        assert (pose.orientation.z, pose.orientation.w) == pytest.approx((0.5**0.5, 0.5**0.5))
        until(lambda: not sink.wants())
    finally:
        sink.close()


def test_a_taken_port_and_a_missing_package_say_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    first = opened()
    port = int(first.address.rpartition(":")[2])
    second = Foxglove(Foxglove.Params(port=port))
    with pytest.raises(StageError, match=r"cannot be served.*--set sinks.foxglove.port=8766"):
        second.open()
    second.close()
    first.close()
    monkeypatch.setitem(sys.modules, "foxglove", None)
    with pytest.raises(StageError, match=r"need foxglove: pip install 'tactflow\[foxglove\]'"):
        second.open()
    with pytest.raises(ValidationError, match="has no keys"):
        Foxglove.Params(host="0.0.0.0")
