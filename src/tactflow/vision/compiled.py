"""Kernels: loops over pixels, markers and outlines that numba compiles for this processor.

A kernel stands beside its caller and gives the types of what it takes, so that no call has to find them out:

    @kernel("void(uint8[:, ::1], float32[::1])")
    def _column_sums(picture, sums):
        for row in range(picture.shape[0]):
            _add(picture[row], sums)

    @helper
    def _add(line, sums):
        for column in range(sums.size):
            sums[column] += line[column]

A long kernel is split into helpers: functions of the same file, typed by their use, compiled into each kernel
that calls them and with its options. Constants that a kernel uses stand in its own file, too: numba compiles
a kernel again when its file has changed, and looks at no other.

What a kernel calls of numpy is compiled with it, for each type anew: `np.empty` and a fill, `values[:] = 0`,
take less of that than `np.zeros`, `np.ones` or `np.full`.

A kernel is compiled on its first call, or by `load`, which the constructor of a stage calls so that no frame
has to wait. The first one that is not on disk yet starts the compiling of all that are imported, on all
processors; what is compiled is kept on disk (see `kernel_cache`). Kernels run without Python's lock: several
segments of a pipeline work at the same time.

`NUMBA_DISABLE_JIT=1` runs them as plain Python, slowly, for a debugger; there, a sum of two uint8 is one too,
where numba's is wider.
"""

from __future__ import annotations

import gc
import json
import logging
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from importlib import import_module
from pickle import PickleError
from types import FunctionType, ModuleType
from typing import Any, Generic, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

from tactflow.system.signals import ending_held_back
from tactflow.vision.kernel_cache import POLL_S, claimed, dispatcher_of

logger = logging.getLogger("tactflow")

P = ParamSpec("P")
R = TypeVar("R")

Report = Callable[[int, int], None]
"""Told, while kernels are compiled, how many are ready, and how many there are."""

_REASSOCIATED = {"reassoc", "contract", "arcp", "nsz"}
"""Freedoms of the compiler: sums in any order. It must still respect NaN and infinity."""

_MOST_PROCESSES = 4
"""Processes that compile. Chosen by hand: the longest kernel takes a tenth of the whole."""
_WORKER = "from tactflow.vision import compiled; compiled._work()"
"""What a process that is started to compile runs."""
_SAID_AFTER_S = 2.0
"""Time after which it is said that another process is waited for. To read all loops takes half a second."""
_LEAST_SHARED = 4
"""Kernels for which others are started; to start one takes as long as to compile two. Chosen by hand."""

_UNKEPT = (
    *(OSError, EOFError, PickleError, AttributeError, ImportError),
    *(LookupError, RuntimeError, TypeError, ValueError),
)
"""What numba raises where a file cannot be written, or a damaged one is read."""

_lock = threading.RLock()
_known: dict[str, Kernel[..., Any]] = {}
_reports: list[Report] = []
_listeners: list[Callable[[str], None]] = []
"""Told the name of each kernel that this process has compiled, while it holds the claim."""
_loading = threading.Event()
"""Set while kernels are compiled or read."""


