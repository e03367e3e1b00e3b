"""Reads recordings, whole ones and ones that were cut off."""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from mcap.reader import SeekingReader
from mcap.records import Attachment, Channel, Message, Schema
from mcap.summary import Summary

from tactflow.recording.frames import TYPE_NAME
from tactflow.recording.records import DAMAGE, Damage, NotARecordingError, intact_records

MOST_NAMED = 20
"""Topics that a message lists at most. Chosen by hand."""


@dataclass(frozen=True, slots=True)
class Contents:
    """What a recording holds.

    finished : it has an index. frame_topic, reference_topic : channels. channels : the topic of each, as far
    as the index tells. frames : how many, references included; None if not known. start, end : ns; None if
    not known.
    """

    finished: bool
    frame_topic: str
    reference_topic: str
    channels: Mapping[int, str]
    frames: int | None
    start: int | None
    end: int | None


def look_into(path: Path) -> Contents:
    """Find the frames in a recording.

    Raises
    ------
    NotARecordingError
        If it holds none that tactflow recorded. OSError if it cannot be read.
    """
    with path.open("rb") as file:
        summary = read_summary(file)
        if summary is not None:
            topics = {c.id: c.topic for c in summary.channels.values() if _is_ours(c, summary.schemas)}
            known = {c.id: c.topic for c in summary.channels.values()}
            found = _topics(set(topics.values()), set(known.values()))
            statistics = summary.statistics
            if statistics is None:
                return Contents(True, *found, known, None, None, None)
            counts = statistics.channel_message_counts
            count = sum(counts.get(channel, 0) for channel, topic in topics.items() if topic in found)
            return Contents(
                True, *found, known, count, statistics.message_start_time, statistics.message_end_time
            )
        schemas: dict[int, Schema] = {}
        names, ours = set(), set()
        for record in intact_records(file):
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                names.add(record.topic)
                if _is_ours(record, schemas):
                    ours.add(record.topic)
            elif isinstance(record, Message) and len(ours) >= 2:
                return Contents(False, *_topics(ours, names), {}, None, record.log_time, None)
        return Contents(False, *_topics(ours, names), {}, 0, None, None)


def _is_ours(channel: Channel, schemas: dict[int, Schema]) -> bool:
    return channel.schema_id in schemas and schemas[channel.schema_id].name == TYPE_NAME


def _topics(ours: set[str], known: set[str]) -> tuple[str, str]:
    frames = sorted(topic for topic in ours if topic.endswith("/frames"))
    if not frames:
        there = "it is empty" if not known else f"to play one of its topics, add ?topic={min(known)}"
        others = f" or {', '.join(sorted(known)[1:MOST_NAMED])}" if len(known) > 1 else ""
        raise NotARecordingError(f"holds no frames that tactflow recorded; {there}{others}")
    return frames[0], frames[0].removesuffix("frames") + "references"


def attachments(path: Path) -> dict[str, bytes]:
    """Name -> bytes of the files that stand before the frames of a recording, as ours do; {} where none do.

    Raises OSError if it cannot be read, NotARecordingError if it is no MCAP file.
    """
    found: dict[str, bytes] = {}
    with path.open("rb") as file:
        for record in intact_records(file):
            if isinstance(record, Attachment):
                found[record.name] = bytes(record.data)
            elif isinstance(record, Message):
                break
    return found


def read_summary(file: BinaryIO) -> Summary | None:
    """The index at the end of the file, or None where it was cut off, or the file is another kind."""
    size = file.seek(0, io.SEEK_END)
    file.seek(0)
    try:
        return SeekingReader(file, record_size_limit=size).get_summary()
    except (*DAMAGE, OSError):
        # The file is shorter than a footer, or does not end with one.
        return None


def messages(
    path: Path, contents: Contents, topics: set[str], start: int | None = None, end: int | None = None
) -> Iterator[Message]:
    """The messages of some channels, in the order they were written.

    start, end : those with start <= time < end, ns. With an index, what lies before is not even read.
    A file without one ends at its last whole chunk.

    Raises
    ------
    ValueError : the file is damaged here, and not only cut off. OSError : it cannot be read.
    """
    with path.open("rb") as file:
        wanted = {channel for channel, topic in contents.channels.items() if topic in topics}
        size = path.stat().st_size
        for record in intact_records(file, start if contents.finished else None):
            if isinstance(record, Damage):
                if contents.finished or record.end < size:
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
