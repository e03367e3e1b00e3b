"""The examples in the docstrings of sources and recordings run, and show what they say."""

from __future__ import annotations

import doctest
import importlib
import pkgutil
from collections.abc import Iterator

import pytest

import tactflow.recording
import tactflow.sources


def _modules() -> Iterator[str]:
    yield from ("tactflow.client", "tactflow.clock")
    for package in (tactflow.recording, tactflow.sources):
        yield package.__name__
        yield from (f"{package.__name__}.{module.name}" for module in pkgutil.iter_modules(package.__path__))


@pytest.mark.parametrize("name", list(_modules()))
def test_examples_in_docstrings_show_what_they_say(name: str) -> None:
    flags = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
    assert doctest.testmod(importlib.import_module(name), optionflags=flags).failed == 0