class Kernel(Generic[P, R]):
    """A function that numba compiles when it is first needed.

    plain : the Python function.
    signature : numba's, so that no call has to find out its types. C-contiguous arrays are `[:, ::1]`.
    reorder : whether sums of floats may be taken in any order, which lets them run in parallel lanes; if not,
        operations are those of the Python code, in its order.
    compiled_here : whether this process, or one that it has started, has compiled it, rather than found it
        on disk.
    kept : whether it has a place on disk.

    >>> @kernel("float64(float64[::1])")
    ... def total(values):
    ...     found = 0.0
    ...     for value in values:
    ...         found += value
    ...     return found
    >>> total(np.array([1.0, 2.0]))
    3.0
    """

    def __init__(self, plain: Callable[P, R], signature: str, reorder: bool) -> None:
        self.plain = plain
        self.compiled_here = self.kept = False
        self._signature = signature
        self._options: dict[str, Any] = {
            "nogil": True,
            "error_model": "numpy",
            "fastmath": _REASSOCIATED if reorder else False,
            # An entry for C that nobody uses; compiling all takes 0.9 times as long without.
            "no_cfunc_wrapper": True,
            # Rewriting serves expressions of whole arrays; compiling all takes 0.95 times as long without.
            # It also made products of powers, `x**2`, and slices of shapes: kernels have none of these.
            "no_rewrites": True,
        }
        self._compiled: Callable[P, R] | None = None
        self.__doc__ = plain.__doc__
        self.__name__ = plain.__name__
        _known[self.name] = self

    @property
    def name(self) -> str:
        """Dotted name."""
        return f"{self.plain.__module__}.{self.__name__}"

    @property
    def ready(self) -> bool:
        """Whether it can be called at once."""
        return self._compiled is not None

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        if self._compiled is None:
            _make_ready([self])
            assert self._compiled is not None
        try:
            return self._compiled(*args, **kwargs)
        except TypeError:
            # To numba, an array that must not be written is of another type.
            given: Any = [_writable(value) for value in args]
            if all(one is other for one, other in zip(given, args, strict=True)):
                raise
            result = self._compiled(*given, **kwargs)
            for place, (copy, value) in enumerate(zip(given, args, strict=True)):
                if copy is not value and copy.tobytes() != np.asarray(value).tobytes():
                    text = (
                        f"{self.name}: required an array to write to as argument {place}, got a read-only one"
                    )
                    raise ValueError(text) from None
            return result

    def load(self, *, wait: bool = True) -> bool:
        """Compile, or take what is on disk; returns whether it is ready.

        wait : for another process that is compiling it; otherwise it is left to that one.
        """
        with _lock:
            if self._compiled is None:
                self._compiled = self._load(wait)
            return self.ready

    def _load(self, wait: bool) -> Callable[P, R] | None:
        numba = import_module("numba")
        if numba.config.DISABLE_JIT:
            _warn_once(
                "NUMBA_DISABLE_JIT is set: kernels run as plain Python, for a debugger: very slow, and "
                "results are wrong where sums of small integers overflow"
            )
            return self.plain
        function = _with_helpers(self.plain, self._options)
        found = dispatcher_of(function, self._options)
        with claimed(found.stats.cache_path, self.name, wait) as mine:
            if not mine:
                return None
            # An exception within the compiler would leave its objects half made, which then complain.
            with ending_held_back():
                found, self.kept = self._compile_or_read(found, function)
            self.compiled_here = bool(found.stats.cache_misses) or not self.kept
            if self.compiled_here:
                for tell in _listeners:
                    tell(self.name)
        found.disable_compile()
        compiled: Callable[P, R] = found
        return compiled

    def _compile_or_read(self, found: Any, function: Callable[P, R]) -> tuple[Any, bool]:
        """The dispatcher, ready, and whether it is kept on disk; a damaged file is replaced."""
        numba = import_module("numba")
        try:
            found.compile(self._signature)
            return found, found.stats.cache_path is not None
        except _UNKEPT as error:
            if found.signatures:
                # Compiled, but not written.
                _warn_once(f"compiled loops cannot be kept ({error}); they are compiled in each run")
                return found, False
            _warn_once(f"compiled loops cannot be kept or read ({error}); they are compiled again")
        # An empty index takes the place of what cannot be read.
        with suppress(*_UNKEPT):
            found.recompile()
            found.compile(self._signature)
            return found, True
        found = numba.njit(**self._options)(function)
        found.compile(self._signature)
        return found, False


def kernel(signature: str, *, reorder: bool = False) -> Callable[[Callable[P, R]], Kernel[P, R]]:
    """Decorator of a function of loops; see `Kernel`."""

    def wrap(function: Callable[P, R]) -> Kernel[P, R]:
        return Kernel(function, signature, reorder)

    return wrap


class Helper(Generic[P, R]):
    """A function that kernels of its file call; called from elsewhere, it is plain Python."""

    def __init__(self, plain: Callable[P, R]) -> None:
        self.plain = plain
        self.__doc__ = plain.__doc__
        self.__name__ = plain.__name__

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        return self.plain(*args, **kwargs)


def helper(function: Callable[P, R]) -> Helper[P, R]:
    """Decorator of a function that is compiled into the kernels of its file that call it.

    >>> @helper
    ... def square(value):
    ...     return value * value
    >>> square(3.0)
    9.0
    """
    return Helper(function)


