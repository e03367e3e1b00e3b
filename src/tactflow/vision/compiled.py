"""Loops over pixels and markers that numba compiles for this processor.

A loop is worth compiling where that saves a frame 0.1 ms or more; everything else is NumPy, OpenCV or SciPy.

    @kernel("void(uint8[:, ::1], float32[::1])")
    def column_sums(picture, sums):
        for row in range(picture.shape[0]):
            for column in range(sums.size):
                sums[column] += picture[row, column]

A kernel names the types of its arguments, so that it has one version. Helpers are compiled into the kernels
of their own file that call them. A kernel is compiled, or read from disk, on its first call or by `load`,
which `tactflow.api` calls before a run so that no frame waits; until then numba is not imported.

numba keeps compiled code in `NUMBA_CACHE_DIR` if that is set, else beside the source, else in the user's
cache folder, and compiles a kernel again when its file has changed. Kernels run without Python's global
lock. `NUMBA_DISABLE_JIT=1` runs them as plain Python for a debugger: very slowly, and small integers
overflow."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import cache, cached_property
from importlib import import_module
from typing import Any, Final, Generic, ParamSpec, TypeVar

import numpy as np

P = ParamSpec("P")
R = TypeVar("R")

_OPTIONS: Final = {
    "nogil": True,
    "error_model": "numpy",
    # Nobody uses entries for C, or rewritten expressions of whole arrays: a tenth of the time to compile.
    "no_cfunc_wrapper": True,
    "no_rewrites": True,
    # Sums of floats in any order, so that they run in vector lanes; NaN and infinity still count.
    "fastmath": {"reassoc", "contract", "arcp", "nsz"},
}

_kernels: list[Kernel[..., Any]] = []


class Kernel(Generic[P, R]):
    """A function that numba compiles before its first call.

    Parameters
    ----------
    plain : the Python function.
    """

    def __init__(self, plain: Callable[P, R], signature: str) -> None:
        self.plain = plain
        self.__doc__, self.__name__ = plain.__doc__, plain.__name__
        self._signature = signature

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        try:
            result: R = self.compiled(*args, **kwargs)
        except TypeError:
            # To numba a read-only array, such as the image of a frame, is of another type.
            copies: Any = [_writable(value) for value in args]
            if all(copy is value for copy, value in zip(copies, args, strict=True)):
                raise
            result = self.compiled(*copies, **kwargs)
        return result

    @cached_property
    def compiled(self) -> Any:
        """numba's compiled function, cached on disk where that is possible."""
        numba = import_module("numba")
        if numba.config.DISABLE_JIT:
            return self.plain
        try:
            found = numba.njit(cache=True, **_OPTIONS)(self.plain)
            with suppress(Exception):
                found.compile(self._signature)
            if not found.signatures:
                # The file was damaged; this replaces it.
                found.recompile()
                found.compile(self._signature)
        except (OSError, RuntimeError) as error:
            reason = (isinstance(error, OSError) and error.strerror) or "no folder can be written to"
            _warn("loops are compiled in each run: they cannot be cached (set NUMBA_CACHE_DIR): " + reason)
            found = numba.njit(self._signature, **_OPTIONS)(self.plain)
        found.disable_compile()
        if not found.stats.cache_hits:
            _announce()
        return found


@cache
def _announce() -> None:
    """Say once why the program seems to wait."""
    text = f"tactflow: compiling {len(_kernels)} loops for this processor, once; this takes up to a minute"
    print(text, file=sys.stderr, flush=True)


@cache
def _warn(text: str) -> None:
    """Log a warning once, not for each loop."""
    logging.getLogger("tactflow").warning("%s", text)


def _writable(value: object) -> object:
    """A copy of a read-only array; anything else unchanged."""
    return value.copy() if isinstance(value, np.ndarray) and not value.flags.writeable else value


class Helper(Generic[P, R]):
    """A function that kernels of its file call; called from Python, it is plain."""

    def __init__(self, plain: Callable[P, R]) -> None:
        self.plain = plain

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        return self.plain(*args, **kwargs)

    @cached_property
    def _numba_type_(self) -> Any:
        """What numba takes it for where a kernel calls it."""
        njit = import_module("numba").njit
        self._inlined = njit(forceinline=True, no_cpython_wrapper=True, **_OPTIONS)(self.plain)
        return self._inlined._numba_type_


helper = Helper
"""Decorator of a function that is compiled into the kernels of its file that call it."""


def kernel(signature: str) -> Callable[[Callable[P, R]], Kernel[P, R]]:
    """Decorator of a function of loops. signature : numba's, of its arguments and of what it returns."""

    def wrap(function: Callable[P, R]) -> Kernel[P, R]:
        found = Kernel(function, signature)
        _kernels.append(found)
        return found

    return wrap


def kernels() -> list[Kernel[..., Any]]:
    """The kernels of all imported modules."""
    return list(_kernels)


def load() -> tuple[int, int]:
    """Compile the kernels of all imported modules, or read them from disk.

    Returns how many there are, and how many of them this process has compiled.
    """
    found = [each.compiled for each in _kernels]
    return len(found), sum(hasattr(each, "stats") and not each.stats.cache_hits for each in found)
