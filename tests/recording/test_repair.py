"""Recordings that were cut off or damaged: everything intact comes back, bit for bit."""

from __future__ import annotations

import struct
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import lz4.frame
import pytest
import zstandard
from mcap.reader import make_reader

from tactflow.engine.errors import SourceError
from tactflow.recording.records import MAX_CHUNK_BYTES
from tactflow.recording.repair import repair
from tactflow.sources import open_source
from tests.recording.test_recorder import opened, seqs_in, write


def record(path: Path, count: int) -> bytes:
    sink = opened(path, preview=0)
    write(sink, range(count))
    sink.close()
    return path.read_bytes()


def test_wherever_a_file_is_cut_whole_frames_come_back(tmp_path: Path) -> None:
    data = record(tmp_path / "a.mcap", 5)
    cut, fixed = tmp_path / "cut.mcap", tmp_path / "fixed.mcap"
    counts = []
    for length in range(8, len(data), 97):
        cut.write_bytes(data[:length])
        result = repair(cut, fixed)
        with fixed.open("rb") as file:
            again = list(make_reader(file, validate_crcs=True).iter_messages())
        assert len(again) == result.messages
        assert not result.finished
        # A frame and its message lie in one chunk.
        count = len(again) // 2
        if count:
            assert seqs_in(cut) == seqs_in(fixed) == list(range(count))
        else:
            with pytest.raises(SourceError, match="no frame"):
                open_source(str(cut))
        counts.append(count)
    assert counts == sorted(counts)
    assert set(counts) == set(range(6))


def test_one_wrong_bit_costs_few_frames_wherever_it_lies(tmp_path: Path) -> None:
    count = 6
    data = record(tmp_path / "a.mcap", count)
    flipped, fixed = tmp_path / "flipped.mcap", tmp_path / "fixed.mcap"
    lost = []
    for place in range(8, len(data), 211):
        changed = bytearray(data)
        changed[place] ^= 1 << (place % 8)
        flipped.write_bytes(changed)
        repair(flipped, fixed)
        assert flipped.read_bytes() == changed
        lost.append(count - len(seqs_in(fixed)))
    # In its data, it costs the frame; in the length of a record, reading goes on at a later frame.
    assert max(lost) <= 2


@pytest.mark.parametrize("finished", [True, False])
def test_damage_in_the_middle_is_reported(tmp_path: Path, finished: bool) -> None:
    path = tmp_path / "a.mcap"
    data = bytearray(record(path, 40))
    # Behind the schemas, which the first chunk holds, and before the last frames.
    data[60_000] ^= 0xFF
    path.write_bytes(data if finished else data[:-300])
    with pytest.raises(SourceError, match=r"is damaged .*tactflow repair keeps all that is intact"):
        seqs_in(path)


def chunk(data: bytes, compression: str, size: int) -> bytes:
    """One chunk of an MCAP file."""
    name = compression.encode()
    beginning = struct.pack("<QQQII", 0, 0, size, 0, len(name)) + name
    body = beginning + struct.pack("<Q", len(data)) + data
    return struct.pack("<BQ", 6, len(body)) + body


@pytest.mark.parametrize(
    ("data", "compression", "size"),
    [
        (zstandard.compress(bytes(100)), "zstd", 1 << 60),
        (b"no such thing", "zstd", 100),
        (b"no such thing", "lz4", 100),
        (bytes(range(1, 101)), "", 100),
        (b"unknown", "brotli", 100),
    ],
    ids=["absurd size", "garbage", "lz4 garbage", "plain garbage", "unknown compression"],
)
def test_a_chunk_that_cannot_be_unpacked_is_passed_over(
    tmp_path: Path, data: bytes, compression: str, size: int
) -> None:
    path, fixed = tmp_path / "a.mcap", tmp_path / "fixed.mcap"
    whole = record(path, 3)
    path.write_bytes(whole[:8] + chunk(data, compression, size) + whole[8:])
    result = repair(path, fixed)
    assert not result.finished
    assert seqs_in(fixed) == [0, 1, 2]


@pytest.mark.parametrize(
    ("compress", "compression"), [(zstandard.compress, "zstd"), (lz4.frame.compress, "lz4")]
)
def test_a_chunk_that_states_too_many_bytes_is_not_unpacked(
    tmp_path: Path, compress: Callable[[bytes], bytes], compression: str
) -> None:
    path = tmp_path / "a.mcap"
    whole = record(path, 1)
    size = MAX_CHUNK_BYTES + 1
    path.write_bytes(whole[:8] + chunk(compress(bytes(size)), compression, size) + whole[8:])
    tracemalloc.start()
    try:
        assert repair(path, tmp_path / "fixed.mcap").lost
        assert tracemalloc.get_traced_memory()[1] < MAX_CHUNK_BYTES // 8
    finally:
        tracemalloc.stop()
