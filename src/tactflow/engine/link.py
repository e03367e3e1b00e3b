"""A bounded queue between two segments, with a named policy for when it is full."""

from __future__ import annotations

import threading
import time
from collections import deque
from dataclasses import dataclass
from typing import Generic, TypeVar

from tactflow.engine.graph import FullPolicy

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class LinkStats:
    """Counters of a link. After the run, offered == delivered + drops."""

    policy: FullPolicy
    capacity: int
    offered: int
    delivered: int
    drops: int
    high_water: int
    blocked_s: float


class Link(Generic[T]):
    """One producer, one consumer, at most `capacity` items.

    when_full : "block" makes the producer wait (nothing is lost); "latest" keeps one slot and overwrites it;
    "drop_oldest" discards the oldest item. Order is kept, so a consumer never sees an older item after a
    newer one. End of stream is a flag, not an item: it cannot be dropped.
    """

    def __init__(self, name: str, capacity: int, when_full: FullPolicy) -> None:
        if capacity < 1:
            raise ValueError(f"link {name}: capacity must be at least 1, got {capacity}")
        self.name = name
        self.when_full: FullPolicy = when_full
        self.capacity = 1 if when_full == "latest" else capacity
        self._items: deque[tuple[T, bool]] = deque()
        self._lock = threading.Lock()
        self._changed = threading.Condition(self._lock)
        self._closed = False
        self._aborted = False
        self._offered = self._delivered = self._drops = self._high_water = 0
        self._blocked = 0.0

    def put(self, item: T, *, keep: bool = False) -> None:
        """Offer an item. `keep` marks one that no policy may drop, such as a reference frame."""
        with self._lock:
            self._offered += 1
            if len(self._items) >= self.capacity and not self._make_room():
                began = time.perf_counter()
                while len(self._items) >= self.capacity and not self._aborted and not self._make_room():
                    self._changed.wait()
                self._blocked += time.perf_counter() - began
            if self._aborted or self._closed:
                self._drops += 1
                return
            self._items.append((item, keep))
            self._high_water = max(self._high_water, len(self._items))
            self._changed.notify_all()

    def _make_room(self) -> bool:
        """Drop the oldest item that may be dropped. The caller holds the lock."""
        if self.when_full == "block":
            return False
        for index, (_, keep) in enumerate(self._items):
            if not keep:
                del self._items[index]
                self._drops += 1
                return True
        return False

    def get(self) -> T | None:
        """Wait for the next item; None at the end of the stream."""
        with self._lock:
            while not self._items and not self._closed:
                self._changed.wait()
            if not self._items:
                return None
            item, _ = self._items.popleft()
            self._delivered += 1
            self._changed.notify_all()
            return item

    def discard(self) -> None:
        """Count the item delivered last as dropped: the consumer could not match it with its other inputs."""
        with self._lock:
            self._delivered -= 1
            self._drops += 1

    def close(self) -> None:
        """End of stream: what is queued is still delivered, what is offered later is dropped."""
        with self._lock:
            self._closed = True
            self._changed.notify_all()

    def abort(self) -> None:
        """The consumer is gone: drop what is queued and never block the producer again."""
        with self._lock:
            self._closed = self._aborted = True
            self._drops += len(self._items)
            self._items.clear()
            self._changed.notify_all()

    def stats(self) -> LinkStats:
        """A consistent copy of the counters."""
        with self._lock:
            return LinkStats(
                self.when_full,
                self.capacity,
                self._offered,
                self._delivered,
                self._drops,
                self._high_water,
                self._blocked,
            )
