"""What every thread did and when, as Chrome trace events: opens in Perfetto or chrome://tracing.

One track per thread. On it, a slice per frame that holds a slice per stage that ran; an arrow (flow event)
leads from the frame in one thread to the same frame in the next. Times are those of `time.perf_counter`.
"""

from __future__ import annotations

import json
import time
from collections import deque
from collections.abc import Iterator, Mapping
from typing import Any, Literal

KEPT = 300_000
"""Events kept per thread, the newest: some five minutes of the shipped pipeline at 60 Hz, about 100 MB."""

TRACE_BEGINS = '{"displayTimeUnit": "ms", "traceEvents":'
"""How a file of events begins."""


class Track:
    """Events of one thread. Only that thread adds to it.

    events : (phase, name, begin in s, other keys).
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.events: deque[tuple[str, str, float, Mapping[str, Any]]] = deque(maxlen=KEPT)

    def add(self, name: str, began: float, ended: float, args: Mapping[str, Any]) -> None:
        """A slice from `began` to `ended`, s. args : shown when it is selected."""
        self.events.append(("X", name, began, {"dur": round((ended - began) * 1e6, 3), "args": args}))

    def arrow(self, end: Literal["s", "f"], link: str, tick: int, when: float) -> None:
        """Start or finish the arrow of a frame through a link; `when`, s, lies in the slice of that frame."""
        self.events.append((end, "frame", when, {"cat": "frame", "id": f"{link} {tick}", "bp": "e"}))


class Trace:
    """The tracks of one run.

    process : name of the run, shown above its tracks.
    """

    def __init__(self, process: str) -> None:
        self.process = process
        self.tracks: list[Track] = []
        self._zero = time.perf_counter()

    def track(self, name: str) -> Track:
        """Add a track."""
        self.tracks.append(Track(name))
        return self.tracks[-1]

    def lines(self) -> Iterator[str]:
        """The events as JSON, line by line. Call it when the run has ended."""
        yield f"{TRACE_BEGINS} ["
        for number, event in enumerate(self._events()):
            yield ("," if number else "") + json.dumps(event)
        yield "]}"

    def _events(self) -> Iterator[dict[str, Any]]:
        """Chrome trace events, in order of time on each track."""
        yield {"ph": "M", "pid": 1, "name": "process_name", "args": {"name": self.process}}
        for thread, track in enumerate(self.tracks, start=1):
            place = {"pid": 1, "tid": thread}
            yield {"ph": "M", **place, "name": "thread_name", "args": {"name": track.name}}
            yield {"ph": "M", **place, "name": "thread_sort_index", "args": {"sort_index": thread}}
            # Of two that begin together the longer one holds the other.
            events = sorted(track.events, key=lambda event: (event[2], -event[3].get("dur", 0.0)))
            for phase, name, began, others in events:
                ts = round((began - self._zero) * 1e6, 3)
                yield {"ph": phase, **place, "name": name, "ts": ts, **others}
