"""Links: bounded, ordered, and honest about what they drop."""

from __future__ import annotations

import threading

from hypothesis import given, settings
from hypothesis import strategies as st

from tactflow.engine.graph import FullPolicy
from tactflow.engine.link import Link
from tests.clock import PATIENCE, until

POLICIES: tuple[FullPolicy, ...] = ("block", "latest", "drop_oldest")


def drain(link: Link[int]) -> list[int]:
    items = []
    while (item := link.get()) is not None:
        items.append(item)
    return items


def test_blocking_loses_nothing_and_measures_the_wait() -> None:
    link: Link[int] = Link("l", 2, "block")
    thread = threading.Thread(target=lambda: ([link.put(i) for i in range(50)], link.close()))
    thread.start()
    until(lambda: link.stats()["offered"] >= 3)
    assert drain(link) == list(range(50))
    thread.join()
    assert link.drops == 0
    assert link.stats()["high_water"] == 2
    assert link.stats()["blocked_s"] > 0


@settings(max_examples=60, deadline=None)
@given(
    policy=st.sampled_from(POLICIES),
    capacity=st.integers(1, 5),
    steps=st.lists(st.sampled_from(["put", "keep", "get"]), max_size=60),
)
def test_order_is_kept_the_oldest_is_dropped_and_every_item_is_accounted_for(
    policy: FullPolicy, capacity: int, steps: list[str]
) -> None:
    link: Link[int] = Link("l", capacity, policy)
    waiting: list[tuple[int, bool]] = []
    got: list[int] = []
    kept: list[int] = []
    number = 0
    for step in steps:
        if step == "get":
            if waiting:
                got.append(waiting.pop(0)[0])
                assert link.get() == got[-1]
        else:
            keep = step == "keep"
            would_block = len(waiting) >= link.capacity and (policy == "block" or all(k for _, k in waiting))
            if would_block:
                continue
            if len(waiting) >= link.capacity:
                waiting.remove(next(entry for entry in waiting if not entry[1]))
            link.put(number, keep=keep)
            waiting.append((number, keep))
            if keep:
                kept.append(number)
            number += 1
    link.close()
    assert drain(link) == [item for item, _ in waiting]
    got += [item for item, _ in waiting]
    assert got == sorted(got)
    assert set(kept) <= set(got)
    stats = link.stats()
    assert stats["offered"] == number == stats["delivered"] + stats["drops"] == len(got) + stats["drops"]
    assert stats["high_water"] <= link.capacity
    if policy == "block":
        assert stats["drops"] == 0


def test_a_kept_item_waits_for_its_reader_on_a_dropping_link() -> None:
    link: Link[int] = Link("l", 1, "latest")
    link.put(0, keep=True)
    thread = threading.Thread(target=link.put, args=(1,))
    thread.start()
    assert link.get() == 0
    thread.join()
    assert link.get() == 1


def test_an_aborted_link_frees_its_producer_and_counts_what_it_dropped() -> None:
    link: Link[int] = Link("l", 1, "block")
    link.put(0)
    thread = threading.Thread(target=link.put, args=(1,))
    thread.start()
    link.abort()
    thread.join(PATIENCE)
    assert not thread.is_alive()
    link.put(2)
    assert link.get() is None
    assert link.drops == link.stats()["offered"] == 3
