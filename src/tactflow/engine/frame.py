"""Frames, ticks, and values that are absent for a reason."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from copy import copy
from dataclasses import dataclass
from typing import Any, Self, get_type_hints

import numpy as np
from numpy.typing import NDArray

MAX_PIXELS = int(os.environ["OPENCV_IO_MAX_IMAGE_PIXELS"])
"""Maximum number of pixels of a picture; see `tactflow/__init__.py`."""


@dataclass(frozen=True, slots=True)
class Frame:
    """One captured frame. Immutable; the image is read-only.

    Attributes
    ----------
    sensor : name of the sensor.
    seq : index of the frame at the source, from 0; a dropped frame leaves a gap. -1 for a reference image
        that was loaded from a file and is not part of the source.
    t : capture time, s: for a recording, time from its start; for a live source, Unix time.
    image : (H, W, 3) uint8 BGR, the raw picture, read-only.
    captured : monotonic clock (`time.perf_counter`) when the source delivered the frame, s; if it is 0, the
        run sets the time at which it received the frame.
    reference : True if this frame shows the untouched gel that later frames are compared with.
    epoch : incremented with each new reference; stages are reset between epochs.
    damaged : True if the image is not what the camera took, or shows no gel. No stage processes it: the
        results of the previous frame are repeated. Never a reference.

    Examples
    --------
    >>> Frame("main", 36, 1.2, np.zeros((600, 800, 3), np.uint8)).seq
    36
    """

    sensor: str
    seq: int
    t: float
    image: NDArray[np.uint8]
    captured: float = 0.0
    reference: bool = False
    epoch: int = 0
    damaged: bool = False


NO_PICTURE = np.zeros((0, 0, 3), np.uint8)
"""The image of a frame without pixels."""
NO_PICTURE.flags.writeable = False


@dataclass(frozen=True, slots=True)
class Absent:
    """Placeholder for a missing value; false in a condition.

    Attributes
    ----------
    reason : a short snake_case word.

    Examples
    --------
    >>> Absent("no_contact")
    Absent(reason='no_contact')
    """

    reason: str

    def __bool__(self) -> bool:
        return False


def read_only(value: Any) -> Any:
    """The value; for an array, a read-only view."""
    if isinstance(value, np.ndarray):
        value = value.view()
        value.flags.writeable = False
    return value


class Tick(Mapping[str, Any]):
    """The values computed for one frame: a mapping from port names to values.

    A missing value is an `Absent`. If two stages have an output of the same name, the name refers to the last
    one; `stage.port` refers to each of them.

    The annotated attributes of a subclass name ports; each becomes a property that is None if the value is
    absent. A sink whose `write` takes the subclass gets these ports::

        class Brightness(Tick):
            brightness: float | None

    Parameters
    ----------
    frame : the captured frame; its image is the raw one.
    values : port -> value or `Absent`. Not copied.
    skipped : port -> reason, for values that were not computed in this tick: absent values, and repeated ones
        (`unchanged`, `at_rest`). "reference" -> reason, if a stage requested this frame as a new reference.
        None: the reasons of the absent values.

    Examples
    --------
    >>> frame = Frame("main", 0, 0.0, np.zeros((4, 6, 3), np.uint8))
    >>> tick = Tick(frame, {"brightness": 31.5, "contact": Absent("no_contact")})
    >>> tick["brightness"], tick.value("contact"), tick.skipped
    (31.5, None, {'contact': 'no_contact'})
    """

    __slots__ = ("_values", "frame", "skipped")

    def __init__(
        self, frame: Frame, values: Mapping[str, Any] | None = None, skipped: Mapping[str, str] | None = None
    ) -> None:
        self.frame = frame
        self._values = {} if values is None else values
        if skipped is None:
            skipped = {port: value.reason for port, value in self.items() if isinstance(value, Absent)}
        self.skipped = skipped

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        for port in vars(cls).get("__annotations__", {}):
            if not port.startswith("_"):
                setattr(cls, port, _property_of(port))

    @classmethod
    def port_types(cls) -> dict[str, Any]:
        """Ports named by the class -> annotation."""
        hints = get_type_hints(cls, include_extras=True)
        return {port: hint for port, hint in hints.items() if not port.startswith("_")}

    def __getitem__(self, port: str) -> Any:
        try:
            return self._values[port]
        except KeyError:
            ports = ", ".join(self._values) or "no port"
            raise KeyError(f"no stage gives the port {port}; there are {ports}") from None

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    # Comparing arrays element by element has no single answer.
    __eq__ = object.__eq__
    __hash__ = object.__hash__

    def value(self, port: str) -> Any:
        """The value of a port; None if it is absent or there is no such port."""
        value = self._values.get(port)
        return None if value.__class__ is Absent else value

    def replace(self, **values: Any) -> Self:
        """A copy with changed values of some ports."""
        copied = copy(self)
        copied._values = {**self._values, **values}
        return copied

    def __repr__(self) -> str:
        frame, ports = self.frame, vars(type(self)).get("__annotations__") or self
        present = ", ".join(port for port in ports if self.value(port) is not None)
        name = type(self).__name__
        return f"<{name} {frame.sensor} {frame.seq} at {frame.t:.3f} s: {present or 'nothing'}>"


def _property_of(port: str) -> property:
    def value(tick: Tick) -> Any:
        return tick.value(port)

    return property(value, doc=f"The port {port}; None if it is absent.")
