"""Every example in a docstring runs and shows what it says."""

from __future__ import annotations

import doctest
import importlib
import pkgutil
from pathlib import Path

import pytest

import tactflow


def modules() -> list[str]:
    """Every module of the package."""
    found = pkgutil.walk_packages(tactflow.__path__, "tactflow.")
    return ["tactflow", *(module.name for module in found if not module.name.endswith("__main__"))]


@pytest.mark.parametrize("name", modules())
def test_the_examples_of_a_module_run(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    module = importlib.import_module(name)
    monkeypatch.chdir(tmp_path)
    flags = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
    assert doctest.testmod(module, optionflags=flags).failed == 0


@pytest.mark.parametrize("name", tactflow.__all__)
def test_everything_public_has_an_example(name: str) -> None:
    assert ">>>" in (getattr(tactflow, name).__doc__ or "")
