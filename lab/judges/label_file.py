"""Labels of single frames, drawn by a person: one JSON file with a list of entries, one for each frame."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Self

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    FiniteFloat,
    NonNegativeInt,
    TypeAdapter,
    ValidationError,
    model_validator,
)

from tactflow.engine.errors import ConfigError, StageError
from tactflow.system.files import completed

Point = tuple[FiniteFloat, FiniteFloat]
"""(x, y) in pixels of the raw picture: x right, y down, (0, 0) is the centre of the top left pixel."""


class FrameLabel(BaseModel):
    """What a person sees in one frame, compared with a reference frame of the untouched gel.

    recording : its name, or its path relative to a folder of recordings.
    frame, reference : an index from 0, or the name of a picture's file without its suffix.
    lab : where the recording comes from. round : 1 for first labels; 2 for independent second ones, which
    measure the scatter.
    contact : whether something touches the gel; None if the person cannot tell.
    outlines : of the contact, each of 3 points (x, y) or more, raw px; only where contact is True.
    dots : centres (x, y) of all markers, raw px; None if nobody marked them.

    >>> FrameLabel(recording="left", frame="007", reference="000", contact=False).round
    1
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    recording: str = Field(min_length=1)
    frame: NonNegativeInt | str
    reference: NonNegativeInt | str
    lab: str = ""
    round: int = Field(1, ge=1)
    contact: bool | None
    outlines: tuple[tuple[Point, ...], ...] = ()
    dots: tuple[Point, ...] | None = None

    @property
    def key(self) -> tuple[str, int | str, int]:
        """(recording, frame, round): a file has one label of each."""
        return self.recording, self.frame, self.round

    @property
    def index(self) -> int:
        """Index of the frame. Raises ConfigError where it is the name of a picture."""
        if not isinstance(self.frame, int):
            raise ConfigError(f"{self.recording}: frame {self.frame!r}; required an index from 0")
        return self.frame

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.outlines and self.contact is not True:
            raise ValueError("outlines require contact true")
        if any(len(outline) < 3 for outline in self.outlines):
            raise ValueError("an outline requires 3 points or more")
        return self


_LABELS = TypeAdapter(list[FrameLabel])


def load_labels(path: Path) -> list[FrameLabel]:
    """Read a file of labels, in its order.

    Raises ConfigError if the file cannot be read or is not JSON, an entry is wrong, or a frame has two labels
    of one round. The message names the entry, counted from 1, and the key.
    """
    try:
        labels = _LABELS.validate_json(path.read_bytes(), strict=True)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror or error}") from error
    except ValidationError as error:
        detail = error.errors()[0]
        entry, *keys = detail["loc"] or ("",)
        place = [f"entry {entry + 1}"] if isinstance(entry, int) else ["not a file of labels"]
        place += [".".join(map(str, keys))] if keys else []
        message = detail["msg"].removeprefix("Value error, ")
        raise ConfigError(f"{path}: {', '.join(place)}: {message}") from error
    places: dict[tuple[str, int | str, int], int] = {}
    for number, label in enumerate(labels, 1):
        if label.key in places:
            raise ConfigError(
                f"{path}: entry {number}: the same frame and round as entry {places[label.key]}"
            )
        places[label.key] = number
    return labels


def save_labels(path: Path, labels: Sequence[FrameLabel]) -> None:
    """Write a file of labels, one line each.

    Raises StageError if the file cannot be written; an earlier one is then unchanged.
    """
    entries = [label.model_dump(exclude={"dots"} if label.dots is None else None) for label in labels]
    lines = [json.dumps(entry, ensure_ascii=False) for entry in entries]
    try:
        with completed(path) as partial:
            partial.write_text("[\n" + ",\n".join(lines) + "\n]\n", encoding="utf-8")
    except OSError as error:
        raise StageError(f"{path}: cannot be written: {error.strerror or error}") from error
