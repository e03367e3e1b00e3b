"""Gives a recording that was cut off its index."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from mcap.records import Attachment, Channel, Chunk, Header, Message, Metadata, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import CompressionType, Writer

from tactflow.recording.reader import DAMAGE, MAGIC, NotARecordingError
from tactflow.recording.writer import NEVER


@dataclass(frozen=True, slots=True)
class Repaired:
    """What `repair` found.

    finished : the file was whole; nothing was written. messages : how many were kept. lost : bytes at the end
    that belonged to no whole chunk.
    """

    finished: bool
    messages: int
    lost: int


def repair(path: Path, out: Path, report: Callable[[int], None] | None = None) -> Repaired:
    """Copy all whole chunks of an MCAP file to another, with an index; works for any MCAP file.

    path : stays as it is. out : is replaced. report : called now and then with the bytes read so far.

    Raises
    ------
    NotARecordingError
        If it is no MCAP file. OSError if one cannot be read or the other not written.
    """
    messages = 0
    with path.open("rb") as source, out.open("wb") as target:
        if source.read(len(MAGIC)) != MAGIC:
            raise NotARecordingError("is not an MCAP file")
        source.seek(0)
        copy = _Copy(Writer(target, chunk_size=NEVER, compression=CompressionType.NONE))
        whole = len(MAGIC)
        try:
            for record in StreamReader(source, emit_chunks=True, validate_crcs=True).records:
                messages += copy.add(record)
                whole = source.tell()
                if report is not None:
                    report(whole)
            finished = True
        except DAMAGE:
            finished = False
        copy.finish()
        target.flush()
        os.fsync(target.fileno())
    return Repaired(finished, messages, 0 if finished else path.stat().st_size - whole)


class _Copy:
    """Copies records, with ids as the new file numbers them."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._started = False
        self._schemas: dict[int, int] = {0: 0}
        self._channels: dict[int, int] = {}

    def add(self, record: object) -> int:
        """Copy one record; returns the number of messages in it."""
        writer = self._writer
        if isinstance(record, Chunk):
            count = sum([self.add(inner) for inner in breakup_chunk(record, validate_crc=True)])
            writer.flush()  # type: ignore[no-untyped-call]
            return count
        if isinstance(record, Header):
            writer.start(record.profile, record.library)
            self._started = True
        elif isinstance(record, Schema) and record.id not in self._schemas:
            self._schemas[record.id] = writer.register_schema(record.name, record.encoding, record.data)
        elif isinstance(record, Channel) and record.id not in self._channels:
            schema = self._schemas[record.schema_id]
            self._channels[record.id] = writer.register_channel(
                record.topic, record.message_encoding, schema, record.metadata
            )
        elif isinstance(record, Attachment):
            writer.add_attachment(
                record.create_time, record.log_time, record.name, record.media_type, record.data
            )
        elif isinstance(record, Metadata):
            writer.add_metadata(record.name, record.metadata)
        elif isinstance(record, Message):
            writer.add_message(
                self._channels[record.channel_id],
                log_time=record.log_time,
                publish_time=record.publish_time,
                sequence=record.sequence,
                data=record.data,
            )
            return 1
        return 0

    def finish(self) -> None:
        if not self._started:
            self._writer.start()
        self._writer.finish()  # type: ignore[no-untyped-call]
