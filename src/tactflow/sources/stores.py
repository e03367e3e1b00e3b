"""Files with messages: MCAP files, rosbag2 folders, ROS 1 bags."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

from tactflow.engine.errors import SourceError
from tactflow.recording import missing_packages
from tactflow.system.extras import missing

if TYPE_CHECKING:
    from mcap.records import Channel, Schema

PACKAGES = {"cdr": "rosbags", "ros1": "rosbags", "protobuf": "mcap_protobuf", "json": "json"}
"""How messages may be encoded -> what decodes them."""


class Topic(NamedTuple):
    """type : of its messages. number : of them; None where that is not known."""

    type: str
    number: int | None


class Store(Protocol):
    """A file or folder with messages."""

    topics: Mapping[str, Topic]

    def messages(self, topic: str) -> Iterator[tuple[int, Any]]:
        """When each message of a topic was written, ns, and the message, whose fields are attributes."""
        ...

    def close(self) -> None:
        """Let go of the files."""
        ...


class RosBag:
    """A rosbag2 folder (sqlite3 or MCAP), a .db3 file, or a ROS 1 .bag, read by rosbags."""

    def __init__(self, path: Path) -> None:
        problem = missing("ROS bags", "bags", ["rosbags"])
        if problem is not None:
            raise SourceError(f"{path}: {problem}")
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore

        try:
            # Bags of before 2023 do not say what their types are; those of pictures have never changed.
            self._reader = AnyReader([path], default_typestore=get_typestore(Stores.LATEST))
            self._reader.open()
        except Exception as error:
            # The library raises whatever its parsers do.
            raise damaged(str(path), error) from error
        self.topics: Mapping[str, Topic] = {
            name: Topic(info.msgtype or "several types", info.msgcount)
            for name, info in self._reader.topics.items()
        }

    def messages(self, topic: str) -> Iterator[tuple[int, Any]]:
        """See `Store.messages`."""
        reader = self._reader
        connections = [one for one in reader.connections if one.topic == topic]
        for connection, written, data in reader.messages(connections):
            yield written, reader.deserialize(data, connection.msgtype)

    def close(self) -> None:
        """Let go of the files; may come twice."""
        if self._reader.stack is not None:
            self._reader.close()


class McapFile:
    """An .mcap file, whoever wrote it, also one that was cut off."""

    def __init__(self, path: Path) -> None:
        problem = missing_packages()
        if problem is not None:
            raise SourceError(f"{path}: {problem}")
        self._path = path
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        counts = self._look()
        topics: dict[str, Topic] = {}
        for channel in self._channels.values():
            schema = self._schemas.get(channel.schema_id)
            name = schema.name if schema else "no type"
            # A topic may have several channels, one for each of its writers.
            before = topics[channel.topic].number or 0 if channel.topic in topics else 0
            number = None if counts is None else before + counts.get(channel.id, 0)
            topics[channel.topic] = Topic(name, number)
        self.topics: Mapping[str, Topic] = topics

    def _look(self) -> dict[int, int] | None:
        """Find out what is in it; the number of messages of each channel, if the index has that."""
        from mcap.records import Channel, Schema

        from tactflow.recording.records import NotARecordingError, intact_records, read_summary

        try:
            with self._path.open("rb") as file:
                summary = read_summary(file)
                if summary is not None:
                    self._schemas, self._channels = summary.schemas, summary.channels
                    statistics = summary.statistics
                    return None if statistics is None else statistics.channel_message_counts
                for record in intact_records(file):
                    if isinstance(record, Schema):
                        self._schemas[record.id] = record
                    elif isinstance(record, Channel):
                        self._channels[record.id] = record
        except NotARecordingError as error:
            raise SourceError(f"{self._path}: {error}") from None
        except OSError as error:
            raise SourceError(f"{self._path}: cannot be read: {error.strerror or error}") from error
        return None

    def messages(self, topic: str) -> Iterator[tuple[int, Any]]:
        """See `Store.messages`. A file that was cut off ends at its last whole chunk."""
        from mcap.records import Message

        from tactflow.recording.records import Damage, intact_records

        decoders = {
            channel.id: self._decoder(channel)
            for channel in self._channels.values()
            if channel.topic == topic
        }
        size = self._path.stat().st_size
        with self._path.open("rb") as file:
            for record in intact_records(file):
                if isinstance(record, Damage) and record.end < size:
                    raise ValueError(f"bytes {record.start} to {record.end} are not as they were written")
                if isinstance(record, Message) and record.channel_id in decoders:
                    yield record.log_time, decoders[record.channel_id](record.data)

    def _decoder(self, channel: Channel) -> Callable[[bytes], Any]:
        """What makes a message of bytes."""
        schema, encoding = self._schemas[channel.schema_id], channel.message_encoding
        if encoding not in PACKAGES:
            raise SourceError(
                f"{self._path}, {channel.topic}: messages are encoded as {encoding!r}; required one of: "
                + ", ".join(PACKAGES)
            )
        problem = missing(f"messages encoded as {encoding}", "bags", [PACKAGES[encoding]])
        if problem is not None:
            raise SourceError(f"{self._path}: {problem}")
        if encoding == "json":
            return _from_json
        if encoding == "protobuf":
            from mcap_protobuf.decoder import DecoderFactory

            decoder = DecoderFactory().decoder_for(encoding, schema)
            if decoder is None:
                raise ValueError(f"the schema of {channel.topic} is written as {schema.encoding!r}")
            return decoder
        return _from_ros(schema, encoding)

    def close(self) -> None:
        """Nothing is open between two reads."""


def _from_ros(schema: Schema, encoding: str) -> Callable[[bytes], Any]:
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

    store = get_typestore(Stores.EMPTY)
    text = schema.data.decode()
    name = schema.name if "/msg/" in schema.name else schema.name.replace("/", "/msg/")
    store.register(get_types_from_idl(text) if "idl" in schema.encoding else get_types_from_msg(text, name))
    if encoding == "ros1":
        return lambda data: store.deserialize_ros1(data, name)
    return lambda data: store.deserialize_cdr(data, name)


def _from_json(data: bytes) -> Any:
    """A message of Foxglove's JSON schemas, whose bytes are written in base64."""
    message = json.loads(data, object_hook=lambda fields: SimpleNamespace(**fields))
    message.data = base64.b64decode(message.data)
    return message


def damaged(name: str, error: Exception) -> SourceError:
    """What to raise for what a parser raised on damaged bytes."""
    said = str(error).strip().partition("\n")[0]
    return SourceError(f"{name}: is damaged or cut off ({said or type(error).__name__})")
