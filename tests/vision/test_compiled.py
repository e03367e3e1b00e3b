"""Compiled loops: what they compute, that they are kept on disk, and that people are told while they wait."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.vision.compiled import helper, kernel

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
def after(n):
    return next_one(n)

@kernel("int64(int64[::1])")
def total(values):
    found = 0
    for value in values:
        found += value
    return found
"""

PROGRAM = """
import numpy as np
import loops
from tactflow.vision import compiled
print(*compiled.load(), loops.twice(3), loops.after(7), loops.total(np.arange(4)))
"""

RESULTS = "6 8 6\n"


def write_program(folder: Path) -> Path:
    (folder / "loops.py").write_text(MODULE)
    (folder / "program.py").write_text(PROGRAM)
    return folder


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A program with loops that nobody has compiled."""
    return write_program(tmp_path)


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> subprocess.CompletedProcess[str]:
    """The run that compiles the loops of `kept`."""
    return run(write_program(tmp_path_factory.mktemp("kept")))


@pytest.fixture
def compiled(first: subprocess.CompletedProcess[str]) -> Path:
    """A program whose loops are compiled."""
    return Path(first.args[1]).parent


def run(folder: Path, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run PROGRAM; loops are kept in `kept` unless said otherwise."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(folder / "kept"), **variables}
    environment = {name: value for name, value in environment.items() if value}
    command = [sys.executable, str(folder / "program.py")]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=True)


@helper
def _scaled(value: float) -> float:
    return value * FACTOR


@helper
def _shifted(value: float) -> float:
    return _scaled(value) + 1.0


@kernel("void(Array(float64, 1, 'C', readonly=True), float64[::1])")
def _running_sum(values: NDArray[np.float64], sums: NDArray[np.float64]) -> None:
    total = 0.0
    for index in range(values.size):
        total += _shifted(values[index])
        sums[index] = total


FACTOR = 3.0


def test_a_kernel_does_what_its_loops_and_their_helpers_say() -> None:
    values = np.random.default_rng(3).normal(size=1000)
    values.setflags(write=False)
    fast, slow = np.empty(1000), np.empty(1000)
    _running_sum(values, fast)
    _running_sum.plain(values, slow)
    np.testing.assert_allclose(fast, slow, rtol=1e-12)
    assert _shifted(2.0) == 7.0


def test_a_kernel_refuses_types_that_its_signature_does_not_name() -> None:
    for wrong in (np.empty(8)[::2], np.empty(4, np.float32)):
        with pytest.raises(TypeError):
            _running_sum(np.arange(4.0), wrong)


def test_what_was_compiled_once_is_read_from_disk_without_a_word(
    first: subprocess.CompletedProcess[str], compiled: Path
) -> None:
    second = run(compiled)
    assert first.stdout == f"3 3 {RESULTS}"
    assert first.stderr.count("tactflow: compiling 3 loops for this processor, once") == 1
    assert (second.stdout, second.stderr) == (f"3 0 {RESULTS}", "")


def test_damaged_files_are_replaced(compiled: Path) -> None:
    kept = compiled / "kept"
    for empty, zeros in (("twice*.nbi", "total*.nbc"), ("twice*.nbc", "total*.nbi")):
        for pattern, content in ((empty, b""), (zeros, bytes(300))):
            (file,) = kept.rglob(f"loops.{pattern}")
            file.write_bytes(content)
        assert run(compiled).stdout == f"3 2 {RESULTS}"
    assert run(compiled).stdout == f"3 0 {RESULTS}"


def test_where_nothing_can_be_kept_loops_are_compiled_in_each_run(folder: Path) -> None:
    # Files where folders would have to be: not even root can write into them.
    (folder / "__pycache__").write_text("")
    (folder / "home").write_text("")
    nowhere = {
        "NUMBA_CACHE_DIR": "",
        "HOME": str(folder / "home"),
        "XDG_CACHE_HOME": str(folder / "home/cache"),
    }
    done = run(folder, **nowhere)
    assert done.stdout == f"3 3 {RESULTS}"
    assert done.stderr.count("loops are compiled in each run: they cannot be cached") == 1


def test_without_the_compiler_loops_run_as_plain_python(folder: Path) -> None:
    assert run(folder, NUMBA_DISABLE_JIT="1").stdout == f"3 0 {RESULTS}"


def test_numba_is_not_imported_before_a_loop_is_needed(folder: Path) -> None:
    (folder / "program.py").write_text("import loops, sys\nprint('numba' in sys.modules)")
    assert run(folder).stdout == "False\n"
