"""Sink `foxglove`: live pictures, annotations, the surface and all numbers in Foxglove."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from tactflow.drawing.jpeg import encode_jpeg
from tactflow.engine.contract import Sink, StageParams
from tactflow.engine.errors import StageError
from tactflow.engine.rate import RateLimit
from tactflow.message.result import Result, encode_message
from tactflow.recording import REQUIRED_PACKAGES
from tactflow.system.extras import missing
from tactflow.vision.types import Scale

if TYPE_CHECKING:
    from foxglove import Channel, Context
    from foxglove.websocket import WebSocketServer

log = logging.getLogger("tactflow")

HOST: Final = "127.0.0.1"
"""The server has no passwords, so that it must not be reached from other machines."""
NEXT_PORTS: Final = 20
"""Ports that are tried after the one that is taken, as by several sensors."""
METRES_PER_MM: Final = 1e-3
"""Metres per millimetre."""
BACKLOG_MESSAGES: Final = 32
"""Messages that wait for a slow client; then the oldest is dropped. About 15 MB of surfaces."""


class Foxglove(Sink):
    """Serves the results to Foxglove (`Open connection`, `ws://localhost:8765`) and other clients of its
    protocol.

    Topics are named as those of a recording, so that `tactflow schema foxglove-layout` fits both:
    `/SENSOR/image` and `/SENSOR/annotations` of the processed picture, `/SENSOR/results`, the message with
    `detail`, for plots; and `/SENSOR/surface`, a point cloud in m, of a sensor that measures depth. Without
    clients, no frame is requested, and a topic that nobody subscribes to is not encoded. A server that cannot
    be started is reported once and never stops a run.

    Raises StageError if a package is missing.

    >>> import tactflow
    >>> settings = {"sinks": {"foxglove": {"port": 0}}}
    >>> tactflow.run(source="sim:press", settings=settings, max_frames=3).stats["frames"]
    3
    """

    threaded = True
    when_live = "latest"
    observer = True

    class Params(StageParams):
        """Port of this machine, and amount of data."""

        port: int = Field(8765, ge=0, le=65535, description="port, or the next free one; 0: any")
        max_fps: float = Field(30.0, gt=0, le=240, description="maximum number of frames per second")
        quality: int = Field(85, ge=1, le=100, description="of the pictures; higher is sharper and larger")
        surface_step: int = Field(2, ge=1, description="every how many pixels the surface has a point")

    params: Params

    def __init__(self, params: Params, sensor: str = "main") -> None:
        """Prepare; nothing is served yet. sensor : names the topics."""
        super().__init__(params)
        self._sensor = sensor
        self._rate = RateLimit(params.max_fps)
        self._server: WebSocketServer | None = None
        self._context: Context | None = None
        self._channels: dict[str, Channel] = {}
        self._heights: NDArray[np.float32] | None = None
        self._sent = 0

    def open(self) -> None:
        """Start the server; afterwards `description` is its address, or None if it cannot be started."""
        problem = missing("live results in Foxglove", "foxglove", ["foxglove", *REQUIRED_PACKAGES])
        if problem is not None:
            raise StageError(problem)
        import foxglove
        from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud

        from tactflow.recording.schemas import channel_type, channel_types

        # The channels end with their context, which neither they nor the server keep.
        self._context = context = foxglove.Context()
        self._server = self._start(context)
        if self._server is None:
            return
        types = {name: channel_types()[name] for name in ("image", "annotations", "results")}
        for name, kind in (types | {"surface": channel_type(PointCloud)}).items():
            encoding, schema = kind.schema
            self._channels[name] = foxglove.Channel(
                f"/{self._sensor}/{name}",
                schema=foxglove.Schema(name=kind.name, encoding=encoding, data=schema),
                message_encoding=kind.packing,
                context=context,
            )
        self.description = f"ws://localhost:{self._server.port}"
        log.info("foxglove: %s", self.description)

    def _start(self, context: Context) -> WebSocketServer | None:
        import foxglove

        first, problem = self.params.port, ""
        ports = range(first, min(first + NEXT_PORTS, 65536)) if first else [0]
        for port in ports:
            try:
                return foxglove.start_server(
                    name=f"tactflow: {self._sensor}",
                    host=HOST,
                    port=port,
                    context=context,
                    message_backlog_size=BACKLOG_MESSAGES,
                )
            except RuntimeError as error:
                problem = str(error)
        log.warning("foxglove: not served on port %d or the next ones: %s", first, problem)
        return None

    def wants(self) -> bool:
        """Whether a client has subscribed to a topic."""
        return any(channel.has_sinks() for channel in list(self._channels.values()))

    def counters(self) -> dict[str, int]:
        """messages : sent so far."""
        return {"messages": self._sent}

    def write(self, result: Result) -> None:
        """Send one frame to those who have subscribed to its topics; never waits."""
        from tactflow.recording.frames import nanoseconds

        if result.frame.seq < 0 or not self.wants() or not self._rate.due(result.t):
            return
        time = nanoseconds(result.t)
        for name, channel in self._channels.items():
            data = self._encoded(name, result, time) if channel.has_sinks() else None
            if data is not None:
                channel.log(data, log_time=time)
                self._sent += 1

    def _encoded(self, name: str, result: Result, time: int) -> bytes | None:
        """The message of a topic; None if there is nothing to send."""
        from tactflow.recording.schemas import encode_annotations, encode_picture

        if name == "results":
            return encode_message(result, detail=True)
        if name == "annotations":
            return encode_annotations(result, time)
        if name == "surface":
            return self._surface(result, time)
        image = result.frame.image if result.image is None else result.image
        return encode_picture(encode_jpeg(image, self.params.quality), self._sensor, time)

    def _surface(self, result: Result, time: int) -> bytes | None:
        """The surface; flat after a contact, None before the first or where its depth is not known."""
        depth, scale = result.depth, result.scale
        if scale is None or (depth is None and (result.contact is not None or self._heights is None)):
            return None
        self._heights = np.zeros_like(self._heights) if depth is None else depth.heights
        return encode_surface(self._heights, scale, result.sensor, time, self.params.surface_step)

    def close(self) -> None:
        """End the connections."""
        for channel in self._channels.values():
            channel.close()
        self._channels = {}
        if self._server is not None:
            self._server.stop()
            self._server = None


def encode_surface(heights: NDArray[np.float32], scale: Scale, frame_id: str, time: int, step: int) -> bytes:
    """One `foxglove.PointCloud`, m: x right, y down, z out of the gel, negative where it is pressed in.

    heights : (H, W) float32, indentation, mm. time : ns. step : every how many pixels there is a point.
    """
    from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
    from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud

    from tactflow.recording.frames import timestamp

    chosen = heights[::step, ::step]
    rows, columns = np.indices(chosen.shape) * step
    x, y = (columns - scale.origin[0]) * scale.x, (rows - scale.origin[1]) * scale.y
    cloud = (np.dstack([x, y, -chosen]) * METRES_PER_MM).astype("<f4")
    number = PackedElementField.NumericType.FLOAT32
    fields = [PackedElementField(name=axis, offset=4 * i, type=number) for i, axis in enumerate("xyz")]
    message = PointCloud(
        timestamp=timestamp(time), frame_id=frame_id, point_stride=12, fields=fields, data=cloud.tobytes()
    )
    message.pose.orientation.w = 1.0
    return bytes(message.SerializeToString())
