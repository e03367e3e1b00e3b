"""tactflow: from camera frames of a tactile sensor to contact geometry and marker flow.

>>> import tactflow
>>> for result in tactflow.stream(source="sim:press", max_frames=60):
...     if result.contact is not None:
...         print(f"{result.t:.2f} s: contact at x = {result.contact.center[0]:.0f} px")
...         break
0.53 s: contact at x = 115 px

What `__all__` lists is public and changes only with a line in CHANGELOG.md. Plug-ins add names by the entry
points `tactflow.api`. Nothing is imported before it is used.
"""

from __future__ import annotations

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

# Pixels of a picture at most, so that no file takes all memory by what it claims: more than any camera has.
# OpenCV reads it when it is imported.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(1 << 27))

if TYPE_CHECKING:
    from tactflow.api import check as check
    from tactflow.api import load as load
    from tactflow.api import run as run
    from tactflow.api import stage as stage
    from tactflow.engine.contract import Sink as Sink
    from tactflow.engine.contract import Source as Source
    from tactflow.engine.contract import Stage as Stage
    from tactflow.engine.contract import StageParams as StageParams
    from tactflow.engine.errors import ConfigError as ConfigError
    from tactflow.engine.errors import TactflowError as TactflowError
    from tactflow.engine.frame import Absent as Absent
    from tactflow.engine.frame import Frame as Frame
    from tactflow.engine.frame import Tick as Tick
    from tactflow.message.result import Result as Result
    from tactflow.network.remote_control import RemoteControl as RemoteControl
    from tactflow.network.subscriber import Subscriber as Subscriber
    from tactflow.notebook import contact as contact
    from tactflow.notebook import draw as draw
    from tactflow.notebook import plot as plot
    from tactflow.notebook import to_frame as to_frame
    from tactflow.sim.scenes import open_scene as open_scene
    from tactflow.streaming import stream as stream
    from tactflow.vision.contact import ContactDetector as ContactDetector
    from tactflow.vision.geometry import Preprocessor as Preprocessor
    from tactflow.vision.markers.detection import detect_markers as detect_markers
    from tactflow.vision.markers.tracking import MarkerTracker as MarkerTracker
    from tactflow.vision.types import Contact as Contact
    from tactflow.vision.types import Flow as Flow
    from tactflow.vision.types import Markers as Markers
    from tactflow.vision.types import MarkerStatus as MarkerStatus

__version__ = "0.1.0"

_HOMES = {
    "tactflow.api": ("load", "check", "run", "stage"),
    "tactflow.streaming": ("stream",),
    "tactflow.notebook": ("contact", "draw", "plot", "to_frame"),
    "tactflow.network.subscriber": ("Subscriber",),
    "tactflow.network.remote_control": ("RemoteControl",),
    "tactflow.sim.scenes": ("open_scene",),
    "tactflow.vision.contact": ("ContactDetector",),
    "tactflow.vision.geometry": ("Preprocessor",),
    "tactflow.vision.markers.detection": ("detect_markers",),
    "tactflow.vision.markers.tracking": ("MarkerTracker",),
    "tactflow.vision.types": ("Contact", "Flow", "Markers", "MarkerStatus"),
    "tactflow.engine.contract": ("Stage", "Sink", "Source", "StageParams"),
    "tactflow.engine.frame": ("Frame", "Tick", "Absent"),
    "tactflow.message.result": ("Result",),
    "tactflow.engine.errors": ("TactflowError", "ConfigError"),
}
"""Module -> the public names that live there."""

_HOME = {name: module for module, names in _HOMES.items() for name in names}

__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    value = getattr(import_module(_HOME[name]), name) if name in _HOME else _of_plugin(name)
    globals()[name] = value
    return value


def _of_plugin(name: str) -> Any:
    from tactflow.system.plugins import plugins

    # Python itself asks for names in underscores, `__path__` and the like.
    points = () if name.startswith("_") else plugins("tactflow.api")
    for point in points:
        if point.name == name:
            return point.load()
    public = [*__all__, *(point.name for point in points)]
    raise AttributeError(f"tactflow has no {name}; public are {', '.join(public)}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
