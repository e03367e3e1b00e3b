"""What capture opens: simulated sensors, files, folders, cameras, streams.

`open_source("recordings/wedge")` gives a `FrameReader`: call `read()` until it returns None, then `close()`.
"""

from __future__ import annotations

import glob
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path

from tactflow.engine.errors import SourceError
from tactflow.sources.base import FrameReader, StampedReader
from tactflow.sources.devices import ArrivalClock, Camera, CameraRequest, Stream
from tactflow.sources.files import open_recording
from tactflow.sources.health import Watch
from tactflow.sources.watch import Arrival, LiveReader, Watched
from tactflow.system.files import expanded, is_utf8
from tactflow.system.redaction import public_address

__all__ = [
    "KINDS",
    "Arrival",
    "CameraRequest",
    "FrameReader",
    "LiveReader",
    "StampedReader",
    "Watch",
    "Watched",
    "open_source",
]

KINDS = (
    "sim:NAME?query (simulated sensor), a camera index, /dev/videoN or /dev/v4l/by-id/NAME, a video file, "
    "a folder or glob of images, a .npy file, an .mcap recording of tactflow, "
    "a ROS or Foxglove recording (.mcap, .bag or folder, with ?topic=), .h5 or .zarr with ?dataset=, "
    "lerobot:PATH?camera=KEY&episode=N, or an http://, rtsp:// or udp:// stream"
)
"""What a source can be, for people: in messages, in `--help`, and for the parameter `source` of `capture`."""

_STREAMS = frozenset(["http", "https", "rtsp", "udp"])


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
    fps : rate of recordings that do not know their own (images, arrays), frames per second; 30 by default.
    camera : size, rate and format to ask a camera for.
    watch : watch a camera or a stream, and open it anew after faults; without it, the first fault ends it.

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

    A wrong name says what there is:

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
        return _open_stream(spec, scheme[1], watch)
    if spec.isdecimal() or spec.startswith(("/dev/video", "/dev/v4l/")):
        return _live(partial(Camera, spec, camera, ArrivalClock()), watch, f"camera {spec}")
    reader = _open_container(spec, directory, fps)
    if reader is not None:
        return reader
    return open_recording(spec, directory, fps)


def _open_container(spec: str, directory: Path | None, fps: float | None) -> FrameReader | None:
    """A file or folder in which frames are one thing among others; None if it is none."""
    if spec.startswith("lerobot:"):
        from tactflow.sources.lerobot import LeRobotEpisode

        return LeRobotEpisode(spec, directory)
    bases = (Path(), directory or Path())
    there = any((base / expanded(spec)).exists() for base in bases)
    name, _, query = (spec, "", "") if there else spec.partition("?")
    suffix = Path(name).suffix.lower()
    if glob.has_magic(name) and not there:
        return None
    if suffix == ".mcap" and not query.startswith("topic="):
        from tactflow.sources.mcap import Recording

        return Recording(spec, directory)
    if suffix in (".mcap", ".bag", ".db3") or any(_is_rosbag2(base / expanded(name)) for base in bases):
        from tactflow.sources.bags import Bag

        return Bag(spec, directory)
    if suffix in (".h5", ".hdf5", ".zarr"):
        from tactflow.sources.datasets import ArrayDataset

        return ArrayDataset(spec, directory, fps)
    return None


def _is_rosbag2(folder: Path) -> bool:
    """Whether ROS 2 recorded into this folder: others have a metadata.yaml too."""
    try:
        with (folder / "metadata.yaml").open("rb") as file:
            return b"rosbag2_bagfile_information" in file.read(4096)
    except OSError:
        return False


def _open_stream(spec: str, scheme: str, watch: Watch | None) -> FrameReader:
    if scheme.lower() in _STREAMS:
        return _live(partial(Stream, spec, ArrivalClock()), watch, public_address(spec))
    hint = f"; for a file, leave out {scheme}://" if scheme.lower() == "file" else ""
    raise SourceError(
        f"{public_address(spec)}: unknown kind of source {scheme}://{hint}; required one of: {KINDS}"
    )


def _live(opener: Callable[[], FrameReader], watch: Watch | None, name: str) -> FrameReader:
    """The source itself, or watched. One clock serves all connections, so that times never step back."""
    return opener() if watch is None else Watched(opener, watch, name)
