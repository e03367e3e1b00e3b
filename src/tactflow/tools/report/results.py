"""Read the results of a run from a file: JSON Lines, a recording, or a format of a plug-in."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.engine.errors import ConfigError
from tactflow.message.result import Result
from tactflow.system.plugins import plugins
from tactflow.system.spelling import joined

GROUP: Final = "tactflow.results"
"""Entry points of plug-ins that read results: a suffix, or the name of a file inside a folder, -> a function
from a path to result messages. Raises ValueError for a file that it cannot read."""


def read_results(path: Path) -> Iterator[Result]:
    """The results in a file or folder, in the order in which they were written.

    Where the file has a picture of the frame, `frame.image` is the processed frame.

    Raises ConfigError if there is no such file, it cannot be read, or it holds no results.
    """
    read = _reader(path)
    found = False
    try:
        for result in read(path):
            found = True
            yield result
    except (ValueError, OSError) as error:
        raise ConfigError(f"{path}: {getattr(error, 'strerror', None) or error}") from None
    if not found:
        raise ConfigError(f"{path}: holds no results of tactflow")


def _reader(path: Path) -> Callable[[Path], Iterator[Result]]:
    if not path.exists():
        raise ConfigError(f"{path}: there is no such file")
    if path.suffix == ".mcap":
        return _read_recording
    if path.suffix in (".jsonl", ".json", ".ndjson"):
        return _read_lines
    points = plugins(GROUP)
    for point in points:
        inside = path.is_dir() and (path.name == point.name or (path / point.name).exists())
        if inside or point.name == path.suffix:
            messages = point.load()
            return lambda path: map(Result.from_message, messages(path))
    known = joined([".jsonl", ".mcap", *(point.name for point in points if point.name.startswith("."))])
    raise ConfigError(f"{path}: required results as {known}")


def _read_lines(path: Path) -> Iterator[Result]:
    """JSON Lines; an incomplete last line, as after a kill, is left out."""
    with path.open("rb") as file:
        for number, line in enumerate(file, 1):
            try:
                yield Result.from_message(line)
            except ValueError as error:
                if line.endswith(b"\n"):
                    raise ValueError(f"line {number}: {error}") from None


def _read_recording(path: Path) -> Iterator[Result]:
    """The results of a recording, with its previews as pictures."""
    from tactflow.recording import missing_packages

    problem = missing_packages()
    if problem is not None:
        raise ConfigError(problem)
    from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage

    from tactflow.recording.reader import look_into, messages
    from tactflow.recording.records import ForeignRecordingError, NotARecordingError

    try:
        contents = look_into(path)
    except (NotARecordingError, ForeignRecordingError) as error:
        raise ValueError(str(error)) from None
    sensor = contents.frame_topic.removesuffix("frames")
    pictures = {message.log_time: message.data for message in messages(path, [f"{sensor}image"])}
    for message in messages(path, [f"{sensor}results"]):
        result = Result.from_message(message.data)
        jpeg = pictures.get(message.log_time)
        if jpeg is not None:
            encoded = np.frombuffer(CompressedImage.FromString(jpeg).data, np.uint8)
            picture = cv2.imdecode(encoded, cv2.IMREAD_COLOR)
            if picture is not None:
                result = with_picture(result, np.asarray(picture, np.uint8))
        yield result


def with_picture(result: Result, picture: NDArray[np.uint8]) -> Result:
    """A copy of a result whose frame has this picture, (H, W, 3) uint8 BGR."""
    shown = copy(result)
    shown.frame = replace(result.frame, image=picture)
    return shown
