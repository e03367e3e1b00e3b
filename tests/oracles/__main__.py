"""Measures every kernel against its plain version and writes docs/kernels.md: `make kernels`."""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactflow.bench.timing import quiet
from tests.oracles.gains import Gain, gains, kernels
from tests.oracles.typical import Arguments, duplicate

REPOSITORY = Path(__file__).resolve().parents[2]
TABLE = REPOSITORY / "docs" / "kernels.md"

TURNS = 41
"""How often the two take turns; odd, so that the median is one of the turns."""
TURN = 2e-3
"""Least time of a turn, s: beside it, what a turn's first call costs more does not count."""


@dataclass(frozen=True)
class Measured:
    """Median times of a call, ms, and the ratio of the turns' medians with its interval of 95 %."""

    compiled: float
    plain: float
    ratio: float
    low: float
    high: float


def measure(gain: Gain) -> Measured:
    """Time a kernel and its plain version in turns, on the same data."""
    given = gain.typical()
    calls = tuple(_Call(function, given) for function in (gain.kernel, gain.plain))
    times: tuple[list[float], list[float]] = ([], [])
    with quiet():
        for call in calls:
            call.turn()
        for _ in range(TURNS):
            for call, found in zip(calls, times, strict=True):
                found.append(call.turn())
    ratios = sorted(plain / fast for fast, plain in zip(*times, strict=True))
    # Order statistics that hold the median of all turns in 95 of 100 cases.
    margin = round(0.98 * TURNS**0.5)
    return Measured(
        1e3 * statistics.median(times[0]),
        1e3 * statistics.median(times[1]),
        ratios[TURNS // 2],
        ratios[TURNS // 2 - margin],
        ratios[TURNS // 2 + margin],
    )


class _Call:
    """Calls a function with the same arguments again and again; what it wrote is put back in between."""

    def __init__(self, function: Callable[..., Any], given: Arguments) -> None:
        self._function = function
        self._arguments = duplicate(given)
        self._function(*self._arguments)
        self._written: list[tuple[NDArray[Any], NDArray[Any]]] = [
            (value, before)
            for value, before in zip(self._arguments, given, strict=True)
            if isinstance(value, np.ndarray) and not np.array_equal(value, before)
        ]

    def turn(self) -> float:
        """Median time of a call in one turn, s."""
        times: list[float] = []
        while sum(times) < TURN:
            for value, before in self._written:
                np.copyto(value, before)
            begin = time.perf_counter()
            self._function(*self._arguments)
            times.append(time.perf_counter() - begin)
        return statistics.median(times)


def first_compile() -> dict[str, float]:
    """Kernel -> s to compile it, one after the other in a process that finds nothing on disk."""
    with tempfile.TemporaryDirectory() as folder:
        code = "from tests.oracles.__main__ import compile_each; compile_each()"
        done = subprocess.run(
            [sys.executable, "-c", code],
            cwd=REPOSITORY,
            env=_nothing_compiled(folder),
            check=True,
            capture_output=True,
            text=True,
        )
    return dict(json.loads(done.stdout))


def _nothing_compiled(folder: str) -> dict[str, str]:
    """The environment for a process that finds no kernel; Python's own byte code may be kept, as by users."""
    kept = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    return kept | {"NUMBA_CACHE_DIR": folder}


def compile_each() -> None:
    """Compile all kernels; prints the CPU time of each, s, as JSON."""
    import_module("numba")
    times = {}
    for name, kernel in kernels().items():
        begin = time.process_time()
        kernel.load()
        times[name] = time.process_time() - begin
    print(json.dumps(times))


def first_use() -> float:
    """s that `tactflow warmup` takes with no kernel on disk, for the default pipeline, imports included."""
    with tempfile.TemporaryDirectory() as folder:
        begin = time.perf_counter()
        subprocess.run(
            [sys.executable, "-m", "tactflow", "warmup", "--quiet", REPOSITORY / "pipeline.yaml"],
            env=_nothing_compiled(folder),
            check=True,
        )
        return time.perf_counter() - begin


def markdown(
    rows: dict[str, Measured], compile_times: dict[str, float], warm_up: float, load: float
) -> Iterator[str]:
    """Lines of the page.

    rows, compile_times : kernel -> what was measured. warm_up : of `first_use`. load : processes that others
    kept running meanwhile.
    """
    yield "# What compiling gains"
    yield ""
    yield "Each kernel against its plain version of numpy and OpenCV (tests/oracles/), with the arguments"
    yield "that the default pipeline gives it on a frame with contact, one thread, in turns. The ratio is the"
    yield f"median of {TURNS} turns, with its interval of 95 %. Compiling is CPU time, once for a processor."
    yield "`make kernels` writes this page."
    yield ""
    yield "| kernel | file | compiled, ms | plain, ms | times as fast | compiling, s |"
    yield "| --- | --- | --- | --- | --- | --- |"
    for name, kernel in kernels().items():
        code = Path(kernel.plain.__code__.co_filename).relative_to(REPOSITORY)
        row = rows.get(name)
        cells = (
            f"{row.compiled:.4f} | {row.plain:.4f} | {row.ratio:.1f} ({row.low:.1f} to {row.high:.1f})"
            if row
            else "| | "
        )
        yield f"| `{kernel.__name__}` | {code} | {cells} | {compile_times[name]:.2f} |"
    yield f"| all {len(kernels())} | | | | | {sum(compile_times.values()):.1f} |"
    yield ""
    yield f"First use: `tactflow warmup` took {warm_up:.1f} s for the default pipeline, imports included and"
    yield f"nothing on disk, on {os.cpu_count()} processors, with a load of {load:.1f} by others."


def main() -> None:
    """Measure everything and write the page."""
    rows = {}
    for gain in gains():
        rows[gain.name] = measure(gain)
        print(gain.name, rows[gain.name], file=sys.stderr)
    load = os.getloadavg()[0]
    warm_up = first_use()
    TABLE.write_text("\n".join(markdown(rows, first_compile(), warm_up, load)) + "\n")


if __name__ == "__main__":
    main()
