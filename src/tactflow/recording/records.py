"""The records of an MCAP file in sequence, also of a damaged or truncated one."""

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
"""Exceptions on reading a damaged file: those of mcap and of the packages that unpack chunks."""

MAGIC = b"\x89MCAP0\r\n"
"""First bytes of every MCAP file."""

LARGEST_CHUNK = 256 << 20
"""Maximum size of an unpacked chunk, bytes: twice a raw 8K picture. Larger ones count as damaged."""
RECORD_HEAD = 9
"""Size of the type and length of a record, bytes."""
MOST_RECORDS = 1_000_000
"""Maximum number of records of a chunk: hours of a sensor's messages. More count as damage."""

_FOOTER = struct.Struct("<QQI")
"""Offsets of the index and of its offset section, and checksum: the last bytes of a file before `MAGIC`."""
_PIECE = 1 << 20
"""Size of the blocks for a checksum, bytes."""

_DATA = (Attachment, Channel, Header, Message, Metadata, Schema)
"""All records outside chunks except the index, which can be derived from the rest."""


class NotARecordingError(Exception):
    """The file is not an MCAP file, or has no frames of tactflow."""


class ForeignRecordingError(NotARecordingError):
    """An MCAP file of another program."""


@dataclass(frozen=True, slots=True)
class Damage:
    """Bytes [start, end) of the file that belong to no intact record."""

    start: int
    end: int


def read_summary(file: BinaryIO) -> Summary | None:
    """The index at the end of the file; None if it is damaged or missing, or the file is not an MCAP file."""
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
    """Verify the checksum of the index, if the footer has one.

    size : of the file, bytes. Raises OSError, ValueError or struct.error if the file is too short.
    """
    file.seek(size - _FOOTER.size - len(MAGIC))
    start, _, checksum = _FOOTER.unpack(file.read(_FOOTER.size))
    if not checksum:
        return True
    file.seek(start)
    # From the index to the end, without the checksum itself and the magic bytes.
    remaining, computed = size - start - len(MAGIC) - 4, 0
    while remaining > 0:
        piece = file.read(min(remaining, _PIECE))
        remaining, computed = remaining - len(piece), zlib.crc32(piece, computed)
        if not piece:
            return False
    return bool(computed == checksum)


def intact_records(file: BinaryIO) -> Iterator[McapRecord | Damage]:
    """All intact records of a file except its index, including those in chunks, and the damage between them.

    Schemas and channels of the index are yielded after the header, because their chunk may be damaged. The
    footer is yielded only if there is an index.

    Damaged chunks are skipped. If the length of a record is damaged, reading continues at the next chunk of
    the index; without an index, it ends there. Memory is bounded by the largest chunk.

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
    """Offset of the first of the sorted chunks after an offset; the size of the file if there is none."""
    index = bisect_right(chunks, place)
    return chunks[index] if index < len(chunks) else size


def _unpacked(chunk: Chunk, place: Damage) -> Iterator[McapRecord | Damage]:
    """The records of a chunk, or its location if it is damaged."""
    try:
        data = _content(chunk)
        _check_lengths(data)
        records = breakup_chunk(replace(chunk, data=data, compression=""), validate_crc=True)
    except DAMAGE:
        yield place
    else:
        yield from records


def _content(chunk: Chunk) -> bytes:
    """Unpack a chunk. Raises ValueError, before memory is allocated, if it is too large."""
    size = chunk.uncompressed_size
    if size > LARGEST_CHUNK:
        raise ValueError(f"required a chunk of {LARGEST_CHUNK} bytes at most, got {size}")
    # One byte more, to detect a chunk that is larger than stated.
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
    """Raise ValueError if a chunk has a record of type 0, which is invalid, or too many records."""
    at = count = 0
    while at < len(data):
        count += 1
        if data[at] == 0 or count > MOST_RECORDS:
            raise ValueError("is not a sequence of records")
        at += RECORD_HEAD + int.from_bytes(data[at + 1 : at + RECORD_HEAD], "little")
