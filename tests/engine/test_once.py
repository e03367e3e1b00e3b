"""What depends on the reference alone is computed once, and shared by the stages of a run."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
import pytest

from tactflow.engine.once import KEPT_RESULTS, MAX_COMPARED_BYTES, Once

BIG = np.zeros(MAX_COMPARED_BYTES + 1, np.uint8)
SMALL = np.array([[1.0, np.nan]])
MANY_DOTS = np.zeros((5000, 2))


class Counting:
    """Counts its calls."""

    def __init__(self) -> None:
        self.calls: list[tuple[Any, ...]] = []

    def __call__(self, *args: Any, **options: Any) -> object:
        self.calls.append((args, options))
        return object()


@pytest.mark.parametrize(
    ("first", "second", "is_same"),
    [
        (BIG, BIG, True),
        (BIG, BIG.copy(), False),
        (BIG, BIG[:], False),
        (SMALL, SMALL.copy(), True),
        (MANY_DOTS, MANY_DOTS.copy(), True),
        (SMALL, SMALL.ravel(), False),
        (SMALL, SMALL.astype(np.float32), False),
        (SMALL, SMALL + 1, False),
        ((300, 400), (300, 400), True),
        ((300, 400), (400, 300), False),
        ((BIG, 1), (BIG, 1), True),
        (1, 1.0, False),
        (None, None, True),
        (None, 0, False),
        ("auto", "".join("auto"), True),
        (object(), object(), False),
    ],
)
def test_a_result_is_kept_for_the_same_argument_and_computed_for_another(
    first: Any, second: Any, is_same: bool
) -> None:
    once, function = Once(), Counting()
    for call in (lambda value: once(function, value), lambda value: once(function, image=value)):
        function.calls.clear()
        assert (call(first) is call(second)) == is_same
        assert len(function.calls) == 2 - is_same


def test_the_order_of_named_arguments_does_not_matter_and_their_names_do() -> None:
    once, function = Once(), Counting()
    first = once(function, BIG, dot=None, valid=BIG)
    assert once(function, BIG, valid=BIG, dot=None) is first
    assert once(function, BIG, valid=None, dot=BIG) is not first
    assert once(function, BIG, BIG, None) is not first


def test_each_function_has_results_of_its_own_and_keeps_few() -> None:
    once, function, other = Once(), Counting(), Counting()
    assert once(function, 0) is not once(other, 0)
    results = [once(function, number) for number in range(KEPT_RESULTS + 1)]
    assert [once(function, number + 1) for number in range(KEPT_RESULTS)] == results[1:]
    assert once(function, 0) is not results[0]


def test_an_error_is_not_kept() -> None:
    once = Once()
    outcomes = iter([ValueError("no dots"), 3])

    def find(_: int) -> int:
        outcome = next(outcomes)
        if isinstance(outcome, Exception):
            raise outcome
        return outcome

    with pytest.raises(ValueError, match="no dots"):
        once(find, 0)
    assert once.keeping(find)(0) == once(find, 0) == 3


def test_two_threads_never_compute_the_same() -> None:
    once, began, release = Once(), threading.Event(), threading.Event()
    calls: list[int] = []

    def slow(number: int) -> object:
        calls.append(number)
        began.set()
        release.wait()
        return object()

    found: list[object] = []
    threads = [threading.Thread(target=lambda: found.append(once(slow, 7))) for _ in range(2)]
    for thread in threads:
        thread.start()
    began.wait()
    release.set()
    for thread in threads:
        thread.join()
    assert calls == [7]
    assert found[0] is found[1]
