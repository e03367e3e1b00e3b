"""Each kernel has one plain version, and both compute the same."""

from __future__ import annotations

import pytest

from tests.oracles.gains import Gain, gains, kernels


def test_each_kernel_has_one_oracle() -> None:
    assert sorted(entry.name for entry in gains()) == sorted(kernels())


@pytest.mark.parametrize("gain", gains(), ids=lambda gain: gain.name)
def test_a_kernel_agrees_with_its_oracle(gain: Gain) -> None:
    assert gain.differences() == []
