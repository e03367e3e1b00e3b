"""Loops compiled by numba where it is installed (`pip install "tactflow[fast]"`).

What is costly in a vision method is written twice: once with numpy and OpenCV, which is what runs without
numba, and once as plain loops over pixels that numba compiles. Both give the same numbers, to the rounding
that the method states. A method looks like this:

    @kernel("void(uint8[:, ::1], float32[::1])")
    def _sums(picture, sums): ...            # loops

    def column_sums(picture):
        if compiled.active():
            sums = np.zeros(picture.shape[1], np.float32)
            _sums(picture, sums)
            return sums
        return picture.sum(axis=0, dtype=np.float32)

Kernels are compiled on their first call, or by `load`, which the constructor of a stage calls so that no
frame has to wait; numba keeps the result on disk, so this costs seconds once and milliseconds later. They run
without Python's lock: several segments of a pipeline work at the same time.

Constants that a kernel uses stand in its own file: numba compiles it again when that file has changed, and
does not look at others.

`TACTFLOW_COMPILED=0` in the environment switches them off.
"""

from __future__ import annotations

import logging
import os
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, cached_property
from importlib import import_module
from importlib.util import find_spec
from types import ModuleType
from typing import Any, Generic, ParamSpec, TypeVar

import numpy as np

logger = logging.getLogger("tactflow")

P = ParamSpec("P")
R = TypeVar("R")

VARIABLE = "TACTFLOW_COMPILED"
"""Environment variable; 0, off, no or false: numba is not used although it is there."""

_ON = ("1", "on", "yes", "true", "")
_OFF = ("0", "off", "no", "false")

_REASSOCIATED = {"reassoc", "contract", "arcp", "nsz"}
"""Freedoms of the compiler: sums in any order. It must still respect NaN and infinity."""

_lock = threading.Lock()


def _asked_for(value: str | None) -> bool:
    """What the environment variable says; without it, and if it says something else, kernels are used."""
    word = "1" if value is None else value.strip().lower()
    if word not in (*_ON, *_OFF):
        warnings.warn(
            f"{VARIABLE}={value}: required 1 or 0; numba is used where it is installed",
            RuntimeWarning,
            stacklevel=2,
        )
    return word not in _OFF


_wanted = _asked_for(os.environ.get(VARIABLE))


class Kernel(Generic[P, R]):
    """A function that numba compiles when it is first needed.

    signature : numba's, so that no call has to find out its types. C-contiguous arrays are `[:, ::1]`.
    reorder : whether sums of floats may be taken in any order, which lets them run in parallel lanes; if not,
        operations are those of the Python code, in its order.
    """

    def __init__(self, function: Callable[P, R], signature: str, reorder: bool) -> None:
        self.plain = function
        self._signature = signature
        self._reorder = reorder
        self._compiled: Callable[P, R] | None = None
        self.__doc__ = function.__doc__
        self.__name__ = function.__name__

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        if self._compiled is None:
            self.load()
            assert self._compiled is not None
        try:
            return self._compiled(*args, **kwargs)
        except TypeError:
            # To numba, an array that must not be written is of another type.
            given: Any = [_writable(value) for value in args]
            return self._compiled(*given, **kwargs)

    def load(self) -> None:
        """Compile now, or take what is on disk; nothing happens where kernels are not active."""
        if self._compiled is not None or not active():
            return
        with _lock:
            if self._compiled is None:
                self._compiled = self._compile()

    def _compile(self) -> Callable[P, R]:
        options: dict[str, Any] = {
            "nogil": True,
            "error_model": "numpy",
            "fastmath": _REASSOCIATED if self._reorder else False,
        }
        njit: Any = import_module("numba").njit
        try:
            found: Any = njit(self._signature, cache=True, **options)(self.plain)
        except (RuntimeError, OSError):
            # No place on disk where numba could keep the result.
            found = njit(self._signature, **options)(self.plain)
        if found.stats.cache_misses:
            _tell_once()
        compiled_function: Callable[P, R] = found
        return compiled_function


def kernel(signature: str, *, reorder: bool = False) -> Callable[[Callable[P, R]], Kernel[P, R]]:
    """Decorator of a function of loops; see `Kernel`."""

    def wrap(function: Callable[P, R]) -> Kernel[P, R]:
        return Kernel(function, signature, reorder)

    return wrap


class Inlined(Generic[P, R]):
    """A helper of kernels in the same file: numba puts its body where it is called."""

    def __init__(self, function: Callable[P, R], reorder: bool) -> None:
        self.plain = function
        self._reorder = reorder
        self.__doc__ = function.__doc__
        self.__name__ = function.__name__

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        """Run as Python, uncompiled."""
        return self.plain(*args, **kwargs)

    @cached_property
    def _numba_type_(self) -> Any:
        """What numba asks of a global that it does not know; asked for only while a kernel is compiled."""
        numba: Any = import_module("numba")
        fastmath = _REASSOCIATED if self._reorder else False
        # Kept here: numba's type does not keep it.
        self._dispatcher = numba.njit(error_model="numpy", fastmath=fastmath, forceinline=True)(self.plain)
        return numba.types.Dispatcher(self._dispatcher)


def inlined(*, reorder: bool = False) -> Callable[[Callable[P, R]], Inlined[P, R]]:
    """Decorator of a part of a kernel; see `Inlined`. `reorder` as for `kernel`, and to be as there."""

    def wrap(function: Callable[P, R]) -> Inlined[P, R]:
        return Inlined(function, reorder)

    return wrap


def load(*modules: ModuleType) -> None:
    """Load all kernels of some modules."""
    for module in modules:
        for value in vars(module).values():
            if isinstance(value, Kernel):
                value.load()


def active() -> bool:
    """Whether kernels are used: numba is there, works, and is not switched off."""
    return _wanted and _works()


def numba_version() -> str | None:
    """Version of numba if kernels are used, else None."""
    return str(import_module("numba").__version__) if active() else None


@contextmanager
def switched(on: bool) -> Iterator[None]:
    """Use kernels, or do not, in this block; for comparisons. Acts on the whole process."""
    global _wanted
    before = _wanted
    _wanted = on
    try:
        yield
    finally:
        _wanted = before


@cache
def _tell_once() -> None:
    logger.info("compiling loops for this processor: takes some seconds, once")


def _writable(value: object) -> object:
    """A copy of an array that must not be written; anything else as it is."""
    return value.copy() if isinstance(value, np.ndarray) and not value.flags.writeable else value


@cache
def _works() -> bool:
    if find_spec("numba") is None:
        return False
    try:
        import_module("numba")
    except Exception as error:
        warnings.warn(
            f"numba is installed but does not start ({error}); going on without it, more slowly. "
            f"`pip install -U numba` may mend it, {VARIABLE}=0 silences this.",
            RuntimeWarning,
            stacklevel=2,
        )
        return False
    return True
