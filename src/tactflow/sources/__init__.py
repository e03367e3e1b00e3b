"""Sources of frames: simulated sensors, files, folders, cameras, streams.

`open_source("recordings/wedge")` gives a `FrameReader`: call `read()` until it returns None, then `close()`.
"""

from __future__ import annotations

import glob
import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import cast

from tactflow.engine.errors import SourceError
from tactflow.recording import missing_packages
from tactflow.sources.base import Arrival, FrameReader
from tactflow.sources.devices import Camera, CameraRequest, Stream
from tactflow.sources.files import IMAGE_SUFFIXES, VIDEO_SUFFIXES, is_image, open_file
from tactflow.sources.memory import MemoryFrames
from tactflow.sources.paths import find_path, locate, split_prefix
from tactflow.sources.watch import Watch, Watched
from tactflow.system.files import is_utf8
from tactflow.system.plugins import plugins
from tactflow.system.redaction import public_address

__all__ = [
    "KINDS",
    "Arrival",
    "CameraRequest",
    "FrameReader",
    "Watch",
    "Watched",
    "open_source",
    "recording_suffixes",
    "sensors_in",
]

KINDS = (
    "sim:NAME?query (simulated sensor), a camera index, /dev/videoN or /dev/v4l/by-id/NAME, a video file, "
    "a folder or glob of images, a .npy file, an .mcap recording of tactflow, "
    "a ROS or Foxglove recording (.mcap, .bag or folder, with ?topic=), .h5, .zarr or .zarr.zip with "
    "?dataset=, .parquet with ?column=, a LeRobot dataset (a folder, with ?camera=KEY&episode=N), "
    "or an http://, rtsp:// or udp:// stream"
)
"""Description of valid sources, for messages, `--help` and the parameter `source` of `capture`."""

GROUP = "tactflow.sources"
"""Group of entry points for other kinds of files.

The name of an entry point is the suffix of a file or folder (`.h5`, `.zarr.zip`), the prefix of a path
without its colon (`lerobot`), or a file in a folder (`meta/info.json`). Its value is a function or class that
is called with `(spec, directory, fps)` of `open_source` and returns a `FrameReader`. A function `sensors` of
it, if any, is called with the path of a file, and returns the sources in it.
"""

_STREAMS = frozenset(["http", "https", "rtsp", "udp"])
_TABLES = frozenset([".parquet"])
"""Suffixes of recordings that tables of results have too."""
_BUILT_IN = frozenset(["", ".npy", ".npz", *IMAGE_SUFFIXES, *VIDEO_SUFFIXES])
"""Suffixes without a search for plug-ins, which takes some milliseconds."""


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
    directory : searched for relative paths after the current directory.
    fps : rate of recordings without one (images, arrays), frames per second; 30 by default.
    camera : size, rate and format to request from a camera.
    watch : monitor a camera or a stream, and reopen it after faults; without it, the first fault ends it.

    Raises
    ------
    SourceError
        If it cannot be opened; the message states a remedy.

    Examples
    --------
    >>> reader = open_source("sim:press?frames=2")
    >>> reader.size, reader.total, reader.live
    ((800, 600), 2, False)
    >>> image, t = reader.read()
    >>> image.shape, image.dtype, t
    ((600, 800, 3), dtype('uint8'), 0.0)
    >>> reader.close()

    The error for an invalid name lists the valid kinds:

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
        return _open_scene(spec)
    scheme = re.match(r"([A-Za-z][A-Za-z0-9+.-]+)://", spec)
    if scheme is not None:
        name, word = public_address(spec), scheme[1].lower()
        opener: Callable[[], FrameReader] = partial(Stream, spec)
        if word not in _STREAMS:
            hint = f"; for a file, leave out {word}://" if word == "file" else ""
            raise SourceError(f"{name}: unknown kind of source {word}://{hint}; required one of: {KINDS}")
    elif spec.isdecimal() or spec.startswith(("/dev/video", "/dev/v4l/")):
        name, opener = f"camera {spec}", partial(Camera, spec, camera)
    else:
        return _open_recording(spec, directory, fps)
    return opener() if watch is None else Watched(opener, watch, name)


def _open_scene(spec: str) -> FrameReader:
    from tactflow.sim import open_scene

    try:
        scene = open_scene(spec.removeprefix("sim:"))
    except ValueError as error:
        raise SourceError(f"{spec}: {error}") from error
    delivered = scene.delivered
    reader = MemoryFrames(map(scene.frame, delivered), scene.fps, delivered)
    reader.name, reader.size, reader.total = spec, scene.size, len(delivered)
    reader.description = f"{spec}, {reader.total} frames at {scene.fps:g} fps"
    return reader


def _open_recording(spec: str, directory: Path | None, fps: float | None) -> FrameReader:
    name, _, query = (spec, "", "") if locate(spec, directory) else spec.partition("?")
    is_pattern = glob.has_magic(name) and locate(name, directory) is None
    if name.lower().endswith(".mcap") and not query.startswith("topic=") and not is_pattern:
        find_path(name, directory)
        problem = missing_packages()
        if problem is not None:
            raise SourceError(f"{spec}: {problem}")
        from tactflow.recording.records import ForeignRecordingError
        from tactflow.sources.mcap import Recording

        try:
            return Recording(spec, directory)
        except SourceError as error:
            if query or not isinstance(error.__cause__, ForeignRecordingError):
                raise
    opener = _plugin(name, directory, is_pattern)
    return open_file(spec, directory, fps) if opener is None else opener(spec, directory, fps)


def sensors_in(spec: str) -> list[str]:
    """The sources in a file with pictures of several sensors, such as the topics of a bag; else itself.

    >>> sensors_in("sim:press")
    ['sim:press']
    """
    if locate(spec, None) is None:
        return [spec]
    sensors = getattr(_plugin(spec, None, False), "sensors", None)
    return [spec] if sensors is None else list(sensors(spec)) or [spec]


def _plugin(name: str, directory: Path | None, is_pattern: bool) -> Callable[..., FrameReader] | None:
    """What opens a file of this name, if it is a plug-in."""
    for key in _keys(name, directory, is_pattern):
        for point in plugins(GROUP):
            if point.name == key:
                try:
                    return cast(Callable[..., FrameReader], point.load())
                except Exception as error:
                    raise SourceError(
                        f"{name}: the plug-in {point.value} cannot be loaded: {error}"
                    ) from error
    return None


def _keys(name: str, directory: Path | None, is_pattern: bool) -> Iterator[str]:
    """The names of plug-ins that can open a source."""
    prefix, _ = split_prefix(name, directory)
    if prefix:
        yield prefix.removesuffix(":")
        return
    suffixes = [suffix.lower() for suffix in Path(name).suffixes]
    if suffixes and suffixes[-1] not in _BUILT_IN and not is_pattern:
        yield "".join(suffixes[-2:])
        yield suffixes[-1]
    path = locate(name, directory)
    if path is not None and path.is_dir():
        with suppress(OSError):
            if not any(map(is_image, path.iterdir())):
                yield from (point.name for point in plugins(GROUP) if (path / point.name).is_file())


def recording_suffixes() -> frozenset[str]:
    """Suffixes of files and folders that are a recording, including those of plug-ins; without `.parquet`.

    >>> {".avi", ".npy", ".mcap"} <= recording_suffixes()
    True
    """
    registered = (point.name for point in plugins(GROUP))
    suffixes = {name for name in registered if name.startswith(".")}
    return (VIDEO_SUFFIXES | {".npy", ".mcap"} | suffixes) - _TABLES