@helper
def prefetch(values: NDArray[Any], index: int) -> None:
    """Have a value brought into the caches before it is needed; only a compiled loop can ask for that.

    values : (n,), C-contiguous. index : may lie outside, where nothing is brought.
    """


def load(*modules: ModuleType) -> None:
    """Make all kernels of some modules ready."""
    _make_ready([value for module in modules for value in vars(module).values() if isinstance(value, Kernel)])


def known() -> list[Kernel[..., Any]]:
    """The kernels of all modules that are imported."""
    return list(_known.values())


def warm_up() -> int:
    """Make all kernels of the imported modules ready; returns how many of them had to be compiled."""
    before = [kernel for kernel in known() if not kernel.ready]
    _make_ready(before)
    return sum(kernel.compiled_here for kernel in before)


@contextmanager
def reporting(report: Report) -> Iterator[None]:
    """Have `report` called while kernels are compiled in this block."""
    _reports.append(report)
    try:
        yield
    finally:
        _reports.remove(report)


def numba_version() -> str:
    """Version of numba."""
    return str(import_module("numba").__version__)


def is_loading() -> bool:
    """Whether kernels are being compiled or read, which a KeyboardInterrupt in that thread ends."""
    return _loading.is_set()


def _make_ready(kernels: Sequence[Kernel[..., Any]]) -> None:
    """Load kernels; after the first that was not on disk, compile all that are imported."""
    if all(kernel.ready for kernel in kernels):
        return
    with _lock, _without_collector():
        _loading.set()
        try:
            # The shortest first: the others wait until it is clear that they must be compiled.
            for kernel in sorted(kernels, key=_length):
                if not kernel.ready:
                    _load_first(kernel)
                    if kernel.compiled_here:
                        others = known() if kernel.kept else kernels
                        _compile([other for other in others if not other.ready], shared=kernel.kept)
        finally:
            _loading.clear()


