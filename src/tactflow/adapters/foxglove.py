"""Foxglove: serves live pictures, annotations and results to Foxglove."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import TYPE_CHECKING

from pydantic import Field, model_validator

from tactflow.drawing.jpeg import encode_jpeg
from tactflow.engine.contract import Sink, StageParams
from tactflow.engine.errors import StageError
from tactflow.message.result import Result, encode_message
from tactflow.network.address import is_loopback
from tactflow.system.extras import missing

if TYPE_CHECKING:
    from foxglove import Channel, Context
    from foxglove.websocket import WebSocketServer

log = logging.getLogger("tactflow")

BACKLOG = 32
"""Messages queued per viewer. Chosen by hand."""


class Foxglove(Sink):
    """Serves the channels of a recording live: `/main/image`, `/main/annotations`, `/main/results`, and
    `/main/pose`, the pose of the object for the 3D panel, in metres.

    In Foxglove: *Open connection*, *Foxglove WebSocket*, `ws://localhost:8765`. Channels without
    viewers are not encoded, and a slow viewer loses messages; the run never waits.
    """

    threaded = True
    when_live = "latest"
    observer = True

    class Params(StageParams):
        """Address, and quality of the pictures."""

        host: str = Field(
            "127.0.0.1", min_length=1, description="address to listen at; 127.0.0.1 is this machine only"
        )
        port: int = Field(8765, ge=0, le=65535, description="0 picks a free one")
        open_to_all: bool = Field(
            False, description="serve other machines: anybody may look, as Foxglove's protocol has no keys"
        )
        quality: int = Field(
            80, ge=1, le=100, description="of the JPEG pictures; higher is sharper and larger"
        )

        @model_validator(mode="after")
        def _local(self) -> Foxglove.Params:
            if not self.open_to_all and not is_loopback(self.host):
                raise ValueError(
                    f"{self.host} can be reached from other machines, and Foxglove's protocol has no keys: "
                    "set host to 127.0.0.1, or open_to_all: true to let anybody look"
                )
            return self

    @classmethod
    def binds(cls, params: Foxglove.Params) -> dict[str, str]:
        """Its address."""
        return {"port": f"ws://{params.host}:{params.port}"} if params.port else {}

    def __init__(self, params: Params, sensor: str = "main") -> None:
        """Prepare; nothing is served yet. sensor : names the channels."""
        super().__init__(params)
        self.address = self.description = f"ws://{params.host}:{params.port}"
        self._sensor = sensor
        self._server: WebSocketServer | None = None
        self._context: Context | None = None
        self._channels: dict[str, Channel] = {}
        self._sent = 0

    def open(self) -> None:
        """Start serving; afterwards `address` has the actual port.

        Raises StageError if a package is missing, or the address is in use or not one of this machine.
        """
        needed = ["foxglove", "mcap_protobuf", "foxglove_schemas_protobuf"]
        problem = missing("live views in Foxglove", "foxglove", needed)
        if problem is not None:
            raise StageError(problem)
        import foxglove
        from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame

        from tactflow.recording.schemas import channel_type, channel_types

        # Keep a reference: the channels end with it.
        self._context = context = foxglove.Context()
        for name, kind in (channel_types() | {"pose": channel_type(PoseInFrame)}).items():
            encoding, data = kind.schema
            schema = foxglove.Schema(name=kind.name, encoding=encoding, data=data)
            topic = f"/{self._sensor}/{name}"
            self._channels[name] = foxglove.Channel(
                topic, schema=schema, message_encoding=kind.packing, context=context
            )
        p = self.params
        # It logs every connection of other programs, and anybody may connect.
        logging.getLogger("foxglove").setLevel(logging.ERROR)
        try:
            self._server = foxglove.start_server(
                name="tactflow", host=p.host, port=p.port, context=context, message_backlog_size=BACKLOG
            )
        except RuntimeError as error:
            raise StageError(
                f"{self.address} cannot be served: {error}; another program may listen there, such as "
                "foxglove_bridge: end it, or choose another port (--set sinks.foxglove.port=8766)"
            ) from error
        self.address = self.description = f"ws://{p.host}:{self._server.port}"
        log.info("foxglove: %s", self.address)

    def wants(self) -> bool:
        """Whether a channel has viewers. Thread-safe."""
        return any(channel.has_sinks() for channel in list(self._channels.values()))

    def counters(self) -> dict[str, int]:
        """messages : sent so far."""
        return {"messages": self._sent}

    def write(self, result: Result) -> None:
        """Send the channels that have viewers; never waits."""
        from tactflow.recording.frames import nanoseconds
        from tactflow.recording.schemas import encode_annotations, encode_picture

        time = nanoseconds(result.frame.t)
        image = result.frame.image if result.image is None else result.image
        encoders: dict[str, Callable[[], bytes | None]] = {
            "image": lambda: encode_picture(encode_jpeg(image, self.params.quality), self._sensor, time),
            "annotations": lambda: encode_annotations(result, time),
            "results": lambda: encode_message(result, detail=True),
            "pose": lambda: _encode_pose(result, self._sensor, time),
        }
        for name, channel in self._channels.items():
            message = encoders[name]() if channel.has_sinks() else None
            if message is not None:
                channel.log(message, log_time=time)
                self._sent += 1

    def close(self) -> None:
        """Stop the server, which closes the connections."""
        server, self._server = self._server, None
        if server is not None:
            server.stop()
        for channel in self._channels.values():
            channel.close()
        self._channels = {}
        self._context = None


def _encode_pose(result: Result, sensor: str, nanoseconds: int) -> bytes | None:
    """One `foxglove.PoseInFrame`, m; None where no object is tracked."""
    pose = result.pose
    if pose is None or pose.status == "lost":
        return None
    from foxglove_schemas_protobuf.Pose_pb2 import Pose
    from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
    from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
    from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
    from scipy.spatial.transform import Rotation

    from tactflow.recording.frames import timestamp

    moved = zip(pose.center, pose.translation, strict=True)
    x, y, z = ((start + way) / 1000 for start, way in moved)
    qx, qy, qz, qw = Rotation.from_rotvec(pose.rotation, degrees=True).as_quat().tolist()
    place = Pose(position=Vector3(x=x, y=y, z=z), orientation=Quaternion(x=qx, y=qy, z=qz, w=qw))
    whole = PoseInFrame(timestamp=timestamp(nanoseconds), frame_id=sensor, pose=place)
    return bytes(whole.SerializeToString())
