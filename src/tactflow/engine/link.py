"""A bounded queue between two segments, with a named policy for when it is full."""

from __future__ import annotations

import threading
import time
from collections import deque
from typing import Any, Generic, TypeVar

from tactflow.engine.graph import FullPolicy

T = TypeVar("T")


class Link(Generic[T]):
    """One producer, one consumer, at most `capacity` items.

    Parameters
    ----------
    when_full : "block" makes the producer wait (nothing is lost); "latest" has one slot and overwrites it;
        "drop_oldest" discards the oldest item. The order is preserved. The end of the stream is a flag, not
        an item, so that it cannot be dropped.

    Attributes
    ----------
    drops, delivered : number of items so far.
    """

    def __init__(self, name: str, capacity: int, when_full: FullPolicy) -> None:
        self.name = name
        self.when_full: FullPolicy = when_full
        self.capacity = 1 if when_full == "latest" else capacity
        self.drops = self.delivered = 0
        self._items: deque[tuple[T, bool]] = deque()
        self._changed = threading.Condition(threading.Lock())
        self._closed = False
        self._aborted = False
        self._offered = self._high_water = 0
        self._blocked = 0.0

    def put(self, item: T, *, keep: bool = False) -> None:
        """Add an item. keep : never drop it, as for a reference frame."""
        with self._changed:
            self._offered += 1
            if len(self._items) >= self.capacity and not self._make_room():
                began = time.perf_counter()
                while len(self._items) >= self.capacity and not self._aborted and not self._make_room():
                    self._changed.wait()
                self._blocked += time.perf_counter() - began
            if self._aborted or self._closed:
                self.drops += 1
                return
            self._items.append((item, keep))
            self._high_water = max(self._high_water, len(self._items))
            self._changed.notify_all()

    def _make_room(self) -> bool:
        """Drop the oldest item that may be dropped, if the policy allows. The caller holds the lock."""
        if self.when_full == "block":
            return False
        for index, (_, keep) in enumerate(self._items):
            if not keep:
                del self._items[index]
                self.drops += 1
                return True
        return False

    def get(self) -> T | None:
        """Wait for the next item; None at the end of the stream."""
        with self._changed:
            while not self._items and not self._closed:
                self._changed.wait()
            if not self._items:
                return None
            item, _ = self._items.popleft()
            self.delivered += 1
            self._changed.notify_all()
            return item

    def discard(self) -> None:
        """Count the last delivered item as dropped: the consumer could not match it with its other inputs."""
        with self._changed:
            self.delivered -= 1
            self.drops += 1

    def close(self) -> None:
        """End the stream: queued items are still delivered, later ones are dropped."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def abort(self) -> None:
        """The consumer has ended: drop queued items, and never block the producer again."""
        with self._changed:
            self._closed = self._aborted = True
            self.drops += len(self._items)
            self._items.clear()
            self._changed.notify_all()

    def stats(self) -> dict[str, Any]:
        """The entry in the statistics file. After the run, offered == delivered + drops."""
        with self._changed:
            return {
                "policy": self.when_full,
                "capacity": self.capacity,
                "high_water": self._high_water,
                "drops": self.drops,
                "blocked_s": round(self._blocked, 6),
                "offered": self._offered,
                "delivered": self.delivered,
            }
