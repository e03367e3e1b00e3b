"""What an executor is given to do, and what it gives back."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Literal

import orjson
from pydantic import TypeAdapter

from tactflow.batch.digests import Fingerprint
from tactflow.batch.recordings import Recording

Format = Literal["parquet", "jsonl"]
Status = Literal["done", "failed", "set aside"]

Report = Callable[[int, int | None], None]
"""Told now and then how many frames are done, and how many there are, if that is known."""


@dataclass(frozen=True, slots=True)
class PipelineRequest:
    """Which pipeline, so that any process can load it.

    file : absolute. overrides : as for `--set`. sensor : of several; None is the only one. split : length of
    the parts that recordings are cut into, s, 0 for none. digest : what it must come to. versions : with
    which it does.
    """

    file: str
    overrides: tuple[str, ...]
    sensor: str | None
    split: float = 0.0
    digest: str = ""
    versions: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True, slots=True)
class Part:
    """Consecutive frames of a recording, by their `seq`.

    number : of the part, from 0. begin : the first frame that stages see. first, end : those that sinks see,
    from `first` to before `end`; of the last part, `end` is None.
    """

    number: int
    begin: int
    first: int
    end: int | None

    def holds(self, seq: int) -> bool:
        """Whether a frame is told of in this part."""
        return self.first <= seq and (self.end is None or seq < self.end)


@dataclass(frozen=True, slots=True)
class Task:
    """One recording to work on.

    folder : `--out`, absolute. scratch : the folder in it for what is not finished. verify : read results
    that are there instead of trusting their size and time. part : of the recording; None is all of it.
    """

    recording: Recording
    pipeline: PipelineRequest
    format: Format
    folder: str
    scratch: str
    verify: bool = False
    part: Part | None = None


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of one recording.

    key : of the result; empty if the recording could not be read. input, input_digest : the recording as it
    was read. result : file name in `results`. reused : an earlier call had done it.
    frames : processed. duration : time of the last frame, s. contacts, touching : how often something
    touched, and in how many frames. largest : contact area, px^2. started : Unix time. seconds : that it
    took. worker : host and process. attempts : times that a worker began it. disk_full : why it failed.
    notes : warnings.
    """

    recording: str
    name: str
    status: Status
    error: str | None = None
    key: str = ""
    pipeline: str = ""
    input: Fingerprint | None = None
    input_digest: str = ""
    result: str | None = None
    result_file: Fingerprint | None = None
    result_digest: str = ""
    reused: bool = False
    frames: int = 0
    dropped: int = 0
    duration: float = 0.0
    contacts: int = 0
    touching: int = 0
    largest: float = 0.0
    started: float = 0.0
    seconds: float = 0.0
    worker: str = ""
    attempts: int = 1
    disk_full: bool = False
    notes: Sequence[str] = ()
    versions: Mapping[str, str] = field(default_factory=dict[str, str])

    def of(self, recording: Recording) -> Outcome:
        """The same for a recording of another name."""
        return replace(self, recording=recording.source, name=recording.name)

    def encoded(self) -> bytes:
        """As JSON on one line."""
        return orjson.dumps(asdict(self))


_OUTCOME = TypeAdapter(Outcome)
_FIELDS = frozenset(field.name for field in fields(Outcome))


def decoded(text: bytes) -> Outcome | None:
    """The outcome that a line says, or None if it is damaged or of another version."""
    try:
        values = orjson.loads(text)
        # pydantic leaves out what it does not know; what another version knows more, counts for that one.
        return _OUTCOME.validate_python(values) if values.keys() == _FIELDS else None
    except (ValueError, AttributeError):
        return None


def result_name(recording: Recording, key: str, format_: Format) -> str:
    """Name of a result: for people the recording's, for the program the key.

    A result in Parquet is a folder of tables.

    >>> result_name(Recording("/data/press 1.avi", "press 1.avi"), "0123456789abcdef", "jsonl")
    'press_1.avi-0123456789ab.jsonl'
    """
    path = recording.path
    text = recording.source.removeprefix("sim:") if path is None else path.name
    safe = "".join(letter if letter.isalnum() or letter in "-_." else "_" for letter in text).lstrip(".")
    # 255 bytes is the longest name of a file; a letter takes four at most.
    return f"{safe[:50]}-{key[:12]}{'.jsonl' if format_ == 'jsonl' else ''}"
