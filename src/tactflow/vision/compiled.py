"""Loops over pixels and markers that numba compiles for this processor.

A loop is worth compiling where that saves a frame 0.1 ms or more; everything else is NumPy, OpenCV or SciPy.

    @kernel("void(uint8[:, ::1], float32[::1])")
    def column_sums(picture, sums):
        for row in range(picture.shape[0]):
            _add(picture[row], sums)

    @helper
    def _add(line, sums):
        for column in range(sums.size):
            sums[column] += line[column]

A kernel names the types of its arguments, so that it has one version. Helpers are compiled into the kernels
of their own file that call them. A kernel is compiled, or read from disk, on its first call or by `load`,
which `tactflow.api` calls before a run so that no frame waits; until then numba is not imported.

numba keeps compiled code in `NUMBA_CACHE_DIR` if that is set, else beside the source, else in the user's
cache folder, and compiles a kernel again when its file has changed. Kernels run without Python's global
lock. `NUMBA_DISABLE_JIT=1` runs them as plain Python for a debugger: very slowly, and small integers
overflow."""

from __future__ import annotations

import glob
import logging
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from functools import cache, cached_property
from hashlib import sha256
from importlib import import_module
from pathlib import Path
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
_SAY_EVERY_S: Final = 2.0
"""Seconds between two messages about progress. Chosen by hand."""

_BAR: Final = 24
"""Length of the progress bar, characters."""

_kernels: list[Kernel[..., Any]] = []
_said_at = -_SAY_EVERY_S


class Kernel(Generic[P, R]):
    """A function that numba compiles before its first call. plain : the Python function."""

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
            given: Any = args
            if not all(
                np.array_equal(copy, value, equal_nan=True) for copy, value in zip(copies, given, strict=True)
            ):
                raise TypeError(
                    f"{self.__name__}: required an array to write to, got a read-only one"
                ) from None
        return result

    @cached_property
    def compiled(self) -> Any:
        """numba's compiled function, kept on disk where that is possible."""
        numba = import_module("numba")
        if numba.config.DISABLE_JIT:
            return self.plain
        try:
            found = numba.njit(cache=True, **_OPTIONS)(self.plain)
            files = _StoredCode(found)
            files.remove_damaged()
            with suppress(Exception):
                found.compile(self._signature)
            if not found.signatures:
                # A damaged file gives way to an empty one.
                found.recompile()
                found.compile(self._signature)
            if not found.stats.cache_hits:
                files.sign()
        except (OSError, RuntimeError) as error:
            _warn_of_disk((isinstance(error, OSError) and error.strerror) or "no folder can be written to")
            found = numba.njit(self._signature, **_OPTIONS)(self.plain)
        found.disable_compile()
        if not found.stats.cache_hits:
            _say_progress(sum("compiled" not in vars(each) for each in _kernels) - 1)
        return found


class _StoredCode:
    """The files in which numba keeps one compiled function, with a checksum of ours.

    Damaged machine code would end the process when it runs, if not when it is loaded.
    """

    def __init__(self, function: Any) -> None:
        code = function.py_func.__code__
        self._folder = Path(function.stats.cache_path)
        self._name = f"{function.__module__.rpartition('.')[2]}.{code.co_name}"
        self._front = f"{self._name}-{code.co_firstlineno}."
        self._checksum = self._folder / f"{self._front}{sys.implementation.cache_tag}.sha256"

    def _files(self) -> list[Path]:
        return sorted(self._folder.glob(f"{glob.escape(self._front)}*.nb[ic]"))

    def _sum(self) -> str:
        return sha256(b"".join(path.read_bytes() for path in self._files())).hexdigest()

    def remove_damaged(self) -> None:
        """Remove files that are not as they were written, with a line in the log."""
        with suppress(OSError):
            if self._checksum.read_text(errors="replace") != self._sum():
                for path in self._files():
                    path.unlink()
                text = "%s: its compiled code on disk is damaged or incomplete, and is compiled again"
                logging.getLogger("tactflow").warning(text, self._name)

    def sign(self) -> None:
        """Keep the checksum of what has been written."""
        with suppress(OSError):
            self._checksum.write_text(self._sum())


@cache
def _warn_of_disk(reason: str) -> None:
    """Say once, not for each loop, that compiled code cannot be kept."""
    text = "loops are compiled in each run, since they cannot be kept on disk (set NUMBA_CACHE_DIR): %s"
    logging.getLogger("tactflow").warning(text, reason)


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


def load() -> tuple[int, int]:
    """Compile the kernels of all imported modules, or read them from disk.

    Returns how many there are, and how many of them this process has compiled.
    """
    found = [each.compiled for each in _kernels]
    return len(found), sum(hasattr(each, "stats") and not each.stats.cache_hits for each in found)


def _say_progress(left: int) -> None:
    """Say on standard error that loops are being compiled, and how many are left: by a bar on a terminal."""
    global _said_at
    total = len(_kernels)
    done, text = total - left, "tactflow: compiling loops for this processor, once"
    if sys.stderr.isatty():
        bar = "#" * (_BAR * done // total)
        print(f"\r{text} [{bar.ljust(_BAR)}] {done} of {total}", end="", file=sys.stderr, flush=True)
        if not left:
            # Erase the line: it was for those who waited.
            print("\r\x1b[K", end="", file=sys.stderr, flush=True)
    elif left and time.monotonic() - _said_at >= _SAY_EVERY_S:
        _said_at = time.monotonic()
        print(f"{text}: {done} of {total} are done", file=sys.stderr)
