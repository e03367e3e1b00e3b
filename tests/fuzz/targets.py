"""The parsers, and valid samples for each."""

from __future__ import annotations

import asyncio
import io
import secrets
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import NamedTuple, cast

import cv2
import numpy as np
import zmq
from mcap.writer import CompressionType, Writer
from websockets.asyncio.server import ServerConnection

from tactflow.calibration.file import Calibration, ScaleEntry
from tactflow.cli import listen
from tactflow.config.load import load_pipeline
from tactflow.engine.errors import TactflowError
from tactflow.engine.frame import Frame, Tick
from tactflow.message.result import Result, encode_message
from tactflow.recording.frames import RawFrame, encode_frame
from tactflow.recording.records import NotARecordingError
from tactflow.recording.repair import repair
from tactflow.recording.schemas import channel_type
from tactflow.recording.writer import Entry, RecordingWriter
from tactflow.sinks.zmq import Zmq
from tactflow.sources import open_source
from tactflow.view.hub import Hub
from tactflow.vision.types import Contact, Flow, Markers, Scale
from tests.adapters.bags import TOPIC, write_bag, write_foxglove
from tests.adapters.test_datasets import KEY, write_lerobot
from tests.conftest import REPOSITORY
from tests.messages import Results, result_of

IMAGE = np.random.default_rng(1).integers(0, 256, (12, 16, 3), np.uint8)
FRAMES = 20
"""Frames of an input that are read at most."""


FileParser = tuple[Sequence[bytes], Callable[[Path], object]]
"""Samples of a file, and what reads it."""


class Parser(NamedTuple):
    """What is to be fed. refusals : how it says no."""

    samples: Sequence[bytes]
    feed: Callable[[bytes], object]
    refusals: tuple[type[Exception], ...] = (TactflowError,)


def play(spec: str) -> None:
    """Read the first frames of a source."""
    source = open_source(spec)
    try:
        for _ in range(FRAMES):
            if source.read() is None:
                break
    finally:
        source.close()


def pipelines(_: Path) -> FileParser:
    """A pipeline file, read and checked."""
    files = [REPOSITORY / "pipeline.yaml", *sorted((REPOSITORY / "pipelines").glob("*.yaml"))]
    samples = [file.read_bytes() for file in files]
    several = b"sensors: {left: {stages.capture.source: sim:press}, right: {}}\n"
    return [*samples, several + samples[0]], load_pipeline


def recordings(folder: Path) -> FileParser:
    """An .mcap file: played, played from the middle, and repaired."""
    samples = [_recording(folder / "sample.mcap", finished=finished) for finished in (True, False)]
    samples += [_recording_of_others(packing) for packing in CompressionType]

    def read(path: Path) -> None:
        with suppress(NotARecordingError):
            repair(path, folder / "out.mcap")
        with suppress(TactflowError):
            play(f"{path}?start=0.1")
        play(str(path))

    return samples, read


def _recording(path: Path, *, finished: bool) -> bytes:
    writer = RecordingWriter(path, "main", overwrite=True)
    for seq in range(4):
        data = {"frames": encode_frame(Frame("main", seq, seq / 10, IMAGE, reference=seq == 0))}
        writer.write(Entry(round(seq * 1e8), seq, seq == 0, 0, {**data, "results": b"{}"}))
    (writer.finish if finished else writer.close)()
    return path.read_bytes()


def _recording_of_others(packing: CompressionType) -> bytes:
    """Frames of ours, in a file as other writers make them."""
    file = io.BytesIO()
    writer = Writer(file, chunk_size=1024, compression=packing)
    writer.start()
    kind = channel_type(RawFrame)
    channel = writer.register_channel(
        "/main/frames", "protobuf", writer.register_schema(kind.name, *kind.schema)
    )
    for seq in range(4):
        data = encode_frame(Frame("main", seq, seq / 10, IMAGE))
        writer.add_message(channel, round(seq * 1e8), data, round(seq * 1e8), seq)
    writer.finish()
    return file.getvalue()


