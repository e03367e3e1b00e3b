"""Every example in a docstring runs and shows what it says."""

from __future__ import annotations

import doctest
import enum
import importlib
import inspect
import pkgutil
import re
from pathlib import Path

import pytest

import tactflow
from tactflow import sinks, stages
from tactflow.config.registry import catalogue


def modules() -> list[str]:
    """Every module of the package, whose stages and sinks stand in folders of their own."""
    found = {module.name for module in pkgutil.walk_packages(tactflow.__path__, "tactflow.")}
    for package in (stages, sinks):
        found |= {f"{package.__name__}.{module.name}" for module in pkgutil.iter_modules(package.__path__)}
    return ["tactflow", *sorted(name for name in found if not name.endswith("__main__"))]


@pytest.mark.parametrize("name", modules())
def test_the_examples_of_a_module_run(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    module = importlib.import_module(name)
    monkeypatch.chdir(tmp_path)
    flags = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
    assert doctest.testmod(module, optionflags=flags).failed == 0


@pytest.mark.parametrize(
    "name", [module.name for package in (stages, sinks) for module in pkgutil.iter_modules(package.__path__)]
)
def test_every_stage_and_sink_has_an_example(name: str) -> None:
    (component,) = (component for component in catalogue()[0] if component.name == name)
    assert ">>>" in (component.cls.__doc__ or "")


@pytest.mark.parametrize("name", tactflow.__all__)
def test_everything_public_has_an_example(name: str) -> None:
    assert ">>>" in (getattr(tactflow, name).__doc__ or "")


@pytest.mark.parametrize("name", tactflow.__all__)
def test_everything_public_says_what_it_takes_and_raises(name: str) -> None:
    public = getattr(tactflow, name)
    text = f"{public.__doc__} {public.__init__.__doc__ if inspect.isclass(public) else ''}"
    if not (inspect.isclass(public) and issubclass(public, (enum.Enum, Exception))):
        parameters = inspect.signature(public).parameters.values()
        taken = [p.name for p in parameters if p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)]
        assert {word for word in taken if word[0] != "_" and not re.search(rf"\b{word}\b", text)} == set()
    if inspect.isfunction(public):
        assert re.search(r"\braises\b", text, re.IGNORECASE)
        arrays = "NDArray" in str(inspect.signature(public))
        assert not arrays or re.search(r"\([A-Z], [A-Z0-9, ]+\)", text), "without the shape of an array"


@pytest.mark.parametrize(
    "name", [name for name in tactflow.__all__ if inspect.isclass(getattr(tactflow, name))]
)
def test_every_public_method_is_described(name: str) -> None:
    public = getattr(tactflow, name)
    for key, member in vars(public).items():
        function = getattr(member, "fget", None) or getattr(member, "__func__", member)
        if inspect.isfunction(function) and not key.startswith("_"):
            assert function.__doc__ or re.search(rf"\b{key}\b.* : ", public.__doc__), key
