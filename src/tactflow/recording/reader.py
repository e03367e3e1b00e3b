"""Reads recordings, whole ones and ones that were cut off."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from mcap.exceptions import McapError
from mcap.reader import SeekingReader
from mcap.records import Channel, McapRecord, Message, Schema
from mcap.stream_reader import StreamReader
from mcap.summary import Summary

from tactflow.recording.frames import TYPE_NAME

DAMAGE = (McapError, ValueError, KeyError, struct.error)
"""What the library raises on files that are cut off or damaged. `CRCValidationError` is a ValueError."""


MAGIC = b"\x89MCAP0\r\n"
"""How every MCAP file begins."""


class NotARecordingError(Exception):
    """The file is no MCAP file, or holds no frames of ours."""


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

    Raises
    ------
    NotARecordingError
        If it holds none that tactflow recorded. OSError if it cannot be read.
    """
    with path.open("rb") as file:
        summary = _summary(file)
        if summary is not None:
            topics = {c.id: c.topic for c in summary.channels.values() if _is_ours(c, summary.schemas)}
            known = {c.topic for c in summary.channels.values()}
            found = _topics(set(topics.values()), known)
            statistics = summary.statistics
            if statistics is None:
                return Contents(True, *found, None, None, None)
            counts = statistics.channel_message_counts
            count = sum(counts.get(channel, 0) for channel, topic in topics.items() if topic in found)
            return Contents(True, *found, count, statistics.message_start_time, statistics.message_end_time)
        schemas: dict[int, Schema] = {}
        known, ours = set(), set()
        for record in stream(file):
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                known.add(record.topic)
                if _is_ours(record, schemas):
                    ours.add(record.topic)
            elif isinstance(record, Message) and len(ours) >= 2:
                return Contents(False, *_topics(ours, known), None, record.log_time, None)
        return Contents(False, *_topics(ours, known), 0, None, None)


def _is_ours(channel: Channel, schemas: dict[int, Schema]) -> bool:
    return channel.schema_id in schemas and schemas[channel.schema_id].name == TYPE_NAME


def _topics(ours: set[str], known: set[str]) -> tuple[str, str]:
    frames = sorted(topic for topic in ours if topic.endswith("/frames"))
    if not frames:
        there = f"it has {', '.join(sorted(known)[:5])}" if known else "it is empty"
        raise NotARecordingError(
            f"holds no frames that tactflow recorded ({there}); tactflow record writes such files"
        )
    return frames[0], frames[0].removesuffix("frames") + "references"


def _summary(file: BinaryIO) -> Summary | None:
    """The index at the end of the file, or None where it was cut off."""
    if file.read(len(MAGIC)) != MAGIC:
        raise NotARecordingError("is not an MCAP file")
    file.seek(0)
    try:
        return SeekingReader(file).get_summary()
    except (*DAMAGE, OSError):
        # The file is shorter than a footer, or does not end with one.
        return None


def messages(
    path: Path, contents: Contents, topics: set[str], start: int | None = None, end: int | None = None
) -> Iterator[Message]:
    """The messages of some channels, in the order they were written.

    start, end : those with start <= time < end, ns. With an index, the rest is not even read.
    A file without one ends at its last whole chunk.

    Raises
    ------
    One of `DAMAGE`, if a file that has an index is damaged.
    """
    with path.open("rb") as file:
        if contents.finished:
            reader = SeekingReader(file, validate_crcs=True)
            for _, _, message in reader.iter_messages(
                topics, log_time_order=False, starting_at=start, ending_before=end
            ):
                yield message
            return
        wanted: set[int] = set()
        for record in stream(file):
            if isinstance(record, Channel) and record.topic in topics:
                wanted.add(record.id)
            elif (
                isinstance(record, Message)
                and record.channel_id in wanted
                and (start is None or record.log_time >= start)
                and (end is None or record.log_time < end)
            ):
                yield record


def stream(file: BinaryIO) -> Iterator[McapRecord]:
    """The records of a file from its start up to its end or to where it was cut off."""
    file.seek(0)
    try:
        yield from StreamReader(file, validate_crcs=True).records
    except DAMAGE:
        return
