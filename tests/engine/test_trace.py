"""A trace is what Perfetto reads: tracks, slices that nest, arrows with two ends."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Callable
from typing import Any

import pytest

from tactflow.engine.run import Runner
from tactflow.engine.trace import Trace

Event = dict[str, Any]
Traced = tuple[Runner, list[Event], dict[int, list[Event]]]


@pytest.fixture
def traced(toy_runner: Callable[..., Runner]) -> Traced:
    """A run in several threads, the events of its trace, and those of each track."""
    runner = toy_runner({"heavy": {"segment": "apart"}})
    runner.trace = Trace("tactflow toy")
    assert runner.run().exit_code == 0
    events = json.loads("\n".join(runner.trace.lines()))["traceEvents"]
    tracks = defaultdict(list)
    for event in events:
        if event["ph"] != "M":
            tracks[event["tid"]].append(event)
    return runner, events, tracks


def slices_around(moment: Event, track: list[Event]) -> list[str]:
    """The slices of frames in which a moment lies."""
    frames = [event for event in track if event["ph"] == "X" and event["name"].startswith("frame")]
    return [frame["name"] for frame in frames if frame["ts"] <= moment["ts"] <= frame["ts"] + frame["dur"]]


def test_each_thread_has_a_named_track_with_a_slice_for_each_run_of_each_stage(traced: Traced) -> None:
    runner, events, tracks = traced
    names = {e["tid"]: e["args"]["name"] for e in events if e["name"] == "thread_name"}
    assert sorted(names.values()) == sorted(runner.plan.segments)
    assert set(tracks) == set(names)
    assert all(event["pid"] == 1 and event["ph"] in "MXsf" for event in events)
    assert [e["args"]["name"] for e in events if e["name"] == "process_name"] == ["tactflow toy"]
    slices = [event for event in events if event["ph"] == "X"]
    for name, entry in runner.snapshot()["stages"].items():
        assert [event["name"] for event in slices].count(name) == entry["runs"]
    skipped = [event["args"]["skipped"] for event in slices if "skipped" in event["args"]]
    assert any(reasons.get("gated") == "idle" for reasons in skipped)


def test_times_grow_along_a_track_and_slices_nest(traced: Traced) -> None:
    for track in traced[2].values():
        assert [event["ts"] for event in track] == sorted(event["ts"] for event in track)
        open_until: list[float] = []
        for event in (e for e in track if e["ph"] == "X"):
            while open_until and open_until[-1] <= event["ts"]:
                open_until.pop()
            end = event["ts"] + event["dur"]
            # Times are rounded to 0.001 us.
            assert not open_until or end <= open_until[-1] + 0.0015
            open_until.append(end)


def test_each_arrow_has_both_ends_within_the_slices_of_one_frame(traced: Traced) -> None:
    runner, events, tracks = traced
    starts, ends = ({e["id"]: e for e in events if e["ph"] == phase} for phase in "sf")
    assert starts.keys() == ends.keys()
    # 20 frames through every link.
    assert len(starts) == 20 * len(runner.plan.links) == sum(e["ph"] == "s" for e in events)
    for number, start in starts.items():
        end = ends[number]
        (frame,) = slices_around(start, tracks[start["tid"]])
        assert slices_around(end, tracks[end["tid"]]) == [frame]
        assert end["ts"] >= start["ts"]
        assert end["tid"] != start["tid"]
        assert end["bp"] == "e"