def arrays(_: Path) -> FileParser:
    """A .npy file."""
    samples = []
    for array in (IMAGE[None], IMAGE[None, :, :, 0], IMAGE[None].astype(np.uint16), IMAGE[None, :, ::-1]):
        np.save(file := io.BytesIO(), array)
        samples.append(file.getvalue())
    np.savez(file := io.BytesIO(), IMAGE)
    return [*samples, file.getvalue()], lambda path: play(str(path))


def pictures(_: Path) -> FileParser:
    """A picture of any kind."""
    large = np.tile(IMAGE, (6, 6, 1))
    kinds = [(large, kind) for kind in (".png", ".jpg", ".bmp", ".tiff", ".webp", ".ppm", ".jp2")]
    kinds += [(IMAGE[:, :, 0], kind) for kind in (".png", ".pgm", ".tiff")]
    kinds.append((IMAGE.astype(np.uint16) * 257, ".png"))
    return [cv2.imencode(kind, image)[1].tobytes() for image, kind in kinds], lambda path: play(str(path))


def videos(folder: Path) -> FileParser:
    """A video file, which FFmpeg reads."""
    samples = []
    for name, code in (("a.avi", "MJPG"), ("b.mp4", "mp4v")):
        writer = cv2.VideoWriter(str(folder / name), cv2.VideoWriter.fourcc(*code), 30, (64, 48))
        for shade in range(4):
            writer.write(np.full((48, 64, 3), shade, np.uint8))
        writer.release()
        samples.append((folder / name).read_bytes())
    return [sample for sample in samples if sample], lambda path: play(str(path))


def bags(folder: Path) -> FileParser:
    """Recordings of ROS and Foxglove: .mcap, .bag, .db3."""
    from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage

    png = CompressedImage(format="png", data=cv2.imencode(".png", IMAGE)[1].tobytes())
    text = b'{"timestamp": {"sec": 1, "nsec": 2}, "data": "QQ=="}'
    files = [
        write_bag(folder / "one.bag", [IMAGE, IMAGE], "ros1"),
        next(write_bag(folder / "two", [IMAGE, IMAGE], "sqlite3").glob("*.db3")),
        next(write_bag(folder / "three", [IMAGE, IMAGE], "mcap", "jpeg").glob("*.mcap")),
        write_foxglove(folder / "four.mcap", [png], "protobuf"),
        write_foxglove(folder / "five.mcap", [text], "json"),
    ]
    suffixes = {file.read_bytes()[:4]: file.suffix for file in files}

    def read(path: Path) -> None:
        suffix = suffixes.get(path.read_bytes()[:4], ".mcap")
        play(f"{path.rename(path.with_suffix(suffix))}?topic={TOPIC}")

    return [file.read_bytes() for file in files], read


def lerobot(folder: Path) -> FileParser:
    """What a LeRobot dataset says of itself."""
    root = write_lerobot(folder / "press", np.zeros((5, 48, 64, 3), np.uint8), "v3.0", "image")
    info = root / "meta" / "info.json"

    def read(path: Path) -> None:
        path.replace(info)
        play(f"lerobot:{root}?camera={KEY}&episode=1")

    return [info.read_bytes()], read


def calibrations(folder: Path) -> FileParser:
    """A calibration: its YAML, or the arrays beside it."""
    file = folder / "left.yaml"
    known = {
        "sensor": "left",
        "made_from": "sim:press",
        "raw_size": (16, 12),
        "size": (16, 12),
        "corners": [(0.0, 0.0)] * 4,
        "scale": ScaleEntry.of(Scale(0.05, 0.05, (0.001, 0.001), (0.0, 0.0)), "pitch"),
        "look": np.zeros((12, 16, 3), np.float32),
    }
    Calibration.model_validate(known).save(file)
    text, npz = file.read_bytes(), file.with_suffix(".npz").read_bytes()

    def read(path: Path) -> None:
        data = path.read_bytes()
        file.write_bytes(text if data[:1] == b"Z" else data)
        file.with_suffix(".npz").write_bytes(data[1:] if data[:1] == b"Z" else npz)
        Calibration.load(file)

    return [text, b"Z" + npz], read


