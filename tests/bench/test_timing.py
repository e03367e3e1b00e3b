from __future__ import annotations

import cv2
import numpy as np

from tactflow.bench import timing


def test_alternatives_take_turns_of_a_few_inputs_and_the_last_turn_may_be_shorter() -> None:
    calls: list[tuple[str, int]] = []
    alternatives = {name: (lambda value, name=name: calls.append((name, value))) for name in "ab"}
    timing.interleaved(alternatives, [("x", 0), ("y", 1), ("x", 2)], block=2)
    assert calls == [("a", 0), ("a", 1), ("b", 0), ("b", 1), ("a", 2), ("b", 2)]


def test_a_method_is_not_disturbed_by_the_judging_of_its_results_within_a_turn() -> None:
    events: list[tuple[str, int]] = []

    def work(value: int) -> int:
        events.append(("call", value))
        return -value

    def see(_name: str, _kind: object, value: int, result: int) -> None:
        assert result == -value
        events.append(("see", value))

    timing.interleaved({"a": work}, [("k", 1), ("k", 2), ("k", 3)], block=2, see=see)
    expected = [("call", 1), ("call", 2), ("see", 1), ("see", 2), ("call", 3), ("see", 3)]
    assert events == expected


def test_times_are_kept_apart_by_kind() -> None:
    times = timing.interleaved({"a": abs}, [("contact", 1), ("idle", 2), ("idle", 3)])
    assert {kind: s.summary()["count"] for kind, s in times["a"].items()} == {"contact": 1, "idle": 2}


def test_results_are_seen_outside_the_timed_part() -> None:
    seen: list[tuple[str, object]] = []
    timing.interleaved(
        {"a": abs}, [("k", -3)], see=lambda name, _kind, _value, result: seen.append((name, result))
    )
    assert seen == [("a", 3)]


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
    quarter = len(before) // 4
    assert np.all(unit._pool[2 * quarter] == before[0])
    assert np.all(unit._pool[3 * quarter] == 255 - before[quarter])
    assert unit.copy_ms > 0
    assert unit.touch_ms > 0
    assert unit.fault_us >= 0
