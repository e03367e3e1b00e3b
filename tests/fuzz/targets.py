"""The parsers, and valid samples for each."""

from __future__ import annotations

import asyncio
import io
import json
import secrets
import socket
import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple, cast

import cv2
import numpy as np
from mcap.writer import CompressionType, Writer

from tactflow.adapters.bags import Bag
from tactflow.adapters.lerobot_source import LeRobotEpisode
from tactflow.calibration.file import Calibration
from tactflow.cli import explain, listen
from tactflow.cli.statistics import Statistics
from tactflow.config.load import load_pipeline
from tactflow.engine.errors import TactflowError
from tactflow.engine.frame import Frame, Tick
from tactflow.engine.plan import make_plan
from tactflow.message.result import Result, encode_message
from tactflow.network.commands import Commands
from tactflow.network.control_socket import ControlSocket
from tactflow.recording.frames import FrameCoder, RawFrame
from tactflow.recording.records import NotARecordingError
from tactflow.recording.repair import repair
from tactflow.recording.schemas import channel_type
from tactflow.recording.writer import Entry, RecordingWriter
from tactflow.sinks.zmq import Zmq
from tactflow.sources.base import FrameReader, Normaliser
from tactflow.sources.files import ArrayFile, VideoFile, read_image
from tactflow.sources.mcap import Recording
from tactflow.view.address import bind
from tactflow.view.hub import Hub, Wire
from tactflow.view.server import Server
from tactflow.vision.types import Contact, Flow, Markers, Scale
from tests.adapters.test_datasets import KEY, write_lerobot
from tests.conftest import REPOSITORY
from tests.messages import Results, result_of

IMAGE = np.random.default_rng(1).integers(0, 256, (12, 16, 3), np.uint8)
FRAMES = 20
"""Frames of an input that are read at most."""
ANSWER_SECONDS = 30.0
"""How long a server may take to answer, s. Nothing depends on its length."""


class Parser(NamedTuple):
    """What is to be fed. refusals : how it says no."""

    samples: Sequence[bytes]
    feed: Callable[[bytes], object]
    refusals: tuple[type[Exception], ...] = (TactflowError,)


def _read_all(reader: FrameReader) -> None:
    try:
        for _ in range(FRAMES):
            if reader.read() is None:
                break
    finally:
        reader.close()


@contextmanager
def pipelines(folder: Path) -> Iterator[Parser]:
    """A pipeline file, read and checked."""
    files = [REPOSITORY / "pipeline.yaml", *sorted((REPOSITORY / "pipelines").glob("*.yaml"))]
    several = b"sensors: {left: {stages.capture.source: sim:press}, right: {}}\n"
    samples = [file.read_bytes() for file in files]
    path = folder / "pipeline.yaml"

    def feed(data: bytes) -> None:
        path.write_bytes(data)
        load_pipeline(path)

    yield Parser([*samples, several + samples[0]], feed)


@contextmanager
def overrides(folder: Path) -> Iterator[Parser]:
    """What `--set` takes."""
    del folder
    samples = [
        b"stages.hull=null",
        b"sinks.zmq.endpoint=tcp://127.0.0.1:*",
        b"sinks.images={in: {annotated: [1, 2]}, folder: &a out, overwrite: true}",
        b"sensors.left.stages.capture.source=sim:press",
    ]

    def feed(data: bytes) -> None:
        load_pipeline(REPOSITORY / "pipeline.yaml", [data.decode("utf-8", "surrogateescape")])

    yield Parser(samples, feed)


@contextmanager
def recordings(folder: Path) -> Iterator[Parser]:
    """An .mcap file: played, played from the middle, and repaired."""
    path, out = folder / "press.mcap", folder / "out.mcap"
    samples = [_recording(folder / "sample.mcap", finished=finished) for finished in (True, False)]
    samples += [_other_recording(packing) for packing in CompressionType]

    def feed(data: bytes) -> None:
        path.write_bytes(data)
        refused: list[Exception] = []
        for spec in (str(path), f"{path}?start=0.1"):
            try:
                _read_all(Recording(spec))
            except TactflowError as error:
                refused.append(error)
        with suppress(NotARecordingError):
            repair(path, out)
        if refused:
            raise refused[0]

    yield Parser(samples, feed)


def _recording(path: Path, *, finished: bool) -> bytes:
    coder = FrameCoder()
    writer = RecordingWriter(path, "main", overwrite=True)
    for seq in range(4):
        frame = Frame("main", seq, seq / 10, IMAGE, reference=seq == 0)
        data = {"frames": coder.encode(frame), "results": b"{}"}
        writer.write(Entry(round(seq * 1e8), seq, seq == 0, 0, data))
    if finished:
        writer.finish()
    else:
        writer.close()
    return path.read_bytes()


