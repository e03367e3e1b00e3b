"""Compiled kernels: what they compute, where they are kept, and who compiles them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numba
import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.vision import compiled, kernel_cache
from tactflow.vision.compiled import helper, kernel, prefetch

MODULE = """
from tactflow.vision.compiled import helper, kernel

STEP = 1

@helper
def next_one(n):
    return n + STEP

@kernel("int64(int64)")
def twice(n):
    return 2 * n

@kernel("int64(int64)")
def thrice(n):
    return 3 * n

@kernel("int64(int64)")
def after(n):
    return next_one(n)

@kernel("int64(int64[::1])")
def total(values):
    found = 0
    for value in values:
        found += value
    return found

@kernel("float64(float64[:, ::1])")
def largest(values):
    found = -1.0
    for row in values:
        for value in row:
            found = max(found, value)
    return found
"""

PROGRAM = """
import logging
import numpy as np
logging.basicConfig(level="INFO")
from tactflow.vision import compiled
import loops
before = compiled.warm_up()
print(before, loops.twice(3), loops.thrice(5), loops.after(7),
      loops.total(np.arange(4)), loops.largest(np.eye(3)))
"""


@kernel("void(float64[::1], float64[::1])")
def _running_sum(values: NDArray[np.float64], sums: NDArray[np.float64]) -> None:
    total = 0.0
    for index in range(values.size):
        total += values[index]
        sums[index] = total


@helper
def _scaled(value: float) -> float:
    return value * FACTOR


@helper
def _shifted(value: float) -> float:
    return _scaled(value) + 1.0


@kernel("float64(float64)")
def _moved(value: float) -> float:
    return _shifted(value)


@kernel("int64(uint8[::1], int64)")
def _sum_ahead(values: NDArray[np.uint8], ahead: int) -> int:
    total = 0
    for index in range(values.size):
        prefetch(values, index + ahead)
        total += values[index]
    return total


FACTOR = 3.0


Program = Callable[..., subprocess.Popen[str]]


def program_in(folder: Path) -> Program:
    """Starts PROGRAM in a folder; kernels are kept in `kept` unless said otherwise."""
    (folder / "loops.py").write_text(MODULE)
    (folder / "program.py").write_text(PROGRAM)

    def start(**variables: str) -> subprocess.Popen[str]:
        environment = {**os.environ, "NUMBA_CACHE_DIR": str(folder / "kept"), **variables}
        return subprocess.Popen(
            [sys.executable, "program.py"],
            cwd=folder,
            env={name: value for name, value in environment.items() if value},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    return start


@pytest.fixture
def program(tmp_path: Path) -> Program:
    """PROGRAM in a fresh folder."""
    return program_in(tmp_path)


class Warm(NamedTuple):
    """A folder whose kernels are on disk: what starts PROGRAM there, its first output and what it said."""

    folder: Path
    program: Program
    first: tuple[str, str]


@pytest.fixture(scope="module")
def warm(tmp_path_factory: pytest.TempPathFactory) -> Warm:
    """Compiled once for many tests, which leave whole kernels behind."""
    folder = tmp_path_factory.mktemp("warm")
    program = program_in(folder)
    return Warm(folder, program, program().communicate())


@contextmanager
def hold(folder: Path, name: str) -> Iterator[subprocess.Popen[str]]:
    """A process that has claimed a kernel until it is killed."""
    holder = textwrap.dedent(f"""
        import time
        from tactflow.vision.kernel_cache import claimed
        with claimed({str(folder)!r}, {name!r}, wait=True) as mine:
            print(mine, flush=True)
            time.sleep(1000)
    """)
    with subprocess.Popen([sys.executable, "-c", holder], stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "True\n"
            yield process
        finally:
            process.kill()


RESULTS = ["6", "15", "8", "6", "1.0"]


def test_a_kernel_does_what_its_loops_say() -> None:
    values = np.random.default_rng(3).normal(size=1000)
    fast, slow = np.empty(1000), np.empty(1000)
    _running_sum(values, fast)
    _running_sum.plain(values, slow)
    # Without `reorder` the operations are the same in the same order, so the bits are.
    assert np.array_equal(fast, slow)


def test_a_kernel_reads_what_must_not_be_written() -> None:
    values, sums = np.arange(4.0), np.empty(4)
    values.setflags(write=False)
    _running_sum(values, sums)
    assert sums.tolist() == [0, 1, 3, 6]


def test_a_kernel_refuses_to_lose_what_it_would_write_to_a_read_only_array() -> None:
    values, sums = np.arange(4.0), np.empty(4)
    sums.setflags(write=False)
    with pytest.raises(ValueError, match="argument 1"):
        _running_sum(values, sums)


def test_a_kernel_refuses_what_its_signature_does_not_name() -> None:
    with pytest.raises(TypeError):
        _running_sum(np.arange(8.0)[::2], np.empty(4))


def test_a_kernel_calls_helpers_of_its_file_which_call_others() -> None:
    assert _moved(2.0) == 7.0
    assert _moved.plain(2.0) == 7.0


@pytest.mark.parametrize("ahead", [0, 64, -10_000, 10**9])
def test_to_ask_for_values_ahead_changes_no_result_even_beyond_the_array(ahead: int) -> None:
    values = np.arange(256, dtype=np.uint8)
    prefetch(values, ahead)
    assert _sum_ahead(values, ahead) == 255 * 128


def test_to_ask_for_values_ahead_is_an_instruction_of_the_compiled_loop() -> None:
    # One that comes from the disk cannot be looked into.
    fresh: Any = numba.njit("int64(uint8[::1], int64)")(compiled._with_helpers(_sum_ahead.plain, {}))
    (code,) = fresh.inspect_llvm().values()
    assert "call void @llvm.prefetch" in code


def test_a_ctrl_c_waits_until_the_compiler_is_through_with_the_kernel(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    through: list[bool] = []
    compile_or_read = compiled.Kernel._compile_or_read

    def interrupted(*args: Any) -> Any:
        signal.raise_signal(signal.SIGINT)
        found = compile_or_read(*args)
        through.append(True)
        return found

    monkeypatch.setattr(compiled.Kernel, "_compile_or_read", interrupted)
    with pytest.raises(KeyboardInterrupt):
        kernel("int64(int64)")(lambda n: n + 7).load()
    assert through == [True]
    assert not compiled.is_loading()


@pytest.mark.parametrize("passed_over", [True, False])
def test_garbage_is_looked_for_in_loaded_kernels_only_where_it_is_looked_for_in_imports(
    passed_over: bool, warm: Warm
) -> None:
    code = (
        f"import gc, loops; from tactflow.vision import compiled; {passed_over} and gc.freeze();"
        "before = gc.get_freeze_count(); compiled.load(loops);"
        "print(gc.isenabled(), gc.get_freeze_count() > before)"
    )
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(warm.folder / "kept")}
    command = [sys.executable, "-c", code]
    assert subprocess.check_output(command, cwd=warm.folder, env=environment, text=True).split() == [
        "True",
        str(passed_over),
    ]


def test_compiling_is_announced_once_and_not_again_when_it_is_on_disk(warm: Warm) -> None:
    assert warm.first[0].split()[1:] == RESULTS
    assert warm.first[1].count("compiling") == 1
    assert warm.program().communicate() == (" ".join(["0", *RESULTS]) + "\n", "")


def test_two_processes_that_start_together_compute_the_same(
    program: Program,
) -> None:
    both = [program(), program()]
    ends = [process.communicate() for process in both]
    assert [end[0].split()[1:] for end in ends] == [RESULTS] * 2, ends
    # What one of them has compiled, the other has found.
    assert sum(int(end[0].split()[0]) for end in ends) <= 5


def test_what_a_killed_process_had_claimed_is_compiled_by_the_next(tmp_path: Path) -> None:
    with hold(tmp_path, "loops.twice") as holder:
        with kernel_cache.claimed(str(tmp_path), "loops.twice", wait=False) as mine:
            assert not mine
        with kernel_cache.claimed(str(tmp_path), "loops.thrice", wait=False) as mine:
            assert mine
        holder.send_signal(signal.SIGKILL)
    with kernel_cache.claimed(str(tmp_path), "loops.twice", wait=False) as mine:
        assert mine


def test_a_kernel_works_where_its_result_cannot_be_kept() -> None:
    # Code that does not come from a file has no place beside it.
    code = (
        "from tactflow.vision.compiled import kernel\n"
        "exec('def twice(x):\\n    return 2 * x')\n"
        "print(kernel('float64(float64)')(twice)(21.0))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "42.0"


def test_where_numba_may_write_nowhere_kernels_are_kept_in_a_temporary_folder_that_nobody_else_writes_to(
    program: Program, tmp_path: Path
) -> None:
    # A file where a folder would have to be: not even root can write into it.
    (tmp_path / "__pycache__").write_text("")
    (tmp_path / "home").write_text("")
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    place = {"NUMBA_CACHE_DIR": "", "HOME": str(tmp_path / "home"), "TMPDIR": str(temporary)}
    place["XDG_CACHE_HOME"] = str(tmp_path / "home" / "cache")
    first, second = (program(**place).communicate() for _ in range(2))
    assert first[0].split()[1:] == RESULTS, first
    assert second == (" ".join(["0", *RESULTS]) + "\n", "")
    (folder,) = temporary.iterdir()
    assert folder.stat().st_mode & 0o777 == 0o700
    folder.chmod(0o777)
    out, said = program(**place).communicate()
    assert out.split()[1:] == RESULTS
    assert "belongs to somebody else" in said


def test_a_damaged_cache_is_said_and_compiled_around(warm: Warm) -> None:
    (index,) = (warm.folder / "kept").rglob("loops.twice*.nbi")
    whole = index.read_bytes()
    index.write_bytes(b"")
    out, said = warm.program().communicate()
    index.write_bytes(whole)
    assert out.split()[1:] == RESULTS, said
    assert "cannot be kept or read" in said


def test_a_damaged_file_of_the_cache_is_replaced(warm: Warm) -> None:
    for damaged in ("loops.twice*.nbi", "loops.thrice*.nbc"):
        (file,) = (warm.folder / "kept").rglob(damaged)
        file.write_bytes(bytes(300))
    out, said = warm.program().communicate()
    assert out.split() == ["2", *RESULTS], said
    assert "compiled again" in said
    assert warm.program().communicate() == (" ".join(["0", *RESULTS]) + "\n", "")


def test_processes_that_compile_run_no_code_of_the_current_folder(tmp_path: Path) -> None:
    (tmp_path / "getpass.py").write_text("open('executed', 'w')\n")
    (tmp_path / "modules").mkdir()
    (tmp_path / "modules" / "loops.py").write_text(MODULE)
    starter = f"""
