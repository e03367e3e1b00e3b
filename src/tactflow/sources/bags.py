"""Recordings of ROS and Foxglove: pictures of one topic of an .mcap file, a rosbag2 folder, a ROS 1 .bag."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from tactflow.engine.errors import SourceError
from tactflow.sources.base import BgrImage, Normaliser, find_path, log, refuse_devices
from tactflow.sources.messages import VideoDecoder, compressed_picture, kind_of, raw_picture, stamp_of
from tactflow.sources.query import split_query
from tactflow.sources.stores import McapFile, RosBag, Store, Topic, damaged

SETTINGS = {"topic": "name of a topic with pictures"}
MOST_NAMED = 20
"""Topics that a message lists at most. Chosen by hand."""


class Bag:
    """The pictures of one topic.

    A frame's time is the stamp in its message, or, where that is 0, when it was recorded; from 0 at the first
    frame. Where it would go back, it stays.

    Parameters
    ----------
    spec : `file.mcap?topic=/name`, and so for a `.bag` or `.db3` file or a rosbag2 folder.
    directory : where a relative path is looked for if it is not in the current directory.

    Raises
    ------
    SourceError
        If there is no such file or topic (it lists those that are there), or a package is missing.
    """

    live = False

    def __init__(self, spec: str, directory: Path | None = None) -> None:
        name, settings = split_query(spec, directory, SETTINGS)
        self._path = find_path(name, directory)
        self._store = _opened(self._path)
        try:
            topic = _chosen(spec, settings.get("topic"), self._store.topics)
            self._name = f"{self._path}, {topic}"
            self._normalise = Normaliser(self._name)
            self.fps: float | None = None
            self.total = self._store.topics[topic].number
            self._frames = self._play(topic)
            self._first = next(self._frames, None)
            if self._first is None:
                raise SourceError(f"{self._name}: there is no picture in it")
        except SourceError:
            self._store.close()
            raise
        self.size = self._normalise.size
        count = "an unknown number of" if self.total is None else self.total
        self.description = f"{spec}, {count} messages"

    def read(self) -> tuple[BgrImage, float] | None:
        """The next frame and its time; see `FrameReader.read`."""
        item, self._first = self._first or next(self._frames, None), None
        return item

    def close(self) -> None:
        """Read no more."""
        self._frames.close()
        self._store.close()
        self._first = None

    def _play(self, topic: str) -> Generator[tuple[BgrImage, float], None, None]:
        picture = _pictures(self._store.topics[topic].type, self._name)
        first: int | None = None
        t = 0.0
        told = False
        for written, message in _guarded(self._store.messages(topic), self._name):
            try:
                image = picture(message)
                taken = stamp_of(message) or written
            except SourceError:
                raise
            except Exception as error:
                # OpenCV, FFmpeg and fields that are not there each have errors of their own.
                raise damaged(self._name, error) from error
            if image is None:
                continue
            first = taken if first is None else first
            if (taken - first) / 1e9 < t and not told:
                told = True
                log.warning("%s: time goes back %.3f s after the beginning; it is held there", self._name, t)
            t = max(t, (taken - first) / 1e9)
            yield self._normalise(image), t


def _opened(path: Path) -> Store:
    refuse_devices(path)
    if path.suffix.lower() == ".mcap":
        return McapFile(path)
    return RosBag(path)


def _chosen(spec: str, topic: str | None, topics: Mapping[str, Topic]) -> str:
    """The topic that is asked for, if it is there and has pictures."""
    if topic is not None and topic in topics and _has_pictures(topics[topic]):
        return topic
    if topic is None:
        problem = "add ?topic="
    elif topic in topics:
        problem = f"{topic} has messages of type {topics[topic].type}, which hold no picture; required"
    else:
        problem = f"there is no topic {topic}; required"
    with_pictures = [name for name in topics if _has_pictures(topics[name])]
    others = [name for name in topics if name not in with_pictures]
    raise SourceError(
        f"{spec}: {problem} one of: {_listed(with_pictures, topics)}; topics without pictures: "
        f"{_listed(others, topics)}"
    )


def _listed(names: Sequence[str], topics: Mapping[str, Topic]) -> str:
    found = [
        f"{name} ({topics[name].type}{'' if topics[name].number is None else f', {topics[name].number}'})"
        for name in sorted(names)[:MOST_NAMED]
    ]
    return (
        ", ".join(found) + (f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else "")
        or "none"
    )


def _has_pictures(topic: Topic) -> bool:
    return kind_of(topic.type) is not None


def _pictures(type_name: str, name: str) -> Callable[[Any], Any]:
    """What takes the picture out of a message of this type; it gives None where there is none yet."""
    kind = kind_of(type_name)
    if kind == "CompressedVideo":
        return VideoDecoder(name)
    unpack = raw_picture if kind == "Image" else compressed_picture
    return lambda message: unpack(message, name)


def _guarded(messages: Iterator[tuple[int, Any]], name: str) -> Iterator[tuple[int, Any]]:
    """The same; whatever a parser raises on damaged bytes becomes a SourceError."""
    try:
        yield from messages
    except (SourceError, GeneratorExit):
        raise
    except OSError as error:
        raise SourceError(f"{name}: cannot be read: {error.strerror or error}") from error
    except Exception as error:
        raise damaged(name, error) from error
