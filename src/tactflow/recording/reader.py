"""Reads recordings, whole ones and ones that were cut off."""

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

MOST_NAMED = 20
"""Topics that a message lists at most. Chosen by hand."""


@dataclass(frozen=True, slots=True)
class Contents:
    """What a recording holds.

    finished : it has an index. frame_topic, reference_topic : channels. frames : how many, references
    included; None if not known. start, end : ns; None if not known.
    """

    finished: bool
    frame_topic: str
    reference_topic: str
    frames: int | None
    start: int | None
    end: int | None


def look_into(path: Path) -> Contents:
    """Find the frames in a recording.

    Raises NotARecordingError if it holds none that tactflow recorded, OSError if it cannot be read.
    """
    found = Summary()
    start = None
    with path.open("rb") as file:
        summary = read_summary(file)
        # Its channels are described before its first message.
        for record in intact_records(file):
            if isinstance(record, Schema):
                found.schemas[record.id] = record
            elif isinstance(record, Channel):
                found.channels[record.id] = record
            elif isinstance(record, Message):
                start = record.log_time
                break
    topics = _frame_topics(found)
    if summary is None or summary.statistics is None:
        return Contents(summary is not None, *topics, None, start, None)
    counts = summary.statistics.channel_message_counts
    count = sum(counts.get(channel.id, 0) for channel in found.channels.values() if channel.topic in topics)
    return Contents(True, *topics, count, start, summary.statistics.message_end_time)


def _frame_topics(found: Summary) -> tuple[str, str]:
    """The topics of the frames and of the references."""
    channels = sorted(found.channels.values(), key=lambda channel: channel.topic)
    for channel in channels:
        schema = found.schemas.get(channel.schema_id)
        if schema is not None and schema.name == TYPE_NAME and channel.topic.endswith("/frames"):
            return channel.topic, channel.topic.removesuffix("frames") + "references"
    topics = list(dict.fromkeys(channel.topic for channel in channels))
    if topics:
        names = ", ".join(topics[:MOST_NAMED])
        raise ForeignRecordingError(
            f"holds no frames that tactflow recorded; choose by ?topic= one of {names}"
        )
    raise NotARecordingError("holds no frames that tactflow recorded; it is empty")


def attachments(path: Path) -> dict[str, bytes]:
    """Name -> bytes of the files that stand before the frames of a recording, as ours do.

    Raises OSError if it cannot be read, NotARecordingError if it is not an MCAP file.
    """
    found: dict[str, bytes] = {}
    with path.open("rb") as file:
        for record in intact_records(file):
            if isinstance(record, Attachment):
                found[record.name] = record.data
            elif isinstance(record, Message):
                break
    return found


def messages(
    path: Path, topics: Collection[str], start: int | None = None, end: int | None = None
) -> Iterator[Message]:
    """The messages of some channels of an MCAP file, in the order they were written.

    start, end : those with start <= time < end, ns. A file without an index ends at its last whole chunk.

    Raises ValueError where the file is damaged and not only cut off, OSError if it cannot be read.
    """
    with path.open("rb") as file:
        has_index = read_summary(file) is not None
        wanted: set[int] = set()
        size = path.stat().st_size
        for record in intact_records(file):
            if isinstance(record, Damage):
                if has_index or record.end < size:
                    raise ValueError(f"bytes {record.start} to {record.end} are not as they were written")
            elif isinstance(record, Channel) and record.topic in topics:
                wanted.add(record.id)
            elif (
                isinstance(record, Message)
                and record.channel_id in wanted
                and (start is None or record.log_time >= start)
                and (end is None or record.log_time < end)
            ):
                yield record
