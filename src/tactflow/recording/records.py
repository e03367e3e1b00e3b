"""The records of an MCAP file one after the other, also of a damaged one and one that was cut off."""

from __future__ import annotations

import io
import struct
import zlib
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from typing import BinaryIO

import zstandard
from mcap.exceptions import McapError
from mcap.reader import SeekingReader
from mcap.records import (
    Attachment,
    Channel,
    Chunk,
    Footer,
    Header,
    McapRecord,
    Message,
    Metadata,
    Schema,
)
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.summary import Summary

DAMAGE = (
    *(McapError, struct.error, zstandard.ZstdError),
    *(ValueError, KeyError, OverflowError, RuntimeError, MemoryError),
)
"""What reading a damaged file raises: mcap's own errors and those of the packages that unpack chunks."""

MAGIC = b"\x89MCAP0\r\n"
"""How every MCAP file begins."""

LARGEST_CHUNK = 256 << 20
"""Bytes of an unpacked chunk, above which it counts as damaged: twice a raw picture of 8K."""
RECORD_HEAD = 9
"""Bytes of a record before its content: its kind and its length."""
MOST_RECORDS = 1_000_000
"""Records of a chunk, above which it counts as damaged: hours of a sensor's messages."""

_FOOTER = struct.Struct("<QQI")
"""Where the index begins, where its offsets do, and its checksum: the last bytes of a file before `MAGIC`."""
_PIECE = 1 << 20
"""Bytes that are read at once for a checksum."""

_DATA = (Attachment, Channel, Header, Message, Metadata, Schema)
"""All records outside of chunks but the index, which follows from the rest."""


class NotARecordingError(Exception):
    """The file is not an MCAP file, or holds no frames of ours."""


class ForeignRecordingError(NotARecordingError):
    """An MCAP file that another program has written."""


@dataclass(frozen=True, slots=True)
class Damage:
    """Bytes of the file, from `start` up to `end`, that belong to no intact record."""

    start: int
    end: int


def read_summary(file: BinaryIO) -> Summary | None:
    """The index at the end of the file, or None where it is damaged, cut off, or of another kind of file."""
    size = file.seek(0, io.SEEK_END)
    try:
        if not _index_is_intact(file, size):
            return None
        file.seek(0)
        return SeekingReader(file, record_size_limit=size).get_summary()
    except (*DAMAGE, OSError):
        # The file is shorter than a footer, or does not end with one.
        return None


def _index_is_intact(file: BinaryIO, size: int) -> bool:
    """Whether the index has the checksum that the footer states, where it states one.

    size : of the file, bytes. Raises OSError, ValueError or struct.error if the file is shorter.
    """
    file.seek(size - _FOOTER.size - len(MAGIC))
    start, _, checksum = _FOOTER.unpack(file.read(_FOOTER.size))
    if not checksum:
        return True
    file.seek(start)
    # All from the index on but the checksum itself and the magic bytes behind it.
    left, found = size - start - len(MAGIC) - 4, 0
    while left > 0:
        piece = file.read(min(left, _PIECE))
        left, found = left - len(piece), zlib.crc32(piece, found)
        if not piece:
            return False
    return bool(found == checksum)


def intact_records(file: BinaryIO) -> Iterator[McapRecord | Damage]:
    """Every intact record of a file but its index, those of a chunk one by one, and the damage between them.

    Schemas and channels that the index describes come after the header too: their chunk may be damaged. The
    footer comes only where there is an index.

    A damaged chunk is passed over. Where the length of a record is damaged, reading goes on at the next
    chunk that the index names; without an index it ends there. Memory is bounded by the largest chunk.

    Raises
    ------
    NotARecordingError : it is not an MCAP file. OSError : it cannot be read.
    """
    summary = read_summary(file)
    index = Summary() if summary is None else summary
    described = [*index.schemas.values(), *index.channels.values()]
    chunks = sorted(chunk.chunk_start_offset for chunk in index.chunk_indexes)
    size = file.seek(0, io.SEEK_END)
    file.seek(0)
    if file.read(len(MAGIC)) != MAGIC:
        raise NotARecordingError("is not an MCAP file")
    at = len(MAGIC)
    while at < size:
        file.seek(at)
        reader = StreamReader(file, skip_magic=True, emit_chunks=True, record_size_limit=size)
        try:
            for record in reader.records:
                start, end = at, file.tell()
                if end > _first_behind(start, chunks, size):
                    raise ValueError("a record reaches into the next chunk")
                at = end
                if not isinstance(record, Header):
                    yield from described
                    described = []
                if isinstance(record, Chunk):
                    yield from _unpacked(record, Damage(start, at))
                elif isinstance(record, _DATA):
                    yield record
                elif isinstance(record, Footer):
                    yield from [] if summary is None else [record]
                    return
        except DAMAGE:
            after = _first_behind(at, chunks, size)
            if at < after:
                yield Damage(at, after)
            at = after


def _first_behind(place: int, chunks: Sequence[int], size: int) -> int:
    """Where the first of the sorted chunks behind a place begins; the size of the file if there is none."""
    index = bisect_right(chunks, place)
    return chunks[index] if index < len(chunks) else size


def _unpacked(chunk: Chunk, place: Damage) -> Iterator[McapRecord | Damage]:
    """The records of a chunk, or its place if it is damaged."""
    try:
        data = _content(chunk)
        _check_lengths(data)
        records = breakup_chunk(replace(chunk, data=data, compression=""), validate_crc=True)
    except DAMAGE:
        yield place
    else:
        yield from records


def _content(chunk: Chunk) -> bytes:
    """The unpacked bytes of a chunk. Raises ValueError, before memory is taken, if they are too many."""
    size = chunk.uncompressed_size
    if size > LARGEST_CHUNK:
        raise ValueError(f"required a chunk of {LARGEST_CHUNK} bytes at most, got {size}")
    # One byte more than stated, to notice a chunk that is larger than it says.
    if chunk.compression == "zstd":
        data = zstandard.ZstdDecompressor().stream_reader(chunk.data).read(size + 1)
    elif chunk.compression == "lz4":
        data = import_module("lz4.frame").LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
    elif chunk.compression:
        raise ValueError(f"chunks of compression {chunk.compression!r} cannot be read")
    else:
        data = chunk.data
    if len(data) != size:
        raise ValueError(f"required a chunk of {size} bytes, got {len(data)}")
    return data


def _check_lengths(data: bytes) -> None:
    """Raise ValueError if a chunk has a record of kind 0, which no file may have, or too many records."""
    at = count = 0
    while at < len(data):
        count += 1
        if data[at] == 0 or count > MOST_RECORDS:
            raise ValueError("is not a sequence of records")
        at += RECORD_HEAD + int.from_bytes(data[at + 1 : at + RECORD_HEAD], "little")
