"""Loops over pixels and markers, which are compiled from `kernels.c` and the folder `loops`.

A loop is worth compiling where one pass takes the place of several calls of NumPy or OpenCV, and saves a
frame 0.03 ms or more; everything else is NumPy, OpenCV or SciPy.

    @kernel
    def sum_columns(picture, sums):
        # picture : (h, w) uint8. sums : (w,) float32, filled.
        sums[:] = picture.sum(axis=0)

The Python function says what its namesake in C computes, and does the same in NumPy. It runs where the C was
not compiled (there was no C compiler when tactflow was installed from its source), or if `TACTFLOW_PLAIN` is
set; and `tactflow stress` compares the two. Compiled loops run without Python's global lock. They raise
TypeError for arrays that are not C-contiguous, or of other types than in the table at the end of `kernels.c`.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from functools import cache
from importlib import import_module
from types import ModuleType
from typing import Any, Final, Generic, ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")

_kernels: list[Kernel[..., Any]] = []


def _compiled() -> ModuleType | None:
    if os.environ.get("TACTFLOW_PLAIN"):
        return None
    try:
        return import_module("tactflow.vision._kernels")
    except ImportError:
        return None


_MODULE: Final = _compiled()


class Kernel(Generic[P, R]):
    """A loop. Calls run `compiled`.

    Parameters
    ----------
    plain : the Python function.

    Attributes
    ----------
    compiled : its namesake in C; `plain` where there is none.
    """

    def __init__(self, plain: Callable[P, R]) -> None:
        self.plain = plain
        self.__doc__, self.__name__ = plain.__doc__, plain.__name__
        self.compiled: Callable[P, R] = plain if _MODULE is None else getattr(_MODULE, plain.__name__)

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        return self.compiled(*args, **kwargs)


def kernel(function: Callable[P, R]) -> Kernel[P, R]:
    """Decorator of a function whose namesake in C does the same."""
    found = Kernel(function)
    _kernels.append(found)
    return found


def kernels() -> list[Kernel[..., Any]]:
    """The kernels of all imported modules."""
    return list(_kernels)


def are_compiled() -> bool:
    """Whether loops run in C."""
    return _MODULE is not None


@cache
def warn_if_plain() -> None:
    """Log once that loops run in NumPy, and what to do about it."""
    if not are_compiled():
        logging.getLogger("tactflow").warning(
            "%s",
            "TACTFLOW_PLAIN is set: loops run in NumPy, several times slower"
            if os.environ.get("TACTFLOW_PLAIN")
            else "loops run in NumPy, several times slower: there was no C compiler when tactflow was "
            "installed (on Debian: apt install gcc python3-dev; then install tactflow again)",
        )