@contextmanager
def of_file(make: Callable[[Path], FileParser], suffix: str, folder: Path) -> Iterator[Parser]:
    """A parser of a file of a kind."""
    samples, read = make(folder)

    def feed(data: bytes) -> None:
        path = folder / f"input{suffix}"
        path.write_bytes(data)
        read(path)

    yield Parser(samples, feed)


@contextmanager
def overrides(_: Path) -> Iterator[Parser]:
    """What `--set` takes."""
    samples = [
        b"stages.hull=null",
        b"sinks.zmq.endpoint=tcp://127.0.0.1:*",
        b"sinks.images={in: {annotated: [1, 2]}, folder: &a out, overwrite: true}",
        b"sensors.left.stages.capture.source=sim:press",
    ]
    file = REPOSITORY / "pipeline.yaml"
    yield Parser(samples, lambda data: load_pipeline(file, [data.decode("utf-8", "surrogateescape")]))


def message() -> bytes:
    """A result message."""
    contact = Contact(12.5, (3.0, 4.0), 30.0, -0.577, np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0]]), None)
    markers = Markers(np.zeros((2, 2)), np.ones((2, 2)), np.array([0, 2], np.uint8), np.ones(2))
    results = Results(IMAGE, contact, Flow((1.0, -1.0), 2), markers)
    return encode_message(result_of(Tick(Frame("main", 3, 0.1, IMAGE)), results))


@contextmanager
def messages(_: Path) -> Iterator[Parser]:
    """A result message, as a Subscriber and `listen` take it."""
    nothing = Tick(Frame("main", 4, 0.1, IMAGE), skipped={"contact": "no_contact"})

    def feed(data: bytes) -> None:
        result = Result.from_message(data)
        listen.describe(result)

    samples = [message(), encode_message(result_of(nothing, Results(IMAGE)))]
    yield Parser(samples, feed, (TactflowError, ValueError))


@contextmanager
def subscriptions(_: Path) -> Iterator[Parser]:
    """What a subscriber sends to a publisher."""
    sink = Zmq(Zmq.Params(endpoint="tcp://127.0.0.1:*", linger=0))
    sink.open()
    result = result_of(Tick(Frame("main", 0, 0.0, IMAGE)), Results(IMAGE))
    with zmq.Context() as context, context.socket(zmq.XSUB) as subscriber:
        subscriber.linger = 0
        subscriber.connect(sink.endpoint)

        def feed(data: bytes) -> None:
            subscriber.send(data)
            sink.wants()
            sink.write(result)

        yield Parser([b"\x01tactflow.main ", b"\x00tactflow.main ", b"\x02", b"\x01" + bytes(299)], feed)
    sink.close()


class OneMessage:
    """A connection to the page over which one message comes."""

    def __init__(self, text: str) -> None:
        self._texts = [text]

    async def send(self, data: str | bytes) -> None: ...

    async def close(self, code: int, reason: str) -> None: ...

    async def recv(self) -> str:
        if not self._texts:
            raise EOFError
        return self._texts.pop()


@contextmanager
def commands(_: Path) -> Iterator[Parser]:
    """What a page asks for."""
    samples = [
        b'{"ack": 1, "late": false, "rest": 50}',
        b'{"do": "pause", "value": true}',
        b'{"show": ["surface", "field"]}',
        b'{"do": "record", "value": [1, {"a": null}]}',
    ]

    def feed(data: bytes) -> None:
        hub = Hub(None, "main")
        hub.run_id = secrets.token_hex(1)
        asyncio.run(hub.serve(cast(ServerConnection, OneMessage(data.decode("utf-8", "replace")))))

    yield Parser(samples, feed)


# No HDF5: its library hangs on some damaged files, as docs/security.md says.
FILES = {
    pipelines: ".yaml",
    recordings: ".mcap",
    arrays: ".npy",
    pictures: ".png",
    videos: ".mp4",
    bags: ".mcap",
    lerobot: ".json",
    calibrations: ".yaml",
}
TARGETS: dict[str, Callable[[Path], AbstractContextManager[Parser]]] = {
    **{make.__name__: partial(of_file, make, suffix) for make, suffix in FILES.items()},
    **{make.__name__: make for make in (overrides, messages, subscriptions, commands)},
}
