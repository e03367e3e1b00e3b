"""Capturing frames in the source's thread, with pausing and single steps."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from dataclasses import replace

from tactflow.engine.contract import Source
from tactflow.engine.ending import Ending
from tactflow.engine.errors import SourceError, TactflowError
from tactflow.engine.frame import Frame
from tactflow.engine.graph import Node
from tactflow.engine.node import DAMAGED, UNCONNECTED, RunningNode, Slots, TickState
from tactflow.engine.segment import NodeFailedError, Segment
from tactflow.engine.stats import NodeStats


class Capturing:
    """Takes frames from the source, and starts a tick for each with the sinks that want it.

    Parameters
    ----------
    node : of the source.
    slots : of the outputs of all nodes.
    max_frames : stop after so many; None: never.

    Attributes
    ----------
    slot : of the frames.
    frames : number so far.
    stats : of the source.
    paused : see `pause`.
    """

    def __init__(self, node: Node, slots: Slots, ending: Ending, max_frames: int | None) -> None:
        self._node = node
        self._ending = ending
        self._max_frames = max_frames
        self._table_size = UNCONNECTED + 1 + len(slots)
        self.slot = slots[node.id, node.component.ports.outputs[0].name]
        self.frames = 0
        self.stats = NodeStats()
        self.paused = False
        self._steps = 0
        self._turn = threading.Condition()

    def pause(self, paused: bool) -> None:
        """Pause or resume. Pending steps are discarded."""
        with self._turn:
            self.paused = paused
            self._steps = 0
            self._turn.notify_all()

    def step(self) -> None:
        """While paused, process one frame."""
        with self._turn:
            self._steps += self.paused
            self._turn.notify_all()

    def wake(self) -> None:
        """Look whether the run is stopping."""
        with self._turn:
            self._turn.notify_all()

    def loop(self, source: Source, sinks: Sequence[RunningNode], segment: Segment) -> None:
        """Body of the source's thread. segment : of the source."""
        place = f"{self._node.id} ({self._node.mark})"
        try:
            self._capture(source, sinks, segment)
        except NodeFailedError:
            pass
        except TactflowError as error:
            self._ending.fail(SourceError(f"{place}: {error}"))
        except BaseException as error:
            self._ending.fail(SourceError(f"{place}: {type(error).__name__}: {error}"), error)
        finally:
            self._ending.finish()
            for link, _ in segment.outputs:
                link.close()

    def _capture(self, source: Source, sinks: Sequence[RunningNode], segment: Segment) -> None:
        frames = iter(source.frames())
        stopping = self._ending.stopping
        index = 0
        whole: Frame | None = None
        while not stopping.is_set():
            segment.current = self._node.id
            began = time.perf_counter()
            try:
                frame = next(frames, None)
            finally:
                segment.current = None
            if frame is None:
                return
            if self.paused and not self._may_go_on(source.live):
                continue
            ended = time.perf_counter()
            if not frame.captured:
                frame = replace(frame, captured=ended)
            self.stats.durations.add(ended - began)
            self.frames += frame.seq >= 0
            demand = frozenset([node.id for node in sinks if _wants(node, frame)])
            tick = TickState(index, frame, demand, self._table_size)
            if frame.damaged:
                # Stages without memory repeat their results on the frame before it.
                self.stats.skips[DAMAGED.reason] += 1
                tick.reasons[self.slot] = DAMAGED.reason
            else:
                whole = frame
            tick.values[self.slot] = whole or DAMAGED
            index += 1
            segment.handle(tick)
            if self._max_frames is not None and self.frames >= self._max_frames:
                self._ending.stop("max_frames")

    def _may_go_on(self, live: bool) -> bool:
        """While paused, whether to process the captured frame; a recording waits for that."""
        stopping = self._ending.stopping
        with self._turn:
            if not live:
                self._turn.wait_for(lambda: not self.paused or self._steps or stopping.is_set())
            go = not self.paused or self._steps > 0
            self._steps = max(0, self._steps - 1)
            return go and not stopping.is_set()


def _wants(node: RunningNode, frame: Frame) -> bool:
    """Whether a sink wants a frame.

    A sink that takes references gets all of them; others get no reference image from outside the source.
    """
    sink = node.sink
    if sink is None or node.disabled:
        return False
    if frame.reference and node.node.component.delivery.takes_references:
        return True
    return frame.seq >= 0 and node.rate_limit.due(frame.t) and sink.wants()
