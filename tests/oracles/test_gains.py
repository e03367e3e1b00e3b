"""Each kernel has one plain version, and both compute the same."""

from __future__ import annotations

from collections import Counter

import pytest

from tests.oracles.gains import Gain, gains, kernels


def test_each_kernel_has_one_oracle() -> None:
    entries = Counter(entry.name for entry in gains())
    assert [name for name, count in entries.items() if count > 1] == []
    assert set(entries) - set(kernels()) == set()
    modules = {entry.kernel.plain.__module__ for entry in gains()}
    begun = {name for name, kernel in kernels().items() if kernel.plain.__module__ in modules}
    assert begun - set(entries) == set()


@pytest.mark.parametrize("gain", gains(), ids=lambda gain: gain.name)
def test_a_kernel_agrees_with_its_oracle(gain: Gain) -> None:
    assert gain.differences() == []
