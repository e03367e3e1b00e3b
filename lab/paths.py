"""How far a reader walks: files and functions of tactflow that run for a task, and steps back between them.

    python lab/paths.py                   # of the tactflow of this Python, which may be another checkout's

A function is counted once, however often it is called; lambdas and comprehensions belong to the function
around them, and compiled loops are not entered. A step back is a file that calls another one which is still
waiting for it further up the stack: the reader has left that file for this one, and is sent back. Pulling the
next item of a generator that was passed along is no step back. Steps are counted once for each pair of files.
"""

from __future__ import annotations

import contextlib
import inspect
import io
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import numpy as np

import tactflow
from tactflow.cli.main import main as command
from tactflow.ports import ContactMask
from tactflow.sinks import zmq
from tactflow.stages import hull
from tactflow.vision.types import Markers

HOME = Path(tactflow.__file__).parent
FOLDERS = (HOME, Path(hull.__file__).parent, Path(zmq.__file__).parent)
"""Where the code of tactflow lives, in a checkout and when it is installed."""
FRAMES = 60
"""Frames of the recording: nothing touches the gel, then a ball is pressed."""


class Trace:
    """Counts what runs, in all threads.

    Parameters
    ----------
    begin, end : whether a call opens, or closes, what is counted; None: all calls.

    Attributes
    ----------
    functions : (file, qualified name) of all that ran.
    back : (caller, called) files of all steps back.
    """

    def __init__(
        self,
        begin: Callable[[FrameType], bool] | None = None,
        end: Callable[[FrameType], bool] | None = None,
    ) -> None:
        self.functions: set[tuple[str, str]] = set()
        self.back: set[tuple[str, str]] = set()
        self._counting = begin is None
        self._begin, self._end = begin, end
        self._names: dict[CodeType, str | None] = {}

    def __enter__(self) -> Trace:
        threading.setprofile(self._profile)
        sys.setprofile(self._profile)
        return self

    def __exit__(self, *_: object) -> None:
        sys.setprofile(None)
        threading.setprofile(None)  # type: ignore[arg-type]  # typeshed has no None

    @property
    def files(self) -> set[str]:
        """Every file of which something ran."""
        return {file for file, _ in self.functions}

    def _file(self, code: CodeType) -> str | None:
        """End of the path of a function of tactflow; None for modules, class bodies and other code."""
        if code not in self._names:
            path = Path(code.co_filename)
            inside = code.co_flags & inspect.CO_OPTIMIZED and any(
                path.is_relative_to(folder) for folder in FOLDERS
            )
            self._names[code] = "/".join(path.parts[-3:]) if inside else None
        return self._names[code]

    def _profile(self, frame: FrameType, event: str, _: Any) -> None:
        if event != "call" or (called := self._file(frame.f_code)) is None:
            return
        if not self._counting and self._begin is not None and self._begin(frame):
            self._counting, self._begin = True, None
        if not self._counting:
            return
        if not frame.f_code.co_name.startswith("<"):
            self.functions.add((called, frame.f_code.co_qualname))
        if not frame.f_code.co_flags & inspect.CO_GENERATOR:
            stack = list(self._callers(frame))
            if stack and stack[0] != called and called in stack:
                self.back.add((stack[0], called))
        if self._end is not None and self._end(frame):
            self._counting = False

    def _callers(self, frame: FrameType) -> Iterator[str]:
        """Files of tactflow on the stack above a call, the nearest first."""
        above = frame.f_back
        while above is not None:
            if (file := self._file(above.f_code)) is not None:
                yield file
            above = above.f_back


class Mask(tactflow.Sink):
    """Needs the contact mask alone."""

    def write(self, contact_mask: ContactMask) -> None:
        """Nothing: it was computed."""


class Dots(tactflow.Sink):
    """Needs the dots alone."""

    def write(self, markers: Markers) -> None:
        """Nothing: they were found."""


def reads_frames(frame: FrameType) -> bool:
    """Whether a call is the one that starts to read frames."""
    return frame.f_code.co_qualname == "Capture.frames"


def makes_hull(frame: FrameType) -> bool:
    """Whether a call constructs the stage `hull`."""
    return frame.f_code.co_name == "__init__" and isinstance(frame.f_locals.get("self"), hull.Hull)


def of_frames(sink: type[tactflow.Sink], source: str) -> Trace:
    """From the first frame of a recording to what a sink needs."""
    settings = {"sinks": {"taken": {"use": f"{__name__}:{sink.__name__}"}}}
    pipeline = tactflow.load("default", source=source, settings=settings)
    with Trace(reads_frames) as trace:
        tactflow.run(pipeline)
    return trace


def of_stage(source: str) -> Trace:
    """From the text of a pipeline file to an instance of its stage `hull`."""
    with Trace(end=makes_hull) as trace:
        tactflow.run(
            tactflow.load("default", source=source, settings={"sinks.view": None, "sinks.zmq": None})
        )
    return trace


def of_command(*arguments: str) -> Trace:
    """A command, in this process."""
    texts = io.StringIO()
    with Trace() as trace, contextlib.redirect_stderr(texts), contextlib.redirect_stdout(texts):
        code = command(list(arguments))
    if code:
        raise SystemExit(f"{' '.join(arguments)}: exit code {code}\n{texts.getvalue()}")
    return trace


def main() -> None:
    """Print a table, and the steps back."""
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        scene = tactflow.open_scene(f"press?frames={FRAMES}")
        np.save("press.npy", np.stack([scene.frame(index) for index in range(FRAMES)]))
        traces = {
            "frame to contact mask": of_frames(Mask, "press.npy"),
            "frame to dots": of_frames(Dots, "press.npy"),
            "line of YAML to stage": of_stage("press.npy"),
            "calibrate": of_command("calibrate", "default", "--source", "press.npy", "--pitch", "1"),
            "batch": of_command("batch", "default", "press.npy", "--out", "results", "--quiet"),
        }
    print("| task | files | functions | steps back |", "| --- | ---: | ---: | ---: |", sep="\n")
    for task, trace in traces.items():
        print(f"| {task} | {len(trace.files)} | {len(trace.functions)} | {len(trace.back)} |")
    for task, trace in traces.items():
        print(f"\n{task}: back from -> to", *(f"  {a} -> {b}" for a, b in sorted(trace.back)), sep="\n")
        if "--all" in sys.argv:
            print(*(f"  {file} {name}" for file, name in sorted(trace.functions)), sep="\n")


if __name__ == "__main__":
    main()
