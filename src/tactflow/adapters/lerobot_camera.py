"""LeRobot camera: live pictures for LeRobot's camera of type `zmq`."""

from __future__ import annotations

import base64
import logging

import numpy as np
import orjson
from pydantic import Field, model_validator

from tactflow.drawing.jpeg import encode_jpeg
from tactflow.engine.contract import Sink, StageParams
from tactflow.engine.frame import Tick
from tactflow.network.address import Address
from tactflow.network.publisher import Publisher
from tactflow.ports import Image

log = logging.getLogger("tactflow")

SEND_BUFFER = 1 << 18
"""Kernel's buffer for each reader, bytes: some pictures. Chosen by hand."""


class LerobotCamera(Sink):
    """Publishes the processed picture as LeRobot's `ZMQCamera` reads it.

    A message is JSON, `{"timestamps": {sensor: seconds}, "images": {sensor: JPEG in base64}}`. While nobody
    reads, nothing is encoded. `in: {image: visualize.annotated}` sends another picture.
    """

    threaded = True
    when_live = "latest"
    observer = True

    class Params(StageParams):
        """Where to publish, and how good the pictures are."""

        endpoint: str = Field("tcp://127.0.0.1:5555", description="address to bind")
        open_to_all: bool = Field(
            False,
            description="publish to other machines: LeRobot's camera knows no keys, so anybody may look",
        )
        quality: int = Field(90, ge=1, le=100, description="of the JPEG; higher is sharper and larger")

        @model_validator(mode="after")
        def _local(self) -> LerobotCamera.Params:
            if not self.open_to_all and not Address.parse(self.endpoint).is_local:
                raise ValueError(
                    f"{self.endpoint} can be reached from other machines, and LeRobot's camera knows no "
                    "keys: set endpoint to tcp://127.0.0.1:5555, or open_to_all: true to let anybody look"
                )
            return self

    @classmethod
    def binds(cls, params: LerobotCamera.Params) -> dict[str, str]:
        """Its endpoint: LeRobot's camera reads one sensor there."""
        return {} if Address.parse(params.endpoint).picks_a_port else {"endpoint": params.endpoint}

    def __init__(self, params: Params, sensor: str = "main") -> None:
        """Prepare; nothing is bound yet. sensor : LeRobot's `camera_name`."""
        super().__init__(params)
        self.endpoint = self.description = params.endpoint
        self._sensor = sensor
        self._publisher: Publisher | None = None
        self._sent = 0

    def open(self) -> None:
        """Bind the socket. Raises StageError if the address is taken or cannot be bound."""
        self._publisher = Publisher(self.params.endpoint, 1, SEND_BUFFER)
        self.endpoint = self.description = self._publisher.endpoint
        log.info("pictures for LeRobot on %s", self.endpoint)

    def counters(self) -> dict[str, int]:
        """pictures : sent so far."""
        return {"pictures": self._sent}

    def write(self, tick: Tick, image: Image) -> None:
        """Send one picture to whoever reads; never waits."""
        publisher = self._publisher
        if publisher is None or not publisher.is_subscribed(b""):
            return
        # LeRobot takes what it decodes for RGB, whereas a JPEG is decoded to BGR.
        jpeg = encode_jpeg(np.ascontiguousarray(image[:, :, ::-1]), self.params.quality)
        images = {self._sensor: base64.b64encode(jpeg).decode()}
        message = {"timestamps": {self._sensor: tick.frame.t}, "images": images}
        publisher.send(orjson.dumps(message))
        self._sent += 1

    def close(self) -> None:
        """Free the address."""
        publisher, self._publisher = self._publisher, None
        if publisher is not None:
            publisher.close(0)
