"""Copies the intact part of a recording to a new one, with an index."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from mcap.records import Attachment, Channel, Footer, Header, McapRecord, Message, Metadata, Schema
from mcap.writer import CompressionType, Writer

from tactflow.recording.records import Damage, intact_records

CHUNK_BYTES = 1 << 22
"""Size of the copy's chunks, bytes, as other writers choose it."""


@dataclass(frozen=True, slots=True)
class Repaired:
    """The outcome of `repair`.

    Attributes
    ----------
    finished : whether the file was intact.
    messages : number of copied messages.
    lost : bytes that belong to no intact record.
    """

    finished: bool
    messages: int
    lost: int = 0


def repair(path: Path, out: Path, report: Callable[[int], None] | None = None) -> Repaired:
    """Copy the intact part of any MCAP file to another file, with an index.

    path : of the file, which is not changed. out : is replaced. report : called with the bytes read so far.

    Raises NotARecordingError if it is not an MCAP file, OSError if a file cannot be read or written.
    """
    messages = lost = 0
    has_index = False
    with path.open("rb") as source, out.open("wb") as target:
        records = intact_records(source)
        first = next(records, None)
        header = first if isinstance(first, Header) else Header("", "")
        writer = Writer(target, chunk_size=CHUNK_BYTES, compression=CompressionType.NONE)
        writer.start(header.profile, header.library)
        copy = _Copy(writer)
        for record in (first, *records):
            if isinstance(record, Damage):
                lost += record.end - record.start
            elif record is not None:
                messages += copy.add(record)
                has_index = isinstance(record, Footer)
            if report is not None:
                report(source.tell())
        writer.finish()  # type: ignore[no-untyped-call]
        target.flush()
        os.fsync(target.fileno())
    return Repaired(has_index and not lost, messages, lost)


class _Copy:
    """Copies records, with the ids of the new file."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._schemas: dict[int, int] = {0: 0}
        self._channels: dict[int, int] = {}

    def add(self, record: McapRecord) -> bool:
        """Copy a record; returns whether it was a message."""
        writer = self._writer
        if isinstance(record, Schema) and record.id not in self._schemas:
            self._schemas[record.id] = writer.register_schema(record.name, record.encoding, record.data)
        elif isinstance(record, Channel) and record.id not in self._channels:
            if record.schema_id in self._schemas:
                self._channels[record.id] = writer.register_channel(
                    record.topic, record.message_encoding, self._schemas[record.schema_id], record.metadata
                )
        elif isinstance(record, Attachment):
            writer.add_attachment(
                record.create_time, record.log_time, record.name, record.media_type, record.data
            )
        elif isinstance(record, Metadata):
            writer.add_metadata(record.name, record.metadata)
        elif isinstance(record, Message) and record.channel_id in self._channels:
            writer.add_message(
                self._channels[record.channel_id],
                log_time=record.log_time,
                publish_time=record.publish_time,
                sequence=record.sequence,
                data=record.data,
            )
            return True
        return False
