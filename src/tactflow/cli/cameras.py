"""`tactflow cameras`: what is plugged in, with stable names."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

from tactflow.sources.cameras import CameraInfo, list_cameras
from tactflow.system.terminal import say, show

NO_CAMERA = """no camera is plugged in (there is no /dev/video*)
  plug it in and look at the last lines of: sudo dmesg
  in a virtual machine or a container, pass it through first (docker run --device /dev/video0 ...)
  a network camera is not listed: give its address, --source rtsp://..."""

NO_NAMES = """on this system, cameras have no names, only numbers in the order in which they were connected
  try: tactflow run --source 0, then 1, 2, ..."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `cameras`."""
    parser.set_defaults(dev=Path("/dev"))


def run(args: argparse.Namespace) -> int:
    """List the cameras; returns the exit code, which is 0 even without a camera."""
    if not sys.platform.startswith("linux"):
        say(NO_NAMES)
        return 0
    cameras = list_cameras(args.dev)
    if not cameras:
        say(NO_CAMERA)
    for camera in cameras:
        show(describe(camera))
    return 0


def describe(camera: CameraInfo) -> Iterator[str]:
    """A camera in words: the name to use first, then what else is known."""
    yield camera.source
    yield f"    {camera.name}{': ' if camera.name else ''}{camera.device} (--source {camera.index})"
    yield from (f"    also {name}" for name in camera.names[1:])
    if camera.problem:
        yield f"    cannot be queried: {camera.problem}"
    if not camera.pictures:
        yield "    delivers only metadata, no pictures"
