"""ZeroMQ: result messages for subscribers in other processes."""

from __future__ import annotations

import logging
import threading

import numpy as np
import orjson
from pydantic import Field

from tactflow.drawing.jpeg import encode_jpeg
from tactflow.engine.contract import Sink
from tactflow.engine.control import Control
from tactflow.engine.rate import RateLimit
from tactflow.message.result import MessageParams, Result, encode_message
from tactflow.network.commands import ControlSocket
from tactflow.network.parameters import PublisherParams
from tactflow.network.publisher import Publisher
from tactflow.ports import Image

log = logging.getLogger("tactflow")

STATS_TOPIC = b"tactflow.stats "


class Zmq(Sink):
    """Publishes one message per frame: `tactflow.<sensor>`, a space, the JSON of `tactflow.frame/1`.

    Without subscribers to this sensor, no frame is requested and nothing encoded. A slow subscriber loses
    messages; it never slows the run. Messages are encoded in the thread that computes them, which costs less
    than to wake another one; `segment: zmq` gives the sink its own, for `pictures` at a high rate.

    Subscribers to the exact topic `tactflow.stats` get the statistics of the run every `stats_every` seconds:
    `tactflow.stats`, a space, the JSON of the statistics file with the sensor's name. A shorter prefix, such
    as `tactflow.`, does not request them, but receives them if another subscriber does.

    Subscribers to the exact topic `tactflow_picture.<sensor>` or `tactflow_depth.<sensor>` get the processed
    picture (JPEG) or the depth map (float32, mm, row by row, little-endian) at the rate `pictures`: the
    topic, a space, JSON with sensor, seq, t and size (width, height), a line end, the data.

    With `control`, other programs may pause the run, take a new reference, start and end recordings.

    >>> import tactflow
    >>> sink = Zmq(Zmq.Params(endpoint="tcp://127.0.0.1:*"))
    >>> sink.open()
    >>> with tactflow.Subscriber(sink.endpoint) as results:
    ...     sink.wait_for_subscriber(10)
    ...     sink.write(Result(tactflow.Frame("main", 36, 1.2, np.zeros((60, 80, 3), np.uint8))))
    ...     next(iter(results)).seq
    True
    36
    >>> sink.close()
    """

    when_live = "latest"

    class Params(PublisherParams, MessageParams):
        """Address, queue, access of subscribers and of commands, and content."""

        wait_for_subscriber: float = Field(0.0, ge=0, description="longest wait for a first subscriber, s")
        stats_every: float = Field(1.0, ge=0, le=3600, description="interval of tactflow.stats, s; 0: none")
        pictures: float = Field(
            0.0, ge=0, le=240, description="rate of tactflow_picture and tactflow_depth, Hz; 0: none"
        )
        quality: int = Field(80, ge=1, le=100, description="of the pictures; higher is sharper and larger")

    def __init__(self, params: Params, sensor: str = "main", control: Control | None = None) -> None:
        """Prepare; nothing is bound yet.

        sensor : names the topic. control : the run, for statistics and commands; or None.
        """
        super().__init__(params)
        self.endpoint = params.endpoint
        self.description = params.endpoint
        self._sensor = sensor
        self._control = control
        self._topic, self._picture_topic, self._depth_topic = (
            f"tactflow{kind}.{sensor} ".encode() for kind in ("", "_picture", "_depth")
        )
        self._publisher: Publisher | None = None
        self._rate = RateLimit(params.pictures or None)
        self._had_depth = False
        self._serialised = 0
        self._closing = threading.Event()
        self._stats_thread: threading.Thread | None = None
        self._commands: ControlSocket | None = None

    @property
    def control_endpoint(self) -> str | None:
        """The actual address for commands; None without."""
        return None if self._commands is None else self._commands.endpoint

    def open(self) -> None:
        """Bind the sockets; afterwards `endpoint` and `control_endpoint` are the actual addresses.

        Raises StageError if an address is in use or cannot be bound, or the keys are wrong.
        """
        p = self.params
        self._publisher = Publisher(p.endpoint, p.backlog, p.keys)
        self.endpoint = self._publisher.endpoint
        self.description = f"{self._topic.decode().strip()} on {self.endpoint}"
        log.info("publishing %s", self.description)
        if p.control is not None:
            self._commands = ControlSocket(p.control, p.commanders, self._sensor, self._control)
            log.info("taking commands on %s", self.control_endpoint)
        self.wait_for_subscriber(p.wait_for_subscriber)
        if self._control is not None and p.stats_every:
            # In a thread of its own: statistics are published without frames, too.
            self._stats_thread = threading.Thread(
                target=self._publish_statistics,
                args=(self._publisher, self._control),
                name="tactflow-stats",
                daemon=True,
            )
            self._stats_thread.start()

    def wait_for_subscriber(self, seconds: float) -> bool:
        """Wait for a subscriber to the results, at most `seconds`; returns whether there is one."""
        return self._publisher is not None and self._publisher.wait_for(self._topic, seconds)

    def _asked(self) -> list[bytes]:
        """The topics of pictures and depth maps that have subscribers."""
        if self._publisher is None or not self.params.pictures:
            return []
        topics = (self._picture_topic, self._depth_topic)
        return [topic for topic in topics if self._publisher.is_subscribed(topic, by_name=True)]

    def wants(self) -> bool:
        """Whether this sensor has subscribers. Thread-safe; takes about 3 us."""
        publisher = self._publisher
        return publisher is not None and (publisher.is_subscribed(self._topic) or bool(self._asked()))

    def counters(self) -> dict[str, int]:
        """serialised : encoded messages. subscriptions : distinct ones now."""
        subscriptions = 0 if self._publisher is None else self._publisher.subscriptions
        return {"serialised": self._serialised, "subscriptions": subscriptions}

    def write(self, result: Result) -> None:
        """Publish one message; never waits."""
        if self._publisher is None or not self.wants():
            return
        p, frame = self.params, result.frame
        self._publisher.send(self._topic + encode_message(result, detail=p.detail, field=p.field))
        self._serialised += 1
        asked = self._asked()
        if asked and frame.seq >= 0 and self._rate.due(frame.t):
            image = frame.image if result.image is None else result.image
            height, width = image.shape[:2]
            about = {"sensor": self._sensor, "seq": frame.seq, "t": frame.t, "size": [width, height]}
            for topic in asked:
                data = self._data(topic, image, result)
                if data is not None:
                    self._publisher.send(topic + orjson.dumps(about) + b"\n" + data)

    def _data(self, topic: bytes, image: Image, result: Result) -> bytes | None:
        """The picture as JPEG, or the depth map; None without depth."""
        if topic == self._picture_topic:
            return encode_jpeg(image, self.params.quality)
        if result.depth is not None:
            self._had_depth = True
            return result.depth.heights.astype("<f4").tobytes()
        flat = self._had_depth and result.contact is None
        return np.zeros(image.shape[:2], "<f4").tobytes() if flat else None

    def _publish_statistics(self, publisher: Publisher, control: Control) -> None:
        """Body of the thread that publishes statistics while they have subscribers."""
        while not self._closing.wait(self.params.stats_every):
            if publisher.is_subscribed(STATS_TOPIC, by_name=True):
                statistics = {"sensor": self._sensor, **control.snapshot()}
                # The counters of a user's sink may be NumPy numbers.
                publisher.send(STATS_TOPIC + orjson.dumps(statistics, option=orjson.OPT_SERIALIZE_NUMPY))

    def close(self) -> None:
        """Deliver pending messages for at most `linger` seconds, and free the addresses."""
        if self._commands is not None:
            self._commands.close()
            self._commands = None
        self._closing.set()
        if self._stats_thread is not None:
            self._stats_thread.join()
        if self._publisher is not None:
            self._publisher.close(self.params.linger)
