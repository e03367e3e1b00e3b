"""Writes a recording file."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from mcap.writer import CompressionType, Writer

from tactflow.message.schema import message_schema
from tactflow.outputs import cannot_write, open_output, refuse_interference
from tactflow.recording.course import Glance
from tactflow.recording.schemas import channel_types

MEDIA_TYPES = {".json": "application/json", ".yaml": "application/yaml", ".npz": "application/octet-stream"}
UNLIMITED_CHUNK_BYTES = 1 << 62
"""Size limit of chunks, bytes: never reached, because each chunk ends with a frame."""


@dataclass(frozen=True, slots=True)
class Entry:
    """The encoded messages of a frame.

    Attributes
    ----------
    time : of the frame, ns.
    seq, reference, epoch : as in `Frame`.
    data : channel -> message; "frames" is the frame itself.
    glance : for the verdict; None for a reference image that is not part of the source.
    """

    time: int
    seq: int
    reference: bool
    epoch: int
    data: Mapping[str, bytes]
    glance: Glance | None = None


class RecordingWriter:
    """Writes a recording. After each `write`, all data has been passed to the operating system.

    Parameters
    ----------
    path : the file; its folder is created.
    sensor : names the channels.
    overwrite : replace an existing file.
    facts : name -> text, for the metadata.
    files : name -> content, to be attached.

    Attributes
    ----------
    frames, bytes : written so far.
    begins : log time of the first frame, ns.

    Raises
    ------
    StageError : from every method, if the file exists or cannot be written. Frames written before can be
    played.
    """

    def __init__(
        self,
        path: Path,
        sensor: str,
        *,
        facts: Mapping[str, str] | None = None,
        files: Mapping[str, bytes] | None = None,
        overwrite: bool = False,
    ) -> None:
        self.path = path
        self.frames = self.begins = self.bytes = 0
        self._sensor = sensor
        self._facts = facts or {}
        self._files = files or {}
        self._channels: dict[str, int] = {}
        self._file = open_output(path, overwrite=overwrite)
        self._writer = Writer(self._file, chunk_size=UNLIMITED_CHUNK_BYTES, compression=CompressionType.NONE)

    def begin(self) -> None:
        """Empty a file that is replaced, and write what precedes the frames. Called once, or by the first
        `write`."""
        if self._channels:
            return
        with self._errors():
            self._file.truncate(self._file.seek(0))
            self._writer.start(profile="", library="tactflow")
            self._describe()
            self._flush()

    def _describe(self) -> None:
        writer = self._writer
        for name, kind in channel_types().items():
            schema = writer.register_schema(kind.name, *kind.schema)
            self._channels[name] = writer.register_channel(f"/{self._sensor}/{name}", kind.packing, schema)
        writer.add_metadata("tactflow", dict(self._facts))
        schema_file = {"message.schema.json": json.dumps(message_schema(), indent=1).encode()}
        for name, data in {**schema_file, **self._files}.items():
            writer.add_attachment(0, 0, name, MEDIA_TYPES[Path(name).suffix], data)

    def write(self, entry: Entry, time: int | None = None) -> None:
        """Write the messages of a frame. time : log time, ns, if not that of the frame."""
        self.begin()
        at = max(entry.time if time is None else time, 0)
        with self._errors():
            for name, data in entry.data.items():
                channel = "references" if name == "frames" and entry.reference else name
                self._writer.add_message(
                    self._channels[channel],
                    log_time=at,
                    publish_time=at,
                    sequence=max(entry.seq, 0) & 0xFFFFFFFF,
                    data=data,
                )
            self._flush()
        self.begins = at if self.frames == 0 else self.begins
        self.frames += 1

    def finish(self) -> None:
        """Add the index and close the file. Without `begin`, it stays as it was."""
        if not self._channels:
            self.close()
            return
        with self._errors():
            self._refuse_interference()
            self._writer.finish()  # type: ignore[no-untyped-call]
            self.bytes = self._file.tell()
            self._file.close()

    def close(self) -> None:
        """Close the file; without an index if it was not finished."""
        # Bypass the buffer, which would retry a failed write.
        self._file.raw.close()

    def _flush(self) -> None:
        self._writer.flush()  # type: ignore[no-untyped-call]
        # After the write, so that no truncation between check and write goes unnoticed.
        self._refuse_interference()
        self.bytes = self._file.tell()

    def _refuse_interference(self) -> None:
        ours = os.fstat(self._file.fileno())
        refuse_interference(self.path, ours, f"its {self.frames} frames are not in it", self.bytes)

    @contextmanager
    def _errors(self) -> Iterator[None]:
        """Close the file on errors, and report which frames are complete."""
        try:
            yield
        except OSError as error:
            with suppress(OSError):
                os.ftruncate(self._file.fileno(), self.bytes)
            self.close()
            raise cannot_write(
                self.path,
                error,
                f"the {self.frames} frames written before are complete and can be played; "
                f"tactflow repair {self.path} adds the index",
            ) from error
        except BaseException:
            self.close()
            raise
