"""The sink `foxglove`, as a client of its protocol sees it."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import cv2
import numpy as np
import pytest
from websockets.sync.client import ClientConnection, connect

import tactflow
from tactflow.engine.errors import StageError
from tactflow.engine.frame import Frame
from tactflow.message.result import Result
from tactflow.plugins.foxglove.sink import HOST, Foxglove
from tactflow.vision.types import Depth, Scale
from tests.clock import PATIENCE, until
from tests.messages import CONTACT, FLOW, MARKERS, Results

pytest.importorskip("foxglove", reason="the extra foxglove is not installed")

from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud

IMAGE = np.full((40, 60, 3), (30, 90, 160), np.uint8)
HEIGHTS = np.linspace(0, 1, 40 * 60, dtype=np.float32).reshape(40, 60)
RESULTS = Results(
    IMAGE,
    CONTACT,
    FLOW,
    MARKERS,
    Scale(0.1, 0.2, (0.001, 0.001), (10.0, 5.0)),
    Depth(HEIGHTS, 1.0, None, 3.0, None),
)
T = 1_700_000_000.25
"""Capture time of the first frame, s: that of a camera."""
TOPICS = {
    "/left/image": ("foxglove.CompressedImage", "protobuf"),
    "/left/annotations": ("foxglove.ImageAnnotations", "protobuf"),
    "/left/results": ("tactflow.frame", "json"),
    "/left/surface": ("foxglove.PointCloud", "protobuf"),
}


class Client:
    """A connection to the sink, and what it offers: topic -> description."""

    def __init__(self, socket: ClientConnection, sink: Foxglove) -> None:
        self.socket, self.sink = socket, sink
        self.channels: dict[str, dict[str, Any]] = {}
        while len(self.channels) < len(TOPICS):
            told = json.loads(socket.recv(timeout=PATIENCE))
            self.channels |= {channel["topic"]: channel for channel in told.get("channels", ())}

    def subscribe(self, *topics: str) -> None:
        """Subscribe, and wait until the sink knows; the number of a subscription is that of its channel."""
        wanted = [self.channels[topic]["id"] for topic in topics]
        pairs = [{"id": channel, "channelId": channel} for channel in wanted]
        self.socket.send(json.dumps({"op": "subscribe", "subscriptions": pairs}))
        own = self.sink._channels.values()
        until(lambda: sum(channel.has_sinks() for channel in own) == len(topics))

    def receive(self) -> tuple[str, int, bytes]:
        """The next message: topic, time in ns, content."""
        while True:
            told = self.socket.recv(timeout=PATIENCE)
            if isinstance(told, bytes) and told[0] == 1:
                number, time = struct.unpack("<IQ", told[1:13])
                (topic,) = (name for name, one in self.channels.items() if one["id"] == number)
                return topic, time, told[13:]


@contextmanager
def serving(**settings: Any) -> Iterator[Foxglove]:
    sink = Foxglove(Foxglove.Params(port=0, **settings), "left")
    sink.open()
    try:
        yield sink
    finally:
        sink.close()


@contextmanager
def connected(sink: Foxglove) -> Iterator[Client]:
    assert sink.description is not None
    with connect(sink.description, subprotocols=["foxglove.sdk.v1"]) as socket:  # type: ignore[list-item]
        yield Client(socket, sink)


def result(seq: int, results: Results = RESULTS) -> Result:
    return Result(Frame("left", seq, T + seq / 50, IMAGE), results._asdict())


def test_pictures_annotations_numbers_and_the_surface_arrive() -> None:
    with serving() as sink, connected(sink) as client:
        offered = {name: (one["schemaName"], one["encoding"]) for name, one in client.channels.items()}
        assert offered == TOPICS
        client.subscribe(*TOPICS)
        sink.write(result(0))
        received = [client.receive() for _ in TOPICS]
    assert {time for _, time, _ in received} == {round(T * 1e9)}
    found = {topic: data for topic, _, data in received}
    picture = CompressedImage.FromString(found["/left/image"])
    shown = cv2.imdecode(np.frombuffer(picture.data, np.uint8), cv2.IMREAD_COLOR)
    assert np.abs(shown - 1.0 * IMAGE).mean() < 3
    annotations = ImageAnnotations.FromString(found["/left/annotations"])
    outline = np.array([(point.x, point.y) for point in annotations.points[0].points])
    assert outline == pytest.approx(CONTACT.hull + 0.5)
    numbers = json.loads(found["/left/results"])
    assert numbers["contact"]["area"] == CONTACT.area
    assert numbers["flow"]["rotation"] == FLOW.rotation
    surface = PointCloud.FromString(found["/left/surface"])
    assert [(field.name, field.offset) for field in surface.fields] == [("x", 0), ("y", 4), ("z", 8)]
    x, y, z = np.frombuffer(surface.data, "<f4").reshape(20, 30, 3).transpose(2, 0, 1)
    rows, columns = np.mgrid[:40:2, :60:2]
    assert x == pytest.approx((columns - 10) * 1e-4)
    assert y == pytest.approx((rows - 5) * 2e-4)
    assert z == pytest.approx(HEIGHTS[::2, ::2] * -1e-3)
    assert (surface.point_stride, surface.frame_id, surface.pose.orientation.w) == (12, "left", 1)


def test_nothing_is_encoded_that_nobody_subscribed_to() -> None:
    with serving(max_fps=100) as sink:
        assert not sink.wants()
        sink.write(result(0))
        with connected(sink) as client:
            assert not sink.wants()
            client.subscribe("/left/results")
            assert sink.wants()
            sink.write(result(1))
            sink.write(result(2, RESULTS._replace(depth=None)))
            seqs = [json.loads(client.receive()[2])["seq"] for _ in range(2)]
        until(lambda: not sink.wants())
        assert seqs == [1, 2]
        assert sink.counters() == {"messages": 2}


def test_a_surface_is_sent_of_frames_with_depth_alone_and_the_rate_is_limited() -> None:
    with serving(max_fps=10, surface_step=20) as sink, connected(sink) as client:
        client.subscribe("/left/surface")
        for seq in range(11):
            sink.write(result(seq, RESULTS if seq else RESULTS._replace(depth=None)))
        times = [client.receive()[1] for _ in range(2)]
        assert sink.counters() == {"messages": 2}
    assert times == [round((T + seq / 50) * 1e9) for seq in (5, 10)]


def test_the_surface_is_flat_after_the_contact() -> None:
    nothing = RESULTS._replace(depth=None, contact=None)
    with serving(max_fps=100) as sink, connected(sink) as client:
        client.subscribe("/left/surface")
        for seq, results in enumerate((nothing, RESULTS, nothing)):
            sink.write(result(seq, results))
        pressed, flat = (PointCloud.FromString(client.receive()[2]).data for _ in range(2))
    depth, rest = (np.frombuffer(data, "<f4").reshape(-1, 3)[:, 2] for data in (pressed, flat))
    assert depth.min() < 0
    assert not rest.any()


def test_a_taken_port_is_not_fatal_and_several_sensors_share_the_range() -> None:
    with serving() as first:
        port = int(str(first.description).rpartition(":")[2])
        second = Foxglove(Foxglove.Params(port=port), "right")
        second.open()
        assert second.description not in (None, first.description)
        second.close()


def test_it_listens_on_this_machine_alone() -> None:
    assert HOST == "127.0.0.1"
    assert "host" not in Foxglove.Params.model_fields


def test_the_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tactflow.system.extras.importlib.util.find_spec", lambda _: None)
    with pytest.raises(StageError, match=r"need foxglove, .*: pip install 'tactflow\[foxglove\]'"):
        Foxglove(Foxglove.Params()).open()


def test_a_run_serves_it() -> None:
    settings = {"sinks": {"foxglove": {"port": 0}}}
    assert tactflow.run(source="sim:press", settings=settings, max_frames=3).stats["frames"] == 3
