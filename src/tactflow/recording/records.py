"""The records of an MCAP file one after the other, past what is damaged, within bounded memory."""

from __future__ import annotations

import io
import re
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import BinaryIO, Final

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    Channel,
    Chunk,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Message,
    Metadata,
    Schema,
)
from mcap.stream_reader import get_chunk_data_stream

from tactflow.recording.packing import unpacked

DAMAGE = (McapError, ValueError, KeyError, struct.error)
"""What the library raises on files that are cut off or damaged. `CRCValidationError` is a ValueError."""

MAGIC: Final = b"\x89MCAP0\r\n"
"""How every MCAP file begins."""

MOST_UNPACKED: Final = 1 << 30
"""Bytes that a chunk may hold: a thousand times what writers put into one, and less than a computer has."""

_PREFIX = struct.Struct("<BQ")
"""How a record begins: its kind, and the bytes that follow."""
_CHUNK = struct.Struct("<QQQII")
"""How a chunk goes on: first and last time (ns), bytes unpacked, checksum, length of the packing's name."""
_LENGTH = struct.Struct("<Q")
_LOOKS_LIKE_A_CHUNK = re.compile(rb"\x06.{36}(?:\0{4}|\x03\0{3}lz4|\x04\0{3}zstd)", re.DOTALL)
_LONGEST_NAME: Final = 32
"""Letters of a packing's name at most; the known ones have four."""
_LONGEST_BEGINNING: Final = _PREFIX.size + _CHUNK.size + _LONGEST_NAME + _LENGTH.size
"""Bytes that a chunk has at most before its records."""
_WINDOW: Final = 1 << 20
"""Bytes that are searched at a time for the next chunk after damage."""

_LONGEST_RECORD: Final = 1 << 40
"""Bytes of a record at most: more than a disk holds, and less than eight bytes that mean something else."""

_READERS: dict[int, Callable[[ReadDataStream], McapRecord]] = {
    Opcode.ATTACHMENT: Attachment.read,
    Opcode.CHANNEL: Channel.read,
    Opcode.DATA_END: DataEnd.read,
    Opcode.FOOTER: Footer.read,
    Opcode.HEADER: Header.read,
    Opcode.METADATA: Metadata.read,
    Opcode.SCHEMA: Schema.read,
}
"""What is read besides chunks and messages: all but the index, which follows from the rest."""
_KINDS = frozenset(int(kind) for kind in Opcode)
_PRIVATE: Final = 0x80
"""Kinds from here on belong to whoever wrote the file."""


class NotARecordingError(Exception):
    """The file is no MCAP file, or holds no frames of ours."""


@dataclass(frozen=True, slots=True)
class Damage:
    """Bytes of the file, from `start` up to `end`, that belong to no intact record."""

    start: int
    end: int


def intact_records(file: BinaryIO, since: int | None = None) -> Iterator[McapRecord | Damage]:
    """Every intact record of a file but its index, those of a chunk one by one, and the damage between them.

    A damaged chunk is passed over; where not even the length of a record can be believed, the next chunk is
    searched for. A file that was cut off ends with `Damage`, or without a footer. Memory is bounded by the
    largest chunk.

    since : chunks with nothing but earlier messages are passed over unread, with the schemas and channels
        that are in them, ns.

    Raises
    ------
    NotARecordingError : it is no MCAP file. OSError : it cannot be read.
    """
    size = file.seek(0, io.SEEK_END)
    file.seek(0)
    if file.read(len(MAGIC)) != MAGIC:
        raise NotARecordingError("is not an MCAP file")
    at = len(MAGIC)
    while at < size:
        end = _end_of_record(file, at, size)
        if end is None:
            after = _next_chunk(file, at + 1, size)
            yield Damage(at, after)
            at = after
            continue
        try:
            for record in _read(file, at, since):
                yield record
                if isinstance(record, Footer):
                    return
        except DAMAGE:
            yield Damage(at, end)
        at = end


def _end_of_record(file: BinaryIO, at: int, size: int) -> int | None:
    """Where the record that begins at a place ends; None where none can begin there."""
    file.seek(at)
    prefix = file.read(_PREFIX.size)
    if len(prefix) < _PREFIX.size:
        return None
    kind: int
    length: int
    kind, length = _PREFIX.unpack(prefix)
    end = at + _PREFIX.size + length
    if end > size or (kind not in _KINDS and kind < _PRIVATE):
        return None
    if kind == Opcode.CHUNK:
        beginning = file.read(_LONGEST_BEGINNING - _PREFIX.size)
        return end if _chunk_is_consistent(beginning, length) else None
    # The length is right if it leads to another record, or to the end.
    file.seek(end)
    return end if _can_begin_record(file.read(_PREFIX.size)) else None


def _can_begin_record(data: bytes) -> bool:
    if len(data) < _PREFIX.size:
        return MAGIC.startswith(data)
    kind, length = _PREFIX.unpack(data)
    return bool((kind in _KINDS or kind >= _PRIVATE) and length < _LONGEST_RECORD)


def _chunk_is_consistent(beginning: bytes, length: int) -> bool:
    """Whether the two lengths that a chunk states agree."""
    if len(beginning) < _CHUNK.size:
        return False
    *_, name = _CHUNK.unpack_from(beginning)
    records = _CHUNK.size + name
    if records + _LENGTH.size > min(length, len(beginning)):
        return False
    return bool(_LENGTH.unpack_from(beginning, records)[0] == length - records - _LENGTH.size)


def _next_chunk(file: BinaryIO, at: int, size: int) -> int:
    """Where the next chunk begins from some place on, or the end of the file."""
    while at < size:
        file.seek(at)
        window = file.read(_WINDOW)
        for match in _LOOKS_LIKE_A_CHUNK.finditer(window):
            if _end_of_record(file, at + match.start(), size) is not None:
                return at + match.start()
        at += max(len(window) - _LONGEST_BEGINNING, 1)
    return size


def _read(file: BinaryIO, at: int, since: int | None) -> Iterator[McapRecord]:
    """The record at a place, those in it if it is a chunk; none if it belongs to the index."""
    file.seek(at)
    kind, length = _PREFIX.unpack(file.read(_PREFIX.size))
    if kind == Opcode.CHUNK:
        last = _CHUNK.unpack(file.read(_CHUNK.size))[1]
        if since is not None and last < since:
            return
        file.seek(at + _PREFIX.size)
        chunk = Chunk.read(ReadDataStream(file))
        data = unpacked(chunk.data, chunk.compression, _bounded(chunk.uncompressed_size))
        yield from _records_of(replace(chunk, data=data, compression=""))
    elif kind == Opcode.MESSAGE:
        yield Message.read(ReadDataStream(file), _bounded(length))
    elif kind in _READERS:
        yield _READERS[kind](ReadDataStream(io.BytesIO(file.read(_bounded(length)))))


def _records_of(chunk: Chunk) -> Iterator[McapRecord]:
    """The records of an unpacked chunk, one by one: as objects, small ones take ten times their bytes."""
    stream, size = get_chunk_data_stream(chunk, validate_crc=True)
    while stream.count < size:
        kind, length = stream.read1(), _bounded(stream.read8())
        if kind == Opcode.MESSAGE:
            yield Message.read(stream, length)
        elif kind in (Opcode.CHANNEL, Opcode.SCHEMA):
            yield _READERS[kind](stream)
        else:
            stream.read(length)


def _bounded(size: int) -> int:
    if size > MOST_UNPACKED:
        raise ValueError(f"required at most {MOST_UNPACKED} bytes in a record, got {size}")
    return size
