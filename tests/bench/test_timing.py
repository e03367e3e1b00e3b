from __future__ import annotations

import cv2

from tactflow.bench import timing


def test_alternatives_take_turns_and_are_judged_after_each_turn() -> None:
    events: list[tuple[str, str, int]] = []
    alternatives = {name: (lambda value, name=name: events.append(("call", name, value))) for name in "ab"}

    def see(name: str, value: int, _result: None) -> None:
        events.append(("see", name, value))

    times = timing.interleaved(alternatives, [("x", 0), ("y", 1), ("x", 2)], block=2, see=see)
    turns = [("a", (0, 1)), ("b", (0, 1)), ("a", (2,)), ("b", (2,))]
    assert events == [(what, name, v) for name, values in turns for what in ("call", "see") for v in values]
    assert {kind: len(samples) for kind, samples in times["a"].items()} == {"x": 2, "y": 1}


def test_measuring_uses_one_opencv_thread_and_restores_the_setting() -> None:
    before = cv2.getNumThreads()
    during: list[int] = []
    timing.interleaved({"a": lambda _: during.append(cv2.getNumThreads())}, [("k", 0)])
    assert during == [1]
    assert cv2.getNumThreads() == before
