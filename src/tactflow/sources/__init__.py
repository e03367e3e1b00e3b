"""What capture opens: simulated sensors, files, folders, cameras, streams.

`open_source("recordings/wedge")` gives a `FrameReader`: call `read()` until it returns None, then `close()`.
"""

from __future__ import annotations

import glob
import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, cast

from tactflow.engine.errors import SourceError
from tactflow.sources.base import FrameReader, StampedReader
from tactflow.sources.devices import Camera, CameraRequest, Stream
from tactflow.sources.files import IMAGE_SUFFIXES, VIDEO_SUFFIXES, is_image, open_recording
from tactflow.sources.paths import exists, split_prefix
from tactflow.sources.watch import Arrival, Watch, Watched
from tactflow.system.files import expanded, is_utf8
from tactflow.system.plugins import plugins
from tactflow.system.redaction import public_address

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

__all__ = [
    "KINDS",
    "Arrival",
    "CameraRequest",
    "FrameReader",
    "StampedReader",
    "Watch",
    "Watched",
    "open_source",
    "recording_suffixes",
]

KINDS = (
    "sim:NAME?query (simulated sensor), a camera index, /dev/videoN or /dev/v4l/by-id/NAME, a video file, "
    "a folder or glob of images, a .npy file, an .mcap recording of tactflow, "
    "a ROS or Foxglove recording (.mcap, .bag or folder, with ?topic=), .h5 or .zarr with ?dataset=, "
    "lerobot:PATH?camera=KEY&episode=N, or an http://, rtsp:// or udp:// stream"
)
"""What a source can be, for people: in messages, in `--help`, and for the parameter `source` of `capture`."""

GROUP = "tactflow.sources"
"""Group of entry points that open other kinds of files.

The name of an entry point is what it recognises: the suffix of a file or folder (`.h5`), a word and a colon
in front of a path (`lerobot`), or a file that such a folder contains (`metadata.yaml`). Its value is a
function or class that is called with `(spec, directory, fps)` of `open_source` and returns a `FrameReader`.
"""

_STREAMS = frozenset(["http", "https", "rtsp", "udp"])
_BUILT_IN = frozenset(["", ".npy", ".npz", *IMAGE_SUFFIXES, *VIDEO_SUFFIXES])
"""Suffixes for which no plug-in is looked for: that takes some milliseconds."""


def open_source(
    spec: str,
    *,
    directory: Path | None = None,
    fps: float | None = None,
    camera: CameraRequest | None = None,
    watch: Watch | None = None,
) -> FrameReader:
    """Open a source of frames.

    Parameters
    ----------
    spec : one of `KINDS`, such as `sim:press?frames=300&seed=7` or `recording.avi`.
    directory : where a relative path is looked for if it is not in the current directory.
    fps : rate of recordings that do not state one (images, arrays), frames per second; 30 by default.
    camera : size, rate and format to ask a camera for.
    watch : watch a camera or a stream, and open it again after faults; without it, the first fault ends it.

    Raises
    ------
    SourceError
        If it cannot be opened; the message says what to try.

    Examples
    --------
    >>> reader = open_source("sim:press?frames=2")
    >>> reader.size, reader.total, reader.live
    ((800, 600), 2, False)
    >>> image, t = reader.read()
    >>> image.shape, image.dtype, t
    ((600, 800, 3), dtype('uint8'), 0.0)
    >>> reader.close()

    The error for a wrong name lists what there is:

    >>> open_source("ftp://camera")
    Traceback (most recent call last):
    tactflow.engine.errors.SourceError: ftp://camera: unknown kind of source ftp://; required one of: ...
    """
    spec = spec.strip()
    if not is_utf8(spec):
        raise SourceError(f"{spec}: is not UTF-8; rename the file")
    if not spec:
        raise SourceError(f"the source is empty; required one of: {KINDS}")
    if spec.startswith("sim:"):
        from tactflow.sources.simulated import Simulated

        return Simulated(spec)
    scheme = re.match(r"([A-Za-z][A-Za-z0-9+.-]+)://", spec)
    if scheme is not None:
        return _open_stream(spec, scheme[1].lower(), watch)
    if spec.isdecimal() or spec.startswith(("/dev/video", "/dev/v4l/")):
        return _watched(partial(Camera, spec, camera), watch, f"camera {spec}")
    name, _, query = (spec, "", "") if exists(spec, directory) else spec.partition("?")
    if name.lower().endswith(".mcap") and not query.startswith("topic=") and not _is_pattern(name, directory):
        from tactflow.sources.mcap import Recording

        return Recording(spec, directory)
    opener = _plugin(name, directory)
    return opener(spec, directory, fps) if opener is not None else open_recording(spec, directory, fps)


def recording_suffixes() -> frozenset[str]:
    """Suffixes of files and folders that are a single recording: built-in kinds and those of plug-ins.

    >>> {".avi", ".npy", ".mcap"} <= recording_suffixes()
    True
    """
    registered = (point.name for point in plugins(GROUP))
    return VIDEO_SUFFIXES | {".npy", ".mcap"} | {name for name in registered if name.startswith(".")}


def _open_stream(spec: str, scheme: str, watch: Watch | None) -> FrameReader:
    address = public_address(spec)
    if scheme in _STREAMS:
        return _watched(partial(Stream, spec), watch, address)
    hint = f"; for a file, leave out {scheme}://" if scheme == "file" else ""
    raise SourceError(f"{address}: unknown kind of source {scheme}://{hint}; required one of: {KINDS}")


def _watched(opener: Callable[[], FrameReader], watch: Watch | None, name: str) -> FrameReader:
    return opener() if watch is None else Watched(opener, watch, name)


def _is_pattern(name: str, directory: Path | None) -> bool:
    return glob.has_magic(name) and not exists(name, directory)


def _plugin(name: str, directory: Path | None) -> Callable[..., FrameReader] | None:
    """What opens a file, folder or `word:PATH` that is not built in; None if nothing does."""
    for key in _keys(name, directory):
        for point in plugins(GROUP):
            if point.name == key:
                return _load(name, point)
    return None


def _load(name: str, point: EntryPoint) -> Callable[..., FrameReader]:
    try:
        return cast(Callable[..., FrameReader], point.load())
    except Exception as error:
        raise SourceError(f"{name}: the plug-in {point.value} cannot be loaded: {error}") from error


def _keys(name: str, directory: Path | None) -> Iterator[str]:
    """The names that a plug-in may have to open this."""
    prefix, _ = split_prefix(name, directory)
    if prefix:
        yield prefix.removesuffix(":")
        return
    suffix = Path(name).suffix.lower()
    if suffix not in _BUILT_IN and not _is_pattern(name, directory):
        yield suffix
    for base in (Path(), directory or Path()):
        with suppress(OSError, ValueError):
            files = sorted((base / expanded(name)).iterdir())
            if not any(map(is_image, files)):
                yield from (file.name for file in files)