def _other_recording(packing: CompressionType) -> bytes:
    """Frames of ours, in a file as other writers make them."""
    file = io.BytesIO()
    writer = Writer(file, chunk_size=1024, compression=packing)
    writer.start()
    kind = channel_type(RawFrame)
    schema = writer.register_schema(kind.name, *kind.schema)
    channel = writer.register_channel("/main/frames", "protobuf", schema)
    coder = FrameCoder()
    for seq in range(4):
        frame = Frame("main", seq, seq / 10, IMAGE)
        writer.add_message(channel, round(seq * 1e8), coder.encode(frame), round(seq * 1e8), seq)
    writer.finish()
    return file.getvalue()


@contextmanager
def arrays(folder: Path) -> Iterator[Parser]:
    """A .npy file."""
    path = folder / "press.npy"
    samples = []
    for array in (IMAGE[None], IMAGE[None, :, :, 0], IMAGE[None].astype(np.uint16), IMAGE[None, :, ::-1]):
        file = io.BytesIO()
        np.save(file, array)
        samples.append(file.getvalue())
    archive = io.BytesIO()
    np.savez(archive, IMAGE)
    samples.append(archive.getvalue())

    def feed(data: bytes) -> None:
        path.write_bytes(data)
        _read_all(ArrayFile(path))

    yield Parser(samples, feed)


@contextmanager
def pictures(folder: Path) -> Iterator[Parser]:
    """A picture of any kind."""
    path = folder / "press.png"
    kinds = (".png", ".jpg", ".bmp", ".tiff", ".webp", ".ppm", ".jp2")
    large = np.tile(IMAGE, (6, 6, 1))
    samples = [cv2.imencode(kind, large)[1].tobytes() for kind in kinds]
    samples += [cv2.imencode(kind, IMAGE[:, :, 0])[1].tobytes() for kind in (".png", ".pgm", ".tiff")]
    samples.append(cv2.imencode(".png", IMAGE.astype(np.uint16) * 257)[1].tobytes())

    def feed(data: bytes) -> None:
        path.write_bytes(data)
        Normaliser(str(path))(read_image(path))

    yield Parser(samples, feed)


@contextmanager
def videos(folder: Path) -> Iterator[Parser]:
    """A video file, which FFmpeg reads."""
    samples = []
    for name, code in (("a.avi", "MJPG"), ("b.mp4", "mp4v")):
        path = folder / name
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*code), 30, (64, 48))
        for shade in range(4):
            writer.write(np.full((48, 64, 3), shade, np.uint8))
        writer.release()
        samples.append(path.read_bytes())
    path = folder / "press.mp4"

    def feed(data: bytes) -> None:
        path.write_bytes(data)
        _read_all(VideoFile(path))

    yield Parser([sample for sample in samples if sample], feed)


@contextmanager
def bags(folder: Path) -> Iterator[Parser]:
    """Recordings of ROS and Foxglove: .mcap, .bag, .db3."""
    from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage

    from tests.adapters.bags import TOPIC, write_bag, write_foxglove

    png = CompressedImage(format="png", data=cv2.imencode(".png", IMAGE)[1].tobytes())
    files = [
        write_bag(folder / "one.bag", [IMAGE, IMAGE], "ros1"),
        next(write_bag(folder / "two", [IMAGE, IMAGE], "sqlite3").glob("*.db3")),
        next(write_bag(folder / "three", [IMAGE, IMAGE], "mcap", "jpeg").glob("*.mcap")),
        write_foxglove(folder / "four.mcap", [png], "protobuf"),
        write_foxglove(
            folder / "five.mcap", [b'{"timestamp": {"sec": 1, "nsec": 2}, "data": "QQ=="}'], "json"
        ),
    ]
    suffixes = {file.read_bytes()[:4]: file.suffix for file in files}

    def feed(data: bytes) -> None:
        path = folder / f"press{suffixes.get(data[:4], '.mcap')}"
        path.write_bytes(data)
        _read_all(Bag(f"{path}?topic={TOPIC}"))

    yield Parser([file.read_bytes() for file in files], feed)


@contextmanager
def lerobot(folder: Path) -> Iterator[Parser]:
    """What a LeRobot dataset says of itself."""
    root = write_lerobot(folder / "press", np.zeros((5, 48, 64, 3), np.uint8), "v3.0", "image")
    info = root / "meta" / "info.json"
    sample = info.read_bytes()

    def feed(data: bytes) -> None:
        info.write_bytes(data)
        _read_all(LeRobotEpisode(f"lerobot:{root}?camera={KEY}&episode=1"))

    yield Parser([sample], feed)


