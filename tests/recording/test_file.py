"""The recorded file, read by programs that are not ours: the mcap library, protobuf, JSON Schema."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import jsonschema
import numpy as np
import pytest
import yaml
import zstandard
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.PointsAnnotation_pb2 import PointsAnnotation
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from tactflow.cli.main import main
from tactflow.config.load import load_pipeline
from tactflow.engine.frame import Frame
from tactflow.engine.run import Runner
from tactflow.message.result import Result
from tactflow.message.schema import message_schema
from tactflow.recording.frames import RawFrame, decode_pixels, encode_frame, parse_frame
from tactflow.recording.schemas import encode_annotations, plain_schema
from tactflow.sinks.record import Record
from tactflow.vision.types import Contact, Ellipse, Flow
from tests.messages import CONTACT, MARKERS

PIPELINE = """\
sensor: left    # a comment
stages:
  capture: {source: "sim:press?frames=20"}
sinks:
  record: {path: PATH, preview: 30}
"""


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recording")
    file = folder / "pipeline.yaml"
    file.write_text(PIPELINE.replace("PATH", str(folder / "a.mcap")))
    pipeline = load_pipeline(file, overrides=["stages.capture.source=sim:press?frames=12"])
    assert Runner(pipeline).run().exit_code == 0
    return folder / "a.mcap"


def test_pictures_are_foxglove_compressed_images(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with recording.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        found = list(reader.iter_decoded_messages("/left/image"))
        topics = {channel.topic for channel in reader.get_summary().channels.values()}
    assert main(["schema", "foxglove-layout", "--sensor", "left"]) == 0
    shown = set(re.findall(r"/left/\w+", json.dumps(json.loads(capsys.readouterr().out))))
    assert len(shown) == 3
    assert shown <= topics
    assert len(found) >= 4
    for schema, channel, message, picture in found:
        assert schema is not None
        assert (schema.name, schema.encoding) == ("foxglove.CompressedImage", "protobuf")
        assert channel.message_encoding == "protobuf"
        assert (picture.format, picture.frame_id) == ("jpeg", "left")
        assert picture.timestamp.seconds * 10**9 + picture.timestamp.nanos == message.log_time
        pixels = cv2.imdecode(np.frombuffer(picture.data, np.uint8), cv2.IMREAD_COLOR)
        assert pixels is not None
        assert pixels.shape == (600, 800, 3)


def test_annotations_of_foxglove_lie_on_contact_and_dots_counted_from_the_corner_of_a_pixel() -> None:
    tracked = replace(MARKERS, status=np.array([0, 1, 2], np.uint8))
    two = replace(CONTACT, separate=(CONTACT, replace(CONTACT, hull=CONTACT.hull + 100)))
    frame = Frame("main", 0, 0.0, np.zeros((4, 6, 3), np.uint8))
    encoded = encode_annotations(Result(frame, {"contact": two, "markers": tracked}), 1_500_000_000)
    read = ImageAnnotations.FromString(encoded)
    assert (read.timestamp.seconds, read.timestamp.nanos) == (1, 500_000_000)
    places = [(part.type, np.array([(point.x, point.y) for point in part.points])) for part in read.points]
    outlines = [points for kind, points in places if kind == PointsAnnotation.LINE_LOOP]
    assert np.array_equal(outlines, [CONTACT.hull + 0.5, CONTACT.hull + 100.5])
    dots = np.concatenate([points for kind, points in places if kind == PointsAnnotation.POINTS])
    assert np.array_equal(dots, MARKERS.position + 0.5)
    (arrows,) = [points for kind, points in places if kind == PointsAnnotation.LINE_LIST]
    tails, tips = arrows[::6], arrows[1::6]
    assert np.array_equal(tails, MARKERS.origin[:2] + 0.5)
    assert np.allclose(tips - tails, 3 * MARKERS.displacement[:2])


def test_raw_frames_can_be_unpacked_by_anybody_from_the_schema_in_the_file(recording: Path) -> None:
    zstandard = pytest.importorskip("zstandard")
    with recording.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        found = list(reader.iter_decoded_messages(["/left/frames", "/left/references"]))
    assert [message.sequence for _, _, message, _ in found] == list(range(12))
    for _, _, message, frame in found:
        assert (frame.width, frame.height, frame.encoding, frame.codec) == (800, 600, "bgr8", "up+zstd")
        assert frame.reference == (frame.seq == 0)
        rows = np.frombuffer(zstandard.decompress(frame.data), np.uint8).reshape(600, 800, 3)
        pixels = np.add.accumulate(rows, axis=0, dtype=np.uint8)
        np.testing.assert_array_equal(pixels, decode_pixels(parse_frame(message.data)))
        assert parse_frame(message.data).t == frame.t == frame.seq / 60


def test_the_file_says_how_it_was_made(recording: Path, tmp_path: Path) -> None:
    with recording.open("rb") as file:
        reader = make_reader(file)
        texts = {item.name: item.data.decode() for item in reader.iter_attachments()}
        (facts,) = (item.metadata for item in reader.iter_metadata() if item.name == "tactflow")
    assert {"tactflow", "numpy", "opencv", "python"} <= set(facts)
    assert facts["opencv"] == cv2.__version__
    settings = yaml.safe_load(texts["pipeline.yaml"])
    assert settings["stages"]["capture"]["source"] == "sim:press?frames=12"
    assert settings["sensor"] == "left"
    again = tmp_path / "again.yaml"
    again.write_text(texts["pipeline.yaml"])
    assert load_pipeline(again).sensor == "left"
    assert json.loads(texts["message.schema.json"]) == message_schema()


def test_results_are_valid_under_the_schema_in_the_file(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    sink = Record(Record.Params(path=str(path)))
    sink.open()
    contact = Contact(4.0, (1.0, 1.0), 10.0, -0.2, np.eye(3, 2), Ellipse((1.0, 1.0), (3.0, 2.0), 10.0), 0.5)
    pixels = np.zeros((3, 4, 3), np.uint8)
    sink.write(Result(Frame("main", 0, 0.0, pixels), {"contact": contact, "flow": Flow((1.0, 2.0), 3)}))
    sink.close()
    with path.open("rb") as file:
        ((schema, channel, message),) = make_reader(file).iter_messages("/main/results")
    assert schema is not None
    assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
    plain = json.loads(schema.data)
    result = json.loads(message.data)
    jsonschema.validate(result, message_schema())
    # The schema for plotting programs does not know null: they look at fields that have a value.
    jsonschema.validate(without_nulls(result), plain)


def test_the_schema_for_plots_has_one_type_everywhere_and_no_references() -> None:
    plain = plain_schema(message_schema())
    text = json.dumps(plain)
    assert not [key for key in ("$ref", "$defs", "anyOf", "prefixItems", "const") if f'"{key}"' in text]
    assert plain["properties"]["contact"]["properties"]["area"]["type"] == "number"
    assert plain["properties"]["markers"]["properties"]["position"]["items"]["items"]["type"] == "number"


def without_nulls(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: without_nulls(item) for key, item in value.items() if item is not None}
    return value


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (7, 1), (480, 640)])
def test_pixels_come_back_whatever_the_size_and_also_of_a_view(shape: tuple[int, int]) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (*shape, 3), np.uint8)
    for pixels in (noise, np.full((*shape, 3), 255, np.uint8), np.repeat(noise, 2, axis=1)[::-1, ::2]):
        stored = parse_frame(encode_frame(Frame("main", 3, 0.1, pixels, epoch=2)))
        np.testing.assert_array_equal(decode_pixels(stored), pixels)
        assert (stored.seq, stored.t, stored.epoch, stored.reference) == (3, 0.1, 2, False)


def test_a_frame_that_is_damaged_or_of_another_kind_is_refused() -> None:
    packed = encode_frame(Frame("main", 0, 0.0, np.full((9, 9, 3), 7, np.uint8)))
    with pytest.raises(ValueError, match="damaged"):
        decode_pixels(parse_frame(packed[:-1] + bytes([packed[-1] ^ 1])))
    for name, value in (("t", float("nan")), ("t", 1e300), ("codec", "other"), ("encoding", "")):
        changed = RawFrame.FromString(packed)
        setattr(changed, name, value)
        with pytest.raises(ValueError, match="required"):
            parse_frame(changed.SerializeToString())
    with pytest.raises(ValueError, match=r"not a tactflow\.RawFrame"):
        parse_frame(b"\xff" * 20)
    for size, packed_bytes, message in ((1 << 16, 100, "65536 x 65536"), (4, 64 << 20, "required 48 bytes")):
        with pytest.raises(ValueError, match=message):
            decode_pixels(RawFrame(width=size, height=size, data=zstandard.compress(bytes(packed_bytes))))
