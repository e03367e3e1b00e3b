"""Reads recordings, also truncated ones."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

from mcap.records import Attachment, Channel, Message, Schema
from mcap.summary import Summary

from tactflow.recording.frames import TYPE_NAME
from tactflow.recording.records import (
    Damage,
    ForeignRecordingError,
    NotARecordingError,
    intact_records,
    read_summary,
)


@dataclass(frozen=True, slots=True)
class Contents:
    """Contents of a recording.

    Attributes
    ----------
    finished : whether it has an index.
    frame_topic, reference_topic : channels.
    frames : number, including references; None if unknown.
    start, end : ns; None if unknown.
    """

    finished: bool
    frame_topic: str
    reference_topic: str
    frames: int | None
    start: int | None
    end: int | None


def look_into(path: Path) -> Contents:
    """Determine the contents of a recording.

    Raises NotARecordingError if it has no frames recorded by tactflow, OSError if it cannot be read.
    """
    described = Summary()
    start = None
    with path.open("rb") as file:
        summary = read_summary(file)
        # Channels are described before the first message.
        for record in intact_records(file):
            if isinstance(record, Schema):
                described.schemas[record.id] = record
            elif isinstance(record, Channel):
                described.channels[record.id] = record
            elif isinstance(record, Message):
                start = record.log_time
                break
    topics = _frame_topics(described)
    if summary is None or summary.statistics is None:
        return Contents(summary is not None, *topics, None, start, None)
    counts = summary.statistics.channel_message_counts
    channels = [channel for channel in described.channels.values() if channel.topic in topics]
    count = sum(counts.get(channel.id, 0) for channel in channels)
    return Contents(True, *topics, count, start, summary.statistics.message_end_time)


def _frame_topics(described: Summary) -> tuple[str, str]:
    """The topics of the frames and of the references."""
    channels = sorted(described.channels.values(), key=lambda channel: channel.topic)
    for channel in channels:
        schema = described.schemas.get(channel.schema_id)
        if schema is not None and schema.name == TYPE_NAME and channel.topic.endswith("/frames"):
            return channel.topic, channel.topic.removesuffix("frames") + "references"
    topics = dict.fromkeys(channel.topic for channel in channels)
    if topics:
        names = ", ".join([*topics][:20])
        raise ForeignRecordingError(
            f"holds no frames that tactflow recorded; choose by ?topic= one of {names}"
        )
    raise NotARecordingError("holds no frames that tactflow recorded; it is empty")


def attachments(path: Path) -> dict[str, bytes]:
    """The attachments before the frames of a recording, where ours are: name -> bytes.

    Raises OSError if it cannot be read, NotARecordingError if it is not an MCAP file.
    """
    files: dict[str, bytes] = {}
    with path.open("rb") as file:
        for record in intact_records(file):
            if isinstance(record, Attachment):
                files[record.name] = record.data
            elif isinstance(record, Message):
                break
    return files


def messages(
    path: Path, topics: Collection[str], start: int | None = None, end: int | None = None
) -> Iterator[Message]:
    """The messages of some topics of an MCAP file, in the order in which they were written.

    start, end : select start <= time < end, ns. A file without an index ends with its last complete chunk.

    Raises ValueError if the file is damaged and not just truncated, OSError if it cannot be read.
    """
    with path.open("rb") as file:
        has_index = read_summary(file) is not None
        channels: set[int] = set()
        size = path.stat().st_size
        for record in intact_records(file):
            if isinstance(record, Damage):
                if has_index or record.end < size:
                    raise ValueError(f"bytes {record.start} to {record.end} are not as they were written")
            elif isinstance(record, Channel) and record.topic in topics:
                channels.add(record.id)
            elif (
                isinstance(record, Message)
                and record.channel_id in channels
                and (start is None or record.log_time >= start)
                and (end is None or record.log_time < end)
            ):
                yield record
