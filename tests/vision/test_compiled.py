"""Compiled kernels: used where numba works, and nothing lost where it does not."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.vision import compiled
from tactflow.vision.compiled import kernel


@kernel("void(float64[::1], float64[::1])")
def _running_sum(values: NDArray[np.float64], sums: NDArray[np.float64]) -> None:
    total = 0.0
    for index in range(values.size):
        total += values[index]
        sums[index] = total


@pytest.fixture
def forgetful() -> Iterator[None]:
    """Whether numba works is asked anew in this test, and again after it."""
    compiled._works.cache_clear()
    yield
    compiled._works.cache_clear()


def test_a_kernel_does_what_its_loops_say() -> None:
    with compiled.switched(True):
        if not compiled.active():
            pytest.skip('numba is not here: pip install "tactflow[fast]"')
        values = np.random.default_rng(3).normal(size=1000)
        fast, slow = np.empty(1000), np.empty(1000)
        _running_sum(values, fast)
        _running_sum.plain(values, slow)
        # Without `reorder` the operations are the same in the same order, so the bits are.
        assert np.array_equal(fast, slow)


def test_a_kernel_reads_what_must_not_be_written() -> None:
    if not compiled.active():
        pytest.skip('numba is not here: pip install "tactflow[fast]"')
    values, sums = np.arange(4.0), np.empty(4)
    values.setflags(write=False)
    _running_sum(values, sums)
    assert sums.tolist() == [0, 1, 3, 6]


def test_a_kernel_refuses_what_its_signature_does_not_name() -> None:
    if not compiled.active():
        pytest.skip('numba is not here: pip install "tactflow[fast]"')
    with pytest.raises(TypeError):
        _running_sum(np.arange(8.0)[::2], np.empty(4))


def test_switching_acts_inside_its_block_only() -> None:
    before = compiled.active()
    with compiled.switched(False):
        assert not compiled.active()
        assert compiled.numba_version() is None
    assert compiled.active() == before


@pytest.mark.parametrize("value", ["0", "off", "No", " false "])
def test_the_environment_switches_kernels_off(value: str) -> None:
    code = (
        "from tactflow.vision import compiled; import sys; print(compiled.active(), 'numba' in sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, compiled.VARIABLE: value},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.split() == ["False", "False"]


@pytest.mark.usefixtures("forgetful")
def test_where_numba_is_missing_nothing_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiled, "find_spec", lambda _: None)
    with compiled.switched(True):
        assert not compiled.active()


@pytest.mark.usefixtures("forgetful")
def test_a_broken_numba_is_reported_and_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(_: str) -> SimpleNamespace:
        raise ImportError("Numba needs NumPy 1.0 or less")

    monkeypatch.setattr(compiled, "find_spec", lambda _: SimpleNamespace())
    monkeypatch.setattr(compiled, "import_module", broken)
    with (
        compiled.switched(True),
        pytest.warns(RuntimeWarning, match=r"does not start \(Numba needs NumPy 1.0 or less\).*pip install"),
    ):
        assert not compiled.active()


def test_compiling_is_announced_once_and_not_again_when_it_is_on_disk(tmp_path: Path) -> None:
    if not compiled.active():
        pytest.skip('numba is not here: pip install "tactflow[fast]"')
    module = tmp_path / "loops.py"
    module.write_text(
        "import logging; logging.basicConfig(level='INFO')\n"
        "from tactflow.vision import compiled\n"
        "@compiled.kernel('int64(int64)')\n"
        "def twice(n): return 2 * n\n"
        "@compiled.kernel('int64(int64)')\n"
        "def thrice(n): return 3 * n\n"
        "import sys; compiled.load(sys.modules[__name__])\n"
        "print(twice(3) + thrice(5))\n"
    )
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "kept")}
    said = [
        subprocess.run([sys.executable, module], env=environment, capture_output=True, text=True, check=True)
        for _ in range(2)
    ]
    assert [run.stdout.strip() for run in said] == ["21", "21"]
    assert [run.stderr.count("once") for run in said] == [1, 0]


def test_a_kernel_works_where_its_result_cannot_be_kept() -> None:
    if not compiled.active():
        pytest.skip('numba is not here: pip install "tactflow[fast]"')
    # Code that does not come from a file has no place beside it.
    code = (
        "from tactflow.vision.compiled import kernel\n"
        "exec('def twice(x):\\n    return 2 * x')\n"
        "print(kernel('float64(float64)')(twice)(21.0))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "42.0"


def test_the_switch_says_when_it_was_set_to_something_unknown() -> None:
    assert [compiled._asked_for(word) for word in (None, "", "1", " Yes ", "0", "OFF")] == [True] * 4 + [
        False
    ] * 2
    with pytest.warns(RuntimeWarning, match="TACTFLOW_COMPILED=nope: required 1 or 0"):
        assert compiled._asked_for("nope")
