"""Damaged input to every parser of untrusted data, and well-formed input with any values.

A parser may refuse its input, but not fail. The input that failed is in the test's temporary folder.
"""

from __future__ import annotations

import copy
import io
import json
import random
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tactflow.cli import listen
from tactflow.config.load import load_pipeline
from tactflow.engine.errors import ConfigError, SourceError, TactflowError
from tactflow.engine.frame import Frame, Tick
from tactflow.message.result import Result, encode_message
from tactflow.recording.frames import encode_frame
from tactflow.recording.records import NotARecordingError
from tactflow.recording.repair import repair
from tactflow.recording.writer import Entry, RecordingWriter
from tactflow.sources import open_source
from tactflow.vision.types import Contact, Flow, Markers
from tests.messages import Results, result_of
from tests.paths import REPOSITORY

IMAGE = np.random.default_rng(1).integers(0, 256, (12, 16, 3), np.uint8)
BORDERS = (0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0x8000, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF, 1 << 62, (1 << 64) - 1)
"""Numbers at which lengths and counts overflow."""
Parser = tuple[Sequence[bytes], str, Callable[[Path], object]]
"""Valid samples of a file, its suffix, and what reads it."""


def play(spec: str | Path) -> None:
    """Read the first frames of a source."""
    with closing(open_source(str(spec))) as source:
        for _ in range(20):
            if source.read() is None:
                break


def pipelines(_: Path) -> Parser:
    files = [REPOSITORY / "pipeline.yaml", *sorted((REPOSITORY / "pipelines").glob("*.yaml"))]
    several = b"sensors: {left: {stages.capture.source: sim:press}, right: {}}\n"
    samples = [file.read_bytes() for file in files]
    return [*samples, several + samples[0]], ".yaml", load_pipeline


def recordings(folder: Path) -> Parser:
    """Recordings, finished or not: played, played from the middle, and repaired."""
    samples = []
    for end in (RecordingWriter.finish, RecordingWriter.close):
        writer = RecordingWriter(folder / "sample.mcap", "main", overwrite=True)
        for seq in range(4):
            data = {"frames": encode_frame(Frame("main", seq, seq / 10, IMAGE, reference=seq == 0))}
            writer.write(Entry(round(seq * 1e8), seq, seq == 0, 0, {**data, "results": b"{}"}))
        end(writer)
        samples.append((folder / "sample.mcap").read_bytes())

    def read(path: Path) -> None:
        with suppress(NotARecordingError):
            repair(path, folder / "out.mcap")
        with suppress(TactflowError):
            play(f"{path}?start=0.1")
        play(path)

    return samples, ".mcap", read


def arrays(_: Path) -> Parser:
    samples = []
    for array in (IMAGE[None], IMAGE[None, :, :, 0], IMAGE[None].astype(np.uint16)):
        np.save(file := io.BytesIO(), array)
        samples.append(file.getvalue())
    return samples, ".npy", play


def pictures(_: Path) -> Parser:
    kinds = (".png", ".jpg", ".bmp", ".tiff", ".webp", ".ppm", ".jp2")
    return [cv2.imencode(kind, np.tile(IMAGE, (6, 6, 1)))[1].tobytes() for kind in kinds], ".png", play


def bags(folder: Path) -> Parser:
    """A recording of ROS."""
    pytest.importorskip("rosbags", reason="the extra bags is not installed")
    from plugins.rosbags.tests.bags import TOPIC, write_bag

    file = write_bag(folder / "sample.bag", [IMAGE, IMAGE], "ros1")
    return [file.read_bytes()], ".bag", lambda path: play(f"{path}?topic={TOPIC}")


def tables(folder: Path) -> Parser:
    """Pictures in a column of Parquet."""
    pa = pytest.importorskip("pyarrow", reason="the extra parquet is not installed")
    import pyarrow.parquet as pq

    file = cv2.imencode(".png", IMAGE)[1].tobytes()
    for name, column in (("bytes", [file] * 3), ("struct", [{"bytes": file, "path": "0.png"}] * 3)):
        pq.write_table(pa.table({"image": column}), folder / name)
    return [(folder / name).read_bytes() for name in ("bytes", "struct")], ".parquet", play


