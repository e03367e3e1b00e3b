from __future__ import annotations

import cv2
import numpy as np

from tactflow.bench import timing


def test_alternatives_take_turns_frame_by_frame() -> None:
    calls: list[tuple[str, int]] = []
    alternatives = {name: (lambda value, name=name: calls.append((name, value))) for name in "ab"}
    timing.interleaved(alternatives, [("x", 0), ("y", 1)])
    assert calls == [("a", 0), ("b", 0), ("a", 1), ("b", 1)]


def test_times_are_kept_apart_by_kind() -> None:
    times = timing.interleaved({"a": abs}, [("contact", 1), ("idle", 2), ("idle", 3)])
    assert {kind: s.summary()["count"] for kind, s in times["a"].items()} == {"contact": 1, "idle": 2}


def test_results_are_seen_outside_the_timed_part() -> None:
    seen: list[tuple[str, object]] = []
    timing.interleaved(
        {"a": abs}, [("k", -3)], see=lambda name, _kind, _value, result: seen.append((name, result))
    )
    assert seen == [("a", 3)]


def test_a_method_that_uses_up_its_time_is_left_out() -> None:
    calls: list[int] = []
    timing.interleaved({"slow": calls.append}, [("k", 1), ("k", 2)], give_up_after=0.0)
    assert calls == [1]


def test_measuring_uses_one_opencv_thread_and_restores_the_setting() -> None:
    before = cv2.getNumThreads()
    during: list[int] = []
    timing.interleaved({"a": lambda _: during.append(cv2.getNumThreads())}, [("k", 0)])
    assert during == [1]
    assert cv2.getNumThreads() == before


def test_percentiles_are_those_of_the_samples() -> None:
    samples = timing.Samples()
    for value in np.arange(1, 101) * 1e-3:
        samples.add(cpu=value, wall=2 * value)
    summary = samples.summary()
    assert np.isclose(summary["cpu_ms_p50"], 50.5)
    assert np.isclose(summary["wall_ms_p50"], 101)
    assert 99 <= summary["cpu_ms_p99"] <= 100
    assert timing.Samples().summary() == {}


def test_the_unit_is_the_time_of_a_real_copy_and_a_real_pass() -> None:
    unit = timing.CopyUnit()
    before = [int(frame[0, 0, 0]) for frame in unit._pool]
    unit.take()
    assert np.all(unit._pool[20] == before[0])
    assert np.all(unit._pool[30] == 255 - before[10])
    assert unit.copy_ms > 0
    assert unit.touch_ms > 0
