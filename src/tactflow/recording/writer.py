"""Writes recordings."""

from __future__ import annotations

import io
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, cast

from mcap.writer import CompressionType, Writer

from tactflow.message.schema import message_schema
from tactflow.recording.frames import DESCRIPTOR, TYPE_NAME
from tactflow.recording.schemas import channel_types
from tactflow.system.files import claim, make_folder, taken_away

NEVER = 1 << 62
"""Size at which a chunk would end by itself, bytes: they are ended by hand."""
_OVERHEAD = 200
"""About what an entry takes in memory beside its data, bytes: the object and its fields. Chosen by hand."""


@dataclass(frozen=True, slots=True)
class Entry:
    """What is recorded about one frame, ready to be written.

    time : of the frame, ns. seq, reference, epoch : as in `Frame`.
    frame : `tactflow.RawFrame`. message : the result message, or None. picture, annotations : of Foxglove, a
    `CompressedImage` and the `ImageAnnotations` on it, or None.
    """

    time: int
    seq: int
    reference: bool
    epoch: int
    frame: bytes
    message: bytes | None = None
    picture: bytes | None = None
    annotations: bytes | None = None

    @property
    def size(self) -> int:
        """Bytes of memory, about."""
        others = (self.message, self.picture, self.annotations)
        return len(self.frame) + sum(len(other or b"") for other in others) + _OVERHEAD


@dataclass(frozen=True, slots=True)
class About:
    """What a recording says about itself.

    sensor : name. facts : metadata, such as versions. texts : attachments by name, in UTF-8. arrays : others,
    as the bytes of `.npz` files.
    """

    sensor: str
    facts: Mapping[str, str] = field(default_factory=dict[str, str])
    texts: Mapping[str, str] = field(default_factory=dict[str, str])
    arrays: Mapping[str, bytes] = field(default_factory=dict[str, bytes])


class RecordingWriter:
    """One file that is being recorded.

    After each `write` all of it is with the operating system.

    Parameters
    ----------
    path : the file; its folder is created.
    about : written at once.
    overwrite : replace an existing file.

    Raises
    ------
    OSError
        If the file is there already (FileExistsError) or cannot be written.

    Examples
    --------
    >>> import numpy as np
    >>> from tempfile import TemporaryDirectory
    >>> from tactflow.engine.frame import Frame
    >>> from tactflow.recording.frames import FrameCoder
    >>> from tactflow.recording.reader import look_into
    >>> packed = FrameCoder().encode(Frame("main", 0, 0.0, np.zeros((6, 8, 3), np.uint8)))
    >>> with TemporaryDirectory() as folder:
    ...     writer = RecordingWriter(Path(folder, "press.mcap"), About("main"))
    ...     writer.write(Entry(time=0, seq=0, reference=True, epoch=0, frame=packed))
    ...     writer.finish()
    ...     contents = look_into(Path(folder, "press.mcap"))
    >>> contents.finished, contents.frames, contents.frame_topic
    (True, 1, '/main/frames')
    """

    def __init__(self, path: Path, about: About, *, overwrite: bool = False) -> None:
        self.path = path
        self.frames = 0
        make_folder(path.parent)
        self._file = _WholeRecords(path, overwrite=overwrite)
        try:
            self._writer = Writer(
                cast("IO[bytes]", self._file), chunk_size=NEVER, compression=CompressionType.NONE
            )
            self._writer.start(profile="", library="tactflow")
            self._describe(about)
            self._file.keep()
        except BaseException:
            self._file.close()
            raise

    @property
    def bytes(self) -> int:
        """Length of the file so far."""
        return self._file.tell()

    def _describe(self, about: About) -> None:
        writer, name = self._writer, about.sensor
        frame_type = writer.register_schema(TYPE_NAME, "protobuf", DESCRIPTOR)
        self._frames = writer.register_channel(f"/{name}/frames", "protobuf", frame_type)
        self._references = writer.register_channel(f"/{name}/references", "protobuf", frame_type)
        self._others = {
            channel: writer.register_channel(
                f"/{name}/{channel}", kind.packing, writer.register_schema(kind.name, *kind.schema)
            )
            for channel, kind in channel_types().items()
        }
        writer.add_metadata("tactflow", dict(about.facts))
        texts = {"message.schema.json": json.dumps(message_schema(), indent=1)} | dict(about.texts)
        for file, text in texts.items():
            kind = "application/json" if file.endswith(".json") else "application/yaml"
            writer.add_attachment(0, 0, file, kind, text.encode())
        for file, data in about.arrays.items():
            writer.add_attachment(0, 0, file, "application/octet-stream", data)

    def write(self, entry: Entry, time: int | None = None) -> None:
        """Add one frame and what belongs to it.

        time : on the file's time line, ns, if it is not the frame's own.

        Raises
        ------
        OSError
            If not all of it could be written. The file then ends after the frame before.
        """
        at = entry.time if time is None else time
        number = max(entry.seq, 0) & 0xFFFFFFFF
        frames = self._references if entry.reference else self._frames
        parts: Sequence[tuple[int, bytes | None]] = (
            (frames, entry.frame),
            (self._others["results"], entry.message),
            (self._others["image"], entry.picture),
            (self._others["annotations"], entry.annotations),
        )
        for channel, data in parts:
            if data is not None:
                self._writer.add_message(
                    channel, log_time=max(at, 0), publish_time=max(at, 0), sequence=number, data=data
                )
        self._writer.flush()  # type: ignore[no-untyped-call]
        self._file.keep()
        self.frames += 1

    def interference(self) -> str | None:
        """What another program has done to the file: "removed", "replaced", "cut", or None, nothing."""
        return self._file.interference(self.path)

    def finish(self) -> None:
        """Add the index and close the file. Raises OSError as `write` does."""
        try:
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._file.keep()
        finally:
            self._file.close()

    def abandon(self) -> None:
        """Close the file as it is, without an index."""
        self._file.close()


class _WholeRecords(io.BufferedIOBase):
    """A file that, after a failed write, ends where `keep` was called last.

    Nothing is held back in this process: what was written survives it.
    """

    def __init__(self, path: Path, *, overwrite: bool) -> None:
        super().__init__()
        create = 0 if overwrite and path.exists() else os.O_CREAT | os.O_EXCL
        # At the end whatever happens: a file that another program has cut then stays too short.
        flags = os.O_RDWR | os.O_APPEND | getattr(os, "O_BINARY", 0) | create
        self._file = os.fdopen(os.open(path, flags, 0o666), "r+b", buffering=0)
        claim(self._file)
        self._file.truncate()
        self._kept = 0
        self._at = 0

    def writable(self) -> bool:
        return True

    def write(self, data: bytes) -> int:  # type: ignore[override]
        view = memoryview(data)
        done = 0
        try:
            # An unbuffered file may take only a part, and says why at the next attempt.
            while done < len(view):
                done += self._file.write(view[done:])
        except OSError:
            os.ftruncate(self._file.fileno(), self._kept)
            raise
        self._at += done
        return done

    def tell(self) -> int:
        return self._at

    def interference(self, path: Path) -> str | None:
        ours = os.fstat(self._file.fileno())
        return taken_away(path, ours) or ("cut" if ours.st_size < self._at else None)

    def keep(self) -> None:
        """Everything so far is whole."""
        self._kept = self._at

    def close(self) -> None:
        self._file.close()
        super().close()
