"""Copies all that is intact in a recording to a new one, with an index."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from mcap.records import Attachment, Channel, DataEnd, Header, Message, Metadata, Schema
from mcap.summary import Summary
from mcap.writer import CompressionType, Writer

from tactflow.recording.reader import read_summary
from tactflow.recording.records import Damage, intact_records
from tactflow.recording.writer import NEVER

CHUNK_BYTES = 1 << 22
"""Bytes after which a chunk of the copy ends, as other writers do it."""


@dataclass(frozen=True, slots=True)
class Repaired:
    """What `repair` found.

    finished : the file was whole. messages : how many were kept. damage : what belonged to no intact record.
    """

    finished: bool
    messages: int
    damage: tuple[Damage, ...] = ()

    @property
    def lost(self) -> int:
        """Bytes that belonged to no intact record."""
        return sum(gap.end - gap.start for gap in self.damage)


def repair(path: Path, out: Path, report: Callable[[int], None] | None = None) -> Repaired:
    """Copy all that is intact in an MCAP file to another, with an index; works for any MCAP file.

    path : stays as it is. out : is replaced. report : called now and then with the bytes read so far.

    Raises
    ------
    NotARecordingError
        If it is no MCAP file. OSError if one cannot be read or the other not written.
    """
    messages, whole, damage = 0, False, []
    with path.open("rb") as source, out.open("wb") as target:
        copy = _Copy(Writer(target, chunk_size=NEVER, compression=CompressionType.NONE))
        summary = read_summary(source)
        if summary is not None:
            copy.know(summary)
        for record in intact_records(source):
            if isinstance(record, Damage):
                damage.append(record)
            else:
                messages += copy.add(record)
                whole = whole or isinstance(record, DataEnd)
            if report is not None:
                report(source.tell())
        copy.finish()
        target.flush()
        os.fsync(target.fileno())
    finished = whole and summary is not None and not damage
    return Repaired(finished, messages, tuple(damage))


class _Copy:
    """Copies records, with ids as the new file numbers them."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._started = False
        self._schemas: dict[int, int] = {0: 0}
        self._channels: dict[int, int] = {}
        self._summary = Summary()
        self._pending = 0

    def know(self, summary: Summary) -> None:
        """Where to look up the schemas and channels of a chunk that is damaged."""
        self._summary = summary

    def add(self, record: object) -> int:
        """Copy one record; returns the number of messages in it."""
        writer = self._writer
        if isinstance(record, Header) and not self._started:
            self._start(record.profile, record.library)
            return 0
        if not self._started:
            self._start()
        if isinstance(record, Message) and record.channel_id not in self._channels:
            self._look_up(record.channel_id)
        if isinstance(record, Schema) and record.id not in self._schemas:
            self._schemas[record.id] = writer.register_schema(record.name, record.encoding, record.data)
        elif isinstance(record, Channel) and record.id not in self._channels:
            schema = self._schemas.get(record.schema_id)
            if schema is not None:
                self._channels[record.id] = writer.register_channel(
                    record.topic, record.message_encoding, schema, record.metadata
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
            self._pending += len(record.data)
            if self._pending > CHUNK_BYTES:
                writer.flush()  # type: ignore[no-untyped-call]
                self._pending = 0
            return 1
        return 0

    def _look_up(self, channel_id: int) -> None:
        """Describe a channel as the index does."""
        channel = self._summary.channels.get(channel_id)
        if channel is None:
            return
        schema = self._summary.schemas.get(channel.schema_id)
        if schema is not None:
            self.add(schema)
        self.add(channel)

    def _start(self, profile: str = "", library: str = "") -> None:
        self._writer.start(profile, library)
        self._started = True

    def finish(self) -> None:
        """Write what is pending, and the index."""
        if not self._started:
            self._start()
        self._writer.finish()  # type: ignore[no-untyped-call]
