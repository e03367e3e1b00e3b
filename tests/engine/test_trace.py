"""A trace is what Perfetto reads: tracks, slices that nest, arrows with two ends."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tactflow.engine.run import Runner
from tactflow.engine.trace import Trace

Event = dict[str, Any]
MakeRunner = Callable[..., Runner]
SEGMENTS = {"heavy": {"segment": "apart"}}


@pytest.fixture
def run(toy_runner: MakeRunner, tmp_path: Path) -> tuple[Runner, list[Event]]:
    """A run in several threads and its trace, read back from the file."""
    runner = toy_runner(SEGMENTS)
    runner.trace = Trace("tactflow toy")
    assert runner.run().exit_code == 0
    (tmp_path / "trace.json").write_text("\n".join(runner.trace.lines()))
    document = json.loads((tmp_path / "trace.json").read_text())
    assert document["displayTimeUnit"] in ("ms", "ns")
    return runner, document["traceEvents"]


def by_track(events: list[Event]) -> dict[int, list[Event]]:
    found = defaultdict(list)
    for event in events:
        if event["ph"] != "M":
            found[event["tid"]].append(event)
    return found


def test_every_event_has_what_the_format_requires(run: tuple[Runner, list[Event]]) -> None:
    _, events = run
    required = {"M": {"name", "args"}, "X": {"name", "ts", "dur", "tid"}}
    arrow = {"name", "cat", "id", "ts", "tid"}
    for event in events:
        assert required.get(event["ph"], arrow) | {"pid"} <= set(event)
        assert event["ph"] in "MXsf"
        assert event.get("ts", 0) >= 0
        assert event.get("dur", 0) >= 0


def test_each_thread_has_a_named_track(run: tuple[Runner, list[Event]]) -> None:
    runner, events = run
    names = {e["tid"]: e["args"]["name"] for e in events if e["name"] == "thread_name"}
    assert sorted(names.values()) == sorted(runner.plan.segments)
    assert set(by_track(events)) == set(names)
    assert [e["args"]["name"] for e in events if e["name"] == "process_name"] == ["tactflow toy"]


def test_times_grow_along_a_track_and_slices_nest(run: tuple[Runner, list[Event]]) -> None:
    _, events = run
    for track in by_track(events).values():
        assert [e["ts"] for e in track] == sorted(e["ts"] for e in track)
        open_until: list[float] = []
        for event in (e for e in track if e["ph"] == "X"):
            while open_until and open_until[-1] <= event["ts"]:
                open_until.pop()
            end = event["ts"] + event["dur"]
            # Times are rounded to 0.001 us.
            assert not open_until or end <= open_until[-1] + 0.0015
            open_until.append(end)


def test_each_arrow_has_both_ends_within_the_slices_of_one_frame(run: tuple[Runner, list[Event]]) -> None:
    runner, events = run
    tracks = by_track(events)
    ends: dict[str, dict[str, tuple[Event, str]]] = {"s": {}, "f": {}}
    for event in events:
        if event["ph"] in ends:
            inside = [
                e["name"]
                for e in tracks[event["tid"]]
                if e["ph"] == "X"
                and e["name"].startswith("frame")
                and e["ts"] <= event["ts"] <= e["ts"] + e["dur"]
            ]
            assert len(inside) == 1
            assert event["id"] not in ends[event["ph"]]
            ends[event["ph"]][event["id"]] = event, inside[0]
    assert ends["s"].keys() == ends["f"].keys()
    # 20 frames through every link.
    assert len(ends["s"]) == 20 * len(runner.plan.links)
    for number, (start, frame) in ends["s"].items():
        arrival, arrived_frame = ends["f"][number]
        assert arrived_frame == frame
        assert arrival["ts"] >= start["ts"]
        assert arrival["tid"] != start["tid"]
        assert arrival["bp"] == "e"


def test_a_slice_stands_for_each_run_of_each_stage(run: tuple[Runner, list[Event]]) -> None:
    runner, events = run
    slices = [e["name"] for e in events if e["ph"] == "X"]
    for name, entry in runner.snapshot()["stages"].items():
        assert slices.count(name) == entry["runs"]
    skipped = [e["args"]["skipped"] for e in events if e["ph"] == "X" and "skipped" in e["args"]]
    assert any(reasons.get("gated") == "idle" for reasons in skipped)