import sys
sys.path[:] = [{str(tmp_path / "modules")!r}, *(path for path in sys.path if path)]
from tactflow.vision import compiled
import loops
compiled.os.sched_getaffinity = lambda _: {{0, 1}}
(worker,) = compiled._start_workers(compiled.known())
print(len(worker.stdout.read().splitlines()))
"""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "kept")}
    environment.pop("PYTHONSAFEPATH", None)
    done = subprocess.run(
        [sys.executable, "-c", starter],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout == "5\n", done.stderr
    assert not (tmp_path / "executed").exists()


@pytest.mark.skipif(sys.platform == "win32", reason="there are no claims on Windows")
def test_a_process_that_waits_for_another_says_so(warm: Warm) -> None:
    (index,) = (warm.folder / "kept").rglob("loops.twice*.nbi")
    with hold(index.parent, "loops.twice") as holder:
        waiting = warm.program()
        assert waiting.stderr is not None
        assert "waiting for another process" in waiting.stderr.readline()
        holder.kill()
    out, said = waiting.communicate()
    assert out.split() == ["0", *RESULTS]
    assert said == ""


@pytest.mark.skipif(sys.platform == "win32", reason="there are no claims on Windows")
def test_nobody_waits_for_ever_for_a_process_that_is_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kernel_cache, "PATIENCE_S", 0.2)
    with hold(tmp_path, "loops.twice") as holder:
        holder.send_signal(signal.SIGSTOP)
        begin = time.monotonic()
        with kernel_cache.claimed(str(tmp_path), "loops.twice", wait=True) as mine:
            assert mine
        assert time.monotonic() - begin >= 0.2
        holder.kill()


def test_without_the_compiler_kernels_run_as_plain_python_and_say_so(
    program: Program,
) -> None:
    out, said = program(NUMBA_DISABLE_JIT="1").communicate()
    assert out.split() == ["0", *RESULTS], said
    assert "very slow" in said