@contextmanager
def calibrations(folder: Path) -> Iterator[Parser]:
    """A calibration: its YAML, or the arrays beside it."""
    path = folder / "left.yaml"
    look = np.zeros((12, 16, 3), np.float32)
    scale = Scale(0.05, 0.05, (0.001, 0.001), (0.0, 0.0))
    known = Calibration("left", "sim:press", (16, 12), (16, 12), np.zeros((4, 2)), look, scale, "pitch")
    known.save(path)
    text, arrays = path.read_bytes(), path.with_suffix(".npz").read_bytes()

    def feed(data: bytes) -> None:
        path.write_bytes(text if data[:1] == b"Z" else data)
        path.with_suffix(".npz").write_bytes(data[1:] if data[:1] == b"Z" else arrays)
        Calibration.load(path)

    yield Parser([text, b"Z" + arrays], feed)


@contextmanager
def statistics(folder: Path) -> Iterator[Parser]:
    """A statistics file, as `explain` shows it."""
    path = folder / "run.json"
    node = {"runs": 3, "skips": {"no_contact": 2}, "p50_ms": 1.5, "p99_ms": 2.0, "total_ms": 4.5}
    sample = {
        "frames": 5,
        "dropped": 0,
        "wall_s": 1.0,
        "end": "eos",
        "latency_ms": {"p50": 1.0, "p99": None},
        "stages": {"capture": node, "hull": node, "preprocess": {**node, "runs": 0, "total_ms": None}},
        "sinks": {"zmq": node},
    }
    pipeline = load_pipeline(REPOSITORY / "pipeline.yaml")
    plan = make_plan(pipeline)

    def feed(data: bytes) -> None:
        path.write_bytes(data)
        list(explain.explanation(pipeline, plan, Statistics.read(path)))

    yield Parser([json.dumps(sample).encode()], feed)


def message() -> bytes:
    contact = Contact(12.5, (3.0, 4.0), 30.0, -0.577, np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0]]), None)
    markers = Markers(np.zeros((2, 2)), np.ones((2, 2)), np.array([0, 2], np.uint8), np.ones(2))
    flow = Flow((1.0, -1.0), 2)
    return encode_message(
        result_of(Tick(Frame("main", 3, 0.1, IMAGE)), Results(IMAGE, contact, flow, markers))
    )


@contextmanager
def messages(folder: Path) -> Iterator[Parser]:
    """A result message, as a Subscriber and `listen` take it."""
    del folder
    nothing = encode_message(
        result_of(Tick(Frame("main", 4, 0.1, IMAGE), skipped={"contact": "no_contact"}), Results(IMAGE))
    )

    def feed(data: bytes) -> None:
        with suppress(ValueError):
            result = Result.from_message(data)
            listen.describe(result)

    yield Parser([message(), nothing], feed)


GREETING = b"\xff" + bytes(7) + b"\x01\x7f\x03\x00" + b"NULL".ljust(20, b"\0") + bytes(32)
"""How a connection of ZMTP 3 begins (https://rfc.zeromq.org/spec/23/)."""
READY = b"\x05READY\x0bSocket-Type\x00\x00\x00\x03SUB\x08Identity\x00\x00\x00\x00"


def _short(flags: int, body: bytes) -> bytes:
    return bytes([flags, len(body)]) + body


@contextmanager
def subscriptions(folder: Path) -> Iterator[Parser]:
    """What a subscriber sends to a publisher, with or without the greeting of the protocol."""
    del folder
    sink = Zmq(Zmq.Params(endpoint="tcp://127.0.0.1:*", linger=0))
    sink.open()
    port = int(sink.endpoint.rpartition(":")[2])
    ready = _short(4, READY)
    samples = [
        ready + _short(0, b"\x01tactflow.main ") + _short(0, b"\x00tactflow.main "),
        ready + _short(4, b"\x09SUBSCRIBEtactflow.stats") + _short(4, b"\x06CANCELtactflow.stats"),
        ready + b"\x02" + (300).to_bytes(8, "big") + b"\x01" + bytes(299),
        ready + _short(4, b"\x04PING\x00\x0ahello"),
        ready + b"".join(_short(0, b"\x01tactflow.%d" % number) for number in range(50)),
        GREETING + ready,
    ]
    tick = Tick(Frame("main", 0, 0.0, IMAGE))

    def feed(data: bytes) -> None:
        _exchange(port, data, first=b"" if data.startswith(GREETING[:1]) else GREETING)
        sink.wants()
        sink.write(result_of(tick, Results(IMAGE)))

    try:
        yield Parser(samples, feed)
    finally:
        sink.close()


def _exchange(port: int, data: bytes, first: bytes = b"") -> bytes:
    """Send, and read until the other side ends the connection, or says nothing for a moment."""
    answer = b""
    with socket.create_connection(("127.0.0.1", port), ANSWER_SECONDS) as connection, suppress(OSError):
        if first:
            connection.sendall(first)
            answer = connection.recv(4096)
        connection.sendall(data)
        connection.shutdown(socket.SHUT_WR)
        connection.settimeout(0.02)
        while received := connection.recv(65536):
            answer = (answer + received)[:4096]
    return answer