@contextmanager
def _without_collector() -> Iterator[None]:
    """Keep Python from looking for garbage in the block: what numba makes of code is long in use.

    Compiling all takes 0.9 times as long (CPU time of one process, in turns). A program that looks for no
    garbage in what it has imported does not look there either: a twentieth of the start of `tactflow run`.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if gc.get_freeze_count():
            gc.freeze()
        if was_enabled:
            gc.enable()


def _load_first(kernel: Kernel[..., Any]) -> None:
    """Load a kernel, and say so if one that compiles must be waited for; one that reads is soon done."""
    until = time.monotonic() + _SAID_AFTER_S
    while not kernel.load(wait=False):
        if time.monotonic() >= until:
            _say_once("waiting for another process, which prepares the same loops")
            kernel.load()
            return
        time.sleep(POLL_S)


def _compile(pending: list[Kernel[..., Any]], *, shared: bool) -> None:
    """Make kernels ready; shared : with other processes, which needs a place on disk."""
    if not pending:
        return
    total = len(pending) + 1
    logger.info("compiling %d loops for this processor, once", total)
    pending.sort(key=_length, reverse=True)
    kernels: list[Kernel[..., Any]] = list(pending)
    workers: list[subprocess.Popen[str]] = []
    try:
        if shared:
            # A KeyboardInterrupt in between would leave one that nobody ends.
            with ending_held_back():
                workers += _start_workers(pending)
        while pending:
            done = next((kernel for kernel in pending if kernel.load(wait=False)), None)
            if done is None:
                # Other processes are at all that are left.
                done = pending[0]
                done.load()
            pending.remove(done)
            for report in _reports:
                report(total - len(pending), total)
    finally:
        names = _end_workers(workers)
        for kernel in kernels:
            kernel.compiled_here |= kernel.name in names


def _length(kernel: Kernel[..., Any]) -> int:
    """Bytes of its code: roughly in proportion to the time that compiling takes."""
    return _code_length(kernel.plain)


@cache
def _code_length(function: Callable[..., Any]) -> int:
    """Bytes of the code of a function and of its helpers."""
    helpers = [function.__globals__.get(name) for name in function.__code__.co_names]
    return len(function.__code__.co_code) + sum(
        _code_length(value.plain) for value in helpers if isinstance(value, Helper)
    )


def processors() -> int:
    """Processors that this process may use."""
    if sys.platform == "linux":
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _start_workers(kernels: Sequence[Kernel[..., Any]]) -> list[subprocess.Popen[str]]:
    """Processes that compile these kernels, too; each takes those that no other has claimed."""
    # There are no claims on Windows. The executable of a frozen program is the program, not Python.
    alone = sys.platform == "win32" or not sys.executable or getattr(sys, "frozen", False)
    if alone or len(kernels) < _LEAST_SHARED:
        return []
    order = {"path": sys.path, "kernels": [(kernel.plain.__module__, kernel.name) for kernel in kernels]}
    return [
        subprocess.Popen(
            # Without -P, modules of the current folder would be imported.
            [sys.executable, "-P", "-c", _WORKER, json.dumps(order)],
            # It ends with this process, whatever ends that.
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            # Ctrl-C does not reach it: this process ends it.
            start_new_session=True,
        )
        for _ in range(min(processors(), _MOST_PROCESSES) - 1)
    ]


def _end_workers(workers: Sequence[subprocess.Popen[str]]) -> set[str]:
    """End processes; returns the names of the kernels that they have compiled."""
    for worker in workers:
        # SIGTERM would not reach one that is stopped.
        worker.kill()
    return {name for worker in workers for name in worker.communicate()[0].splitlines()}


def _work() -> None:
    """What a worker does: compile what nobody else is at, and tell the names."""
    threading.Thread(target=_end_with_starter, daemon=True).start()
    gc.disable()
    _listeners.append(lambda name: print(name, flush=True))
    order = json.loads(sys.argv[1])
    sys.path[:] = order["path"]
    for module, name in order["kernels"]:
        with suppress(ImportError):
            import_module(module)
        if name in _known:
            _known[name].load(wait=False)


def _end_with_starter() -> None:
    """End this process when the one that has started it ends: then its side of the pipe is closed."""
    sys.stdin.read()
    os._exit(1)


def _with_helpers(function: Callable[P, R], options: dict[str, Any]) -> Callable[P, R]:
    """The function, its helpers replaced by what numba can compile into it."""
    # A helper needs no entry for Python either: compiling takes 0.9 times as long without.
    compiled = import_module("numba").njit(forceinline=True, no_cpython_wrapper=True, **options)
    helpers = {
        name: _prefetch_instruction() if value is prefetch else compiled(_with_helpers(value.plain, options))
        for name, value in function.__globals__.items()
        if name in function.__code__.co_names and isinstance(value, Helper)
    }
    if not helpers:
        return function
    linked: Callable[P, R] = FunctionType(
        function.__code__, {**function.__globals__, **helpers}, function.__name__, function.__defaults__
    )
    return linked


@cache
def _prefetch_instruction() -> Any:
    """What `prefetch` is compiled to: the instruction of the processor, if it has one."""
    ir, numba = import_module("llvmlite.ir"), import_module("numba.extending")
    number = ir.IntType(32)

    def typed(_: Any, values: Any, index: Any) -> tuple[Any, Callable[..., Any]]:
        def build(context: Any, builder: Any, signature: Any, arguments: Sequence[Any]) -> Any:
            array = context.make_array(signature.args[0])(context, builder, arguments[0])
            place = builder.gep(array.data, [arguments[1]])
            takes = ir.FunctionType(ir.VoidType(), [place.type, number, number, number])
            ask = builder.module.declare_intrinsic("llvm.prefetch", (place.type,), takes)
            # To read it, soon and more than once; it is data.
            builder.call(ask, [place, number(0), number(3), number(1)])
            return context.get_dummy_value()

        return import_module("numba").void(values, index), build

    return numba.intrinsic(typed)


@cache
def _warn_once(text: str) -> None:
    logger.warning("%s", text)


@cache
def _say_once(text: str) -> None:
    logger.info("%s", text)


def _writable(value: object) -> object:
    """A copy of an array that must not be written; anything else as it is."""
    return value.copy() if isinstance(value, np.ndarray) and not value.flags.writeable else value
