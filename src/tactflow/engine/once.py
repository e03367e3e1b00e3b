"""Results that depend on the reference or on settings alone, kept for the stages of a run."""

from __future__ import annotations

import threading
from collections.abc import Callable, Hashable, Sequence
from typing import Any, ParamSpec, TypeVar

import numpy as np

P = ParamSpec("P")
T = TypeVar("T")

KEPT_RESULTS = 4
"""Number of results kept of each function: of stages with different settings, and of the last reference."""
MAX_COMPARED_BYTES = 1 << 17
"""Size up to which arrays are compared by value, bytes: the positions of eight thousand dots."""


class Once:
    """Calls a function once for the same arguments, and returns the kept result from then on. Thread-safe.

    Arguments are the same if they are identical; numbers, texts, tuples and small arrays also if they are
    equal. So a picture of the untouched gel counts as the same until the next reference. The function must
    depend on its arguments alone, and nobody may change its result.

    >>> once = Once()
    >>> gel = np.zeros((240, 320, 3))
    >>> once(np.mean, gel, axis=2) is once(np.mean, gel, axis=2)
    True
    """

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._kept: dict[Hashable, Sequence[tuple[Sequence[Any], Any]]] = {}

    def __call__(self, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """The result of `function(*args, **kwargs)`."""
        given = (*args, *sorted(kwargs.items())) if kwargs else args
        for earlier, result in self._kept.get(function, ()):
            if _are_same(earlier, given):
                found: T = result
                return found
        # Held while it computes, so that two stages never compute the same.
        with self._lock:
            kept = self._kept.get(function, ())
            for earlier, result in kept:
                if _are_same(earlier, given):
                    return result  # type: ignore[no-any-return]
            computed = function(*args, **kwargs)
            # Replaced as a whole, so that it can be read without the lock.
            self._kept[function] = ((given, computed), *kept)[:KEPT_RESULTS]
            return computed

    def keeping(self, function: Callable[P, T]) -> Callable[P, T]:
        """The function with kept results, for code that calls it."""

        def call(*args: P.args, **kwargs: P.kwargs) -> T:
            return self(function, *args, **kwargs)

        return call


def _are_same(first: Sequence[Any], second: Sequence[Any]) -> bool:
    if len(first) != len(second):
        return False
    for one, other in zip(first, second, strict=True):
        if one is not other and not _is_equal(one, other):
            return False
    return True


def _is_equal(first: Any, second: Any) -> bool:
    """Whether arguments that are not identical are equal."""
    if type(first) is not type(second):
        return False
    if isinstance(first, np.ndarray):
        alike = first.shape == second.shape and first.dtype == second.dtype
        return alike and first.nbytes <= MAX_COMPARED_BYTES and first.tobytes() == second.tobytes()
    if isinstance(first, tuple):
        return _are_same(first, second)
    return isinstance(first, str | float | int) and first == second