@contextmanager
def _page() -> Iterator[int]:
    """The port of a running page."""
    listener = bind("127.0.0.1", 0)
    port = int(listener.getsockname()[1])
    server = Server(Hub(None, "main"), listener, "127.0.0.1", None)
    server.start()
    try:
        yield port
    finally:
        server.close()


def _expect_answer(port: int) -> None:
    """The server still does its work."""
    request = b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: close\r\n\r\n"
    with socket.create_connection(("127.0.0.1", port), ANSWER_SECONDS) as connection:
        connection.sendall(request)
        answer = connection.recv(64)
    assert answer.startswith(b"HTTP/1.1 200"), answer


@contextmanager
def requests(folder: Path) -> Iterator[Parser]:
    """HTTP requests to the page."""
    del folder
    samples = [
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
        b"GET /app.js?x=%2e%2e HTTP/1.1\r\nHost: localhost:8765\r\nAccept: */*\r\n\r\n",
        b"POST / HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 5\r\n\r\nhello",
        b"POST / HTTP/1.1\r\nHost: 127.0.0.1\r\nTransfer-Encoding: chunked\r\n\r\n5\r\nhello\r\n0\r\n\r\n",
        b"HEAD http://127.0.0.1/ HTTP/1.1\r\nHost: 127.0.0.1\r\nExpect: 100-continue\r\n\r\n",
        _upgrade(),
    ]
    with _page() as port:

        def feed(data: bytes) -> None:
            _exchange(port, data)
            _expect_answer(port)

        yield Parser(samples, feed)


def _upgrade() -> bytes:
    return (
        b"GET /live?token=abc HTTP/1.1\r\nHost: 127.0.0.1\r\nOrigin: http://127.0.0.1\r\n"
        b"Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
        b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
    )


def _masked(opcode: int, payload: bytes) -> bytes:
    key = b"\x01\x02\x03\x04"
    masked = bytes(byte ^ key[index % 4] for index, byte in enumerate(payload))
    size = bytes([0x80 | len(payload)]) if len(payload) < 126 else b"\xfe" + struct.pack(">H", len(payload))
    return bytes([0x80 | opcode]) + size + key + masked


COMMANDS = (
    b'{"ack": 1, "late": false, "rest": 50}',
    b'{"do": "pause", "value": true}',
    b'{"do": "step"}',
    b'{"show": ["surface", "field"]}',
    b'{"do": "record", "value": [1, {"a": null}]}',
)


@contextmanager
def websockets(folder: Path) -> Iterator[Parser]:
    """Frames of the page's WebSocket."""
    del folder
    samples = [_masked(1, command) for command in COMMANDS]
    samples += [_masked(9, b"ping"), _masked(8, b"\x03\xe8bye"), _masked(2, bytes(200)), _masked(0, b"x")]
    with _page() as port:

        def feed(data: bytes) -> None:
            _exchange(port, data, _upgrade())
            _expect_answer(port)

        yield Parser(samples, feed)


class OneMessage:
    """A connection over which one message comes."""

    def __init__(self, text: str) -> None:
        self._texts = [text]
        self.closed = False

    async def send_text(self, data: str) -> None: ...

    async def send_bytes(self, data: bytes) -> None: ...

    async def close(self, code: int, reason: str) -> None: ...

    async def receive_text(self) -> str:
        if not self._texts:
            raise EOFError
        return self._texts.pop()


@contextmanager
def commands(folder: Path) -> Iterator[Parser]:
    """What a page asks for."""
    del folder

    def feed(data: bytes) -> None:
        hub = Hub(None, "main")
        hub.run_id = secrets.token_hex(1)
        wire = OneMessage(data.decode("utf-8", "replace"))
        asyncio.run(hub.serve(cast(Wire, wire)))

    yield Parser(COMMANDS, feed)


@contextmanager
def orders(folder: Path) -> Iterator[Parser]:
    """What another program asks of a run."""
    del folder
    control = ControlSocket("tcp://127.0.0.1:*", None, "main", Commands(None))

    def feed(data: bytes) -> None:
        answer = json.loads(control._answer([data]))
        assert answer["message"]

    try:
        yield Parser([b'{"do": "ping"}', b'{"do": "record_start"}'], feed)
    finally:
        control.close()


# No HDF5: its library hangs on some damaged files, as docs/security.md says.
TARGETS: dict[str, Callable[[Path], AbstractContextManager[Parser]]] = {
    function.__name__: cast(Any, function)
    for function in (
        *(pipelines, overrides, recordings, arrays, pictures, videos, calibrations, statistics, messages),
        *(bags, lerobot, subscriptions, requests, websockets, commands, orders),
    )
}
