"""The threads of a run: one for each segment, connected by links."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection, Iterator, Mapping

from tactflow.engine.ending import Ending
from tactflow.engine.errors import StageError
from tactflow.engine.link import Link
from tactflow.engine.node import RunningNode, TickState
from tactflow.engine.plan import Plan
from tactflow.engine.segment import NewReferences, Segment
from tactflow.engine.stats import Durations

CLOSE_SECONDS = 10.0
"""Time without progress after which a stopped run reports the hanging stage, s. Chosen by hand: the slowest
stage takes a second."""
LEAVE_SECONDS = 1.0
"""Time for threads to end after an interrupt, s. Chosen by hand: the slowest stage takes as long."""


class Threads:
    """Runs the segments of a plan. Nothing runs before `start`.

    Attributes
    ----------
    links : of the plan.
    """

    def __init__(self, ending: Ending, retake: Callable[[], None]) -> None:
        self._ending = ending
        self._retake = retake
        self._segments: dict[str, Segment] = {}
        self._threads: dict[str, threading.Thread] = {}
        self.links: list[Link[TickState]] = []

    def start(
        self,
        plan: Plan,
        nodes: Mapping[str, RunningNode],
        frame_slot: int,
        capture: Callable[[Segment], None],
    ) -> None:
        """Connect the segments and start their threads.

        nodes : that are open. frame_slot : of the source's frames. capture : body of the source's thread,
        called with the source's segment.
        """
        for name in plan.segments:
            self._segments[name] = Segment(name, plan, nodes, self._ending, self._retake)
        for link_plan in plan.links:
            link: Link[TickState] = Link(link_plan.name, link_plan.capacity, link_plan.when_full)
            self.links.append(link)
            consumer = self._segments[link_plan.consumer]
            consumer.inputs.append(link)
            sinks = frozenset(node.id for node in consumer.nodes) if consumer.only_sinks else None
            self._segments[link_plan.producer].outputs.append((link, sinks))
        self._lead_new_references(plan, nodes, frame_slot)
        first = self._first
        for name, segment in self._segments.items():
            if segment is first:
                thread = threading.Thread(target=capture, args=(segment,))
            else:
                thread = threading.Thread(target=segment.loop)
            thread.name, thread.daemon = f"tactflow-{name}", True
            self._threads[name] = thread
        for thread in self._threads.values():
            thread.start()

    @property
    def _first(self) -> Segment | None:
        """The segment of the source."""
        return next(iter(self._segments.values()), None)

    def _lead_new_references(self, plan: Plan, nodes: Mapping[str, RunningNode], frame_slot: int) -> None:
        """Let the first segment with stages turn frames into references on request: a source runs ahead."""
        first = self._first
        assert first is not None
        if first.only_sinks:
            consumers = [self._segments[link.consumer] for link in plan.links if link.producer == first.name]
            with_stages = [segment for segment in consumers if not segment.only_sinks]
            if len(with_stages) != 1:
                return
            first = with_stages[0]
        takers = [id_ for id_, n in nodes.items() if n.node.component.delivery.takes_references]
        first.references = NewReferences(frame_slot, takers)

    @property
    def latency(self) -> Durations:
        """From capture to the end of each segment with sinks."""
        return Durations.joined(segment.latency for segment in self._segments.values())

    @property
    def dropped(self) -> int:
        """Number of frames dropped before the first segment of stages."""
        outputs = self._first.outputs if self._first else []
        links = [link for link, only_sinks in outputs if only_sinks is None]
        return max((link.drops for link in links), default=0)

    @property
    def in_use(self) -> Collection[str | None]:
        """Ids of the parts that threads are executing."""
        return {self._segments[name].current for name, t in self._threads.items() if t.is_alive()}

    def wait(self, interval_s: float) -> Iterator[None]:
        """Wait for the threads: without limit for the end of the source, with a limit after a stop.

        Yields about every `interval_s` seconds. Raises StageError that names what hangs.
        """
        done, since = -1, time.perf_counter()
        while alive := [name for name, thread in self._threads.items() if thread.is_alive()]:
            self._threads[alive[0]].join(interval_s)
            yield
            # Draining a long queue counts as progress.
            before, done = done, sum(s.calls for s in self._segments.values())
            done += sum(link.delivered for link in self.links)
            now = time.perf_counter()
            if done != before or not self._ending.hurried:
                since = now
            elif now - since > CLOSE_SECONDS:
                places = [f"{name} (in {self._segments[name].current or 'its source'})" for name in alive]
                self._abort_links()
                raise StageError(
                    f"the run was stopped, but has made no progress for {CLOSE_SECONDS:g} s: "
                    f"{', '.join(places)} hangs"
                )

    def leave(self) -> None:
        """After an interrupt: drop pending ticks, and wait a short time for the threads."""
        self._abort_links()
        until = time.perf_counter() + LEAVE_SECONDS
        for thread in self._threads.values():
            # The interrupt may have come before the start of the thread.
            if thread.is_alive():
                thread.join(max(0.0, until - time.perf_counter()))

    def _abort_links(self) -> None:
        for link in self.links:
            link.abort()
