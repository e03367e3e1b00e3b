"""Foreign formats are plug-ins: found by their entry points, and each can be deleted."""

from __future__ import annotations

import ast
import sys
import tomllib
from importlib.metadata import EntryPoint
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import tactflow
from tactflow.cli.main import main
from tactflow.config.registry import catalogue, names
from tactflow.engine.errors import SourceError
from tactflow.sources import FrameReader, open_source
from tactflow.system import plugins
from tests.paths import REPOSITORY

DECLARED = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]["entry-points"]
PLUGINS = sorted(path.parent.name for path in (REPOSITORY / "plugins").glob("*/__init__.py"))


def test_nothing_else_imports_a_plug_in() -> None:
    files = [file for folder in ("src", "stages", "sinks") for file in (REPOSITORY / folder).rglob("*.py")]
    for file in files:
        for node in ast.walk(ast.parse(file.read_text())):
            found = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            found += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not any(name.startswith("tactflow.plugins") for name in found), file


def test_the_installed_entry_points_are_those_of_pyproject() -> None:
    """If this fails, the environment is older than the checkout: pip install --no-deps -e ."""
    for group, declared in DECLARED.items():
        installed = {
            entry.name: entry.value for entry in plugins.plugins(group) if entry.value.startswith("tactflow.")
        }
        assert installed == declared


@pytest.mark.parametrize("plugin", PLUGINS)
def test_all_else_works_without_a_plug_in(
    plugin: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    module = f"tactflow.plugins.{plugin}"
    lost = {
        group: [name for name, value in points.items() if value.startswith(f"{module}.")]
        for group, points in DECLARED.items()
    }
    assert any(lost.values()), "it has no entry point"
    installed = plugins._installed
    monkeypatch.setitem(sys.modules, module, None)
    monkeypatch.setattr(
        plugins, "_installed", lambda *of: [p for p in installed(*of) if not p.value.startswith(f"{module}.")]
    )
    np.save(tmp_path / "gel.npy", np.zeros((3, 48, 64, 3), np.uint8))
    sinks = {"jsonl": {"path": str(tmp_path / "out.jsonl")}}
    assert (
        tactflow.run("markerless", source=str(tmp_path / "gel.npy"), settings={"sinks": sinks}).exit_code == 0
    )
    assert catalogue()[1] == []
    assert not set(lost["tactflow.sinks"]) & set(names("sinks"))
    assert not set(lost["tactflow.stages"]) & set(names("stages"))
    for key in lost["tactflow.sources"]:
        path = tmp_path / (f"press{key}" if key.startswith(".") else f"{plugin}/{key}")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"a file of this kind")
        for spec in (f"{path}?topic=/gel", str(tmp_path / plugin), f"{key}:press"):
            with pytest.raises(SourceError):
                open_source(spec)
    for name in lost["tactflow.exports"]:
        assert main(["export", name, str(tmp_path / "gel.npy"), "--out", str(tmp_path / "out")]) == 2
        assert f"there is no format {name}" in capsys.readouterr().err
    for name in lost["tactflow.commands"]:
        assert main([name]) == 2
        assert f"there is no command {name}" in capsys.readouterr().err


class Opened(FrameReader):
    """What a plug-in opens."""

    def __init__(self, spec: str, _: Path | None, fps: float | None) -> None:
        super().__init__(spec)
        self.description = f"{spec} at {fps}"


def test_a_plug_in_opens_a_suffix_a_prefix_and_a_folder_by_a_file_in_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    keys = (".gel", "gel", "gel.json")
    points = [EntryPoint(key, f"{__name__}:Opened", "tactflow.sources") for key in keys]
    monkeypatch.setattr(plugins, "_installed", lambda *_: points)
    monkeypatch.setitem(sys.modules, __name__, SimpleNamespace(Opened=Opened))
    (tmp_path / "press").mkdir()
    (tmp_path / "press" / "gel.json").touch()
    (tmp_path / "press.gel").touch()
    for spec in (f"{tmp_path}/press.gel?a=1", f"gel:{tmp_path}/press.gel", f"{tmp_path}/press"):
        assert open_source(spec, fps=8).description == f"{spec} at 8"
    monkeypatch.setitem(sys.modules, __name__, SimpleNamespace())
    with pytest.raises(SourceError, match=r"the plug-in .*:Opened cannot be loaded"):
        open_source(f"{tmp_path}/press.gel")
