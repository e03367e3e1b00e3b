"""Run the package with plain versions in place of kernels."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from types import ModuleType

import pytest


@contextmanager
def plain(*oracles: ModuleType) -> Iterator[None]:
    """In this block the plain versions of these oracle modules run instead of their kernels."""
    with pytest.MonkeyPatch.context() as patch:
        for oracle in oracles:
            for gain in oracle.GAINS:
                module = import_module(gain.kernel.plain.__module__)
                patch.setattr(module, gain.kernel.__name__, gain.plain)
        yield
