"""The records of an MCAP file in sequence, also of a damaged or truncated one."""

from __future__ import annotations

import io
import struct
import zlib
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from mmap import ACCESS_READ, mmap
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

DAMAGE_ERRORS = (
    *(McapError, struct.error, zstandard.ZstdError),
    *(ValueError, KeyError, OverflowError, RuntimeError, MemoryError),
)
"""Exceptions on reading a damaged file: those of mcap and of the packages that unpack chunks."""

MAGIC = b"\x89MCAP0\r\n"
"""First bytes of every MCAP file."""

MAX_CHUNK_BYTES = 256 << 20
"""Maximum size of an unpacked chunk, bytes: twice a raw 8K picture. Larger ones count as damaged."""

_FOOTER = struct.Struct("<QQI")
"""Offsets of the index and of its offset section, and checksum: the last bytes of a file before `MAGIC`."""

_DATA_RECORDS = (Attachment, Channel, Header, Message, Metadata, Schema)
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
    try:
        with mmap(file.fileno(), 0, access=ACCESS_READ) as data, memoryview(data) as view:
            size = len(view)
            start, _, checksum = _FOOTER.unpack_from(view, size - _FOOTER.size - len(MAGIC))
            # From the index to the end, without the checksum itself and the magic bytes.
            with view[start : -4 - len(MAGIC)] as index:
                if checksum and zlib.crc32(index) != checksum:
                    return None
        file.seek(0)
        return SeekingReader(file, record_size_limit=size).get_summary()
    except (*DAMAGE_ERRORS, OSError):
        # The file is shorter than a footer, or does not end with one.
        return None


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
                elif isinstance(record, _DATA_RECORDS):
                    yield record
                elif isinstance(record, Footer):
                    yield from [] if summary is None else [record]
                    return
        except DAMAGE_ERRORS:
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
        # Before memory is allocated.
        if chunk.uncompressed_size > MAX_CHUNK_BYTES:
            raise ValueError(f"required a chunk of {MAX_CHUNK_BYTES} bytes at most")
        records = breakup_chunk(chunk, validate_crc=True)
    except DAMAGE_ERRORS:
        yield place
    else:
        yield from records
