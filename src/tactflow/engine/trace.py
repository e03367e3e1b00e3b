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

Hop = tuple[str, int]
"""One frame's way through one link: (link, index of the tick)."""


TRACE_BEGINS = '{"displayTimeUnit": "ms", "traceEvents":'
"""How a file of events begins."""


class Track:
    """Events of one thread. Only that thread adds to it.

    slices : (name, began and ended in s, what is shown with it). hops : (start or finish of an arrow, which
    one, when in s).
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.slices: deque[tuple[str, float, float, Mapping[str, Any]]] = deque(maxlen=KEPT)
        self.hops: deque[tuple[Literal["s", "f"], Hop, float]] = deque(maxlen=KEPT)

    def add(self, name: str, began: float, ended: float, args: Mapping[str, Any]) -> None:
        """A slice from `began` to `ended`, s. args : shown when it is selected."""
        self.slices.append((name, began, ended, args))

    def leaves(self, hop: Hop) -> None:
        """A frame is handed to a link, now."""
        self.hops.append(("s", hop, time.perf_counter()))

    def arrives(self, hop: Hop, when: float) -> None:
        """A frame has come out of a link; `when` lies in the slice of that frame."""
        self.hops.append(("f", hop, when))


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
        for number, event in enumerate(self.events()):
            yield ("," if number else "") + json.dumps(event)
        yield "]}"

    def events(self) -> Iterator[dict[str, Any]]:
        """Chrome trace events, in order of time on each track.

        An arrow is given only where both of its ends are known: a frame that a link dropped has none.
        """
        yield {"ph": "M", "pid": 1, "name": "process_name", "args": {"name": self.process}}
        ends = {"s": set[Hop](), "f": set[Hop]()}
        for track in self.tracks:
            for end, hop, _ in track.hops:
                ends[end].add(hop)
        numbers = {hop: number for number, hop in enumerate(sorted(ends["s"] & ends["f"]), start=1)}
        for thread, track in enumerate(self.tracks, start=1):
            place = {"pid": 1, "tid": thread}
            yield {"ph": "M", **place, "name": "thread_name", "args": {"name": track.name}}
            yield {"ph": "M", **place, "name": "thread_sort_index", "args": {"sort_index": thread}}
            found: list[dict[str, Any]] = []
            for name, began, ended, args in track.slices:
                ts = self._micros(began)
                dur = round(self._micros(ended) - ts, 3)
                found.append({"ph": "X", **place, "name": name, "ts": ts, "dur": dur, "args": dict(args)})
            for end, hop, when in track.hops:
                if hop in numbers:
                    arrow = {"name": "frame", "cat": "frame", "id": numbers[hop], "ts": self._micros(when)}
                    found.append({"ph": end, **place, **arrow, **({"bp": "e"} if end == "f" else {})})
            # Of two that begin together the longer one holds the other.
            found.sort(key=lambda event: (event["ts"], -event.get("dur", 0.0)))
            yield from found

    def _micros(self, seconds: float) -> float:
        return round((seconds - self._zero) * 1e6, 3)