def message() -> bytes:
    """A result message."""
    contact = Contact(12.5, (3.0, 4.0), 30.0, -0.577, np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0]]), None)
    markers = Markers(np.zeros((2, 2)), np.ones((2, 2)), np.array([0, 2], np.uint8), np.ones(2))
    results = Results(IMAGE, contact, Flow((1.0, -1.0), 2), markers)
    return encode_message(result_of(Tick(Frame("main", 3, 0.1, IMAGE)), results))


def messages(_: Path) -> Parser:
    """A result message, as a Subscriber and `listen` take it."""
    return [message()], ".json", lambda path: listen.describe(Result.from_message(path.read_bytes()))


def damage(data: bytes, rng: random.Random) -> bytes:
    """Damage valid bytes in a few places, half of them near the beginning, where headers are."""
    damaged = bytearray(data)
    for _ in range(rng.randint(1, 6)):
        size = len(damaged) if rng.random() < 0.5 else min(len(damaged), 128)
        start, length = rng.randrange(size or 1), rng.choice((1, 2, 4, 8, 64))
        number = rng.choice(BORDERS).to_bytes(8, rng.choice(("little", "big")))
        damaged[start : start + length] = rng.choice((b"", rng.randbytes(length), number, number[:4]))
    return bytes(damaged[: rng.randrange(len(damaged) + 1)]) if rng.random() < 0.1 else bytes(damaged)


@pytest.mark.parametrize("make", [pipelines, recordings, arrays, pictures, bags, tables, messages])
@pytest.mark.parametrize("inputs", [40, pytest.param(3000, marks=pytest.mark.slow)])
def test_damaged_input_is_refused(make: Callable[[Path], Parser], inputs: int, tmp_path: Path) -> None:
    samples, suffix, read = make(tmp_path)
    refusals = ValueError if make is messages else TactflowError
    rng, refused = random.Random(1), 0
    for data in [*samples, *(damage(rng.choice(samples), rng) for _ in range(inputs))]:
        path = tmp_path / f"input{suffix}"
        path.write_bytes(data)
        try:
            read(path)
        except refusals:
            refused += 1
    assert refused


few = settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
scalars = (
    st.none() | st.booleans() | st.integers(-(2**63), 2**63 - 1) | st.floats(allow_nan=False) | st.text()
)
values = st.recursive(
    scalars, lambda part: st.lists(part, max_size=3) | st.dictionaries(st.text(), part, max_size=3)
)
PIPELINE = yaml.safe_load((REPOSITORY / "pipeline.yaml").read_text(encoding="utf-8"))


def places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """The path to everything in a document."""
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [*([path] if path else []), *(deep for key, part in inner for deep in places(part, (*path, key)))]


def replaced(document: Any, path: tuple[Any, ...], value: Any) -> Any:
    """A copy with another value at one place."""
    changed = copy.deepcopy(document)
    part = changed
    for key in path[:-1]:
        part = part[key]
    part[path[-1]] = value
    return changed


@few
@given(path=st.sampled_from(places(PIPELINE)), value=values)
def test_a_pipeline_with_any_value_anywhere_is_read_or_refused(
    tmp_path: Path, path: tuple[Any, ...], value: Any
) -> None:
    file = tmp_path / "pipeline.yaml"
    file.write_text(json.dumps(replaced(PIPELINE, path, value)), encoding="utf-8")
    with suppress(ConfigError):
        assert load_pipeline(file).nodes


@few
@given(path=st.sampled_from(places(json.loads(message()))), value=values)
def test_a_result_message_with_any_value_anywhere_is_shown_or_passed_over(
    path: tuple[Any, ...], value: Any
) -> None:
    changed = json.dumps(replaced(json.loads(message()), path, value))
    try:
        result = Result.from_message(changed)
    except ValueError:
        return
    assert listen.describe(result)


@few
@given(options=st.text(st.characters(codec="utf-8"), max_size=20))
@pytest.mark.parametrize("source", ["sim:press?", "sim:", "press.mcap?", "*.png?", "[", "**/"])
def test_a_source_with_any_options_is_opened_or_refused(tmp_path: Path, source: str, options: str) -> None:
    spec = source + options if source.startswith("sim:") else f"{tmp_path}/{source}{options.replace('/', '')}"
    with suppress(SourceError):
        open_source(spec).close()
