"""`use:` finds built-ins, plug-ins, classes in modules and in loose files, and says what it cannot find."""

from __future__ import annotations

import importlib
import itertools
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tactflow.config.registry import catalogue, resolve
from tactflow.engine.errors import ConfigError

STAGE = """
from __future__ import annotations

from tactflow.engine.contract import Stage, StageParams
from tactflow.ports import Image
from tactflow.vision.types import Contact


class {name}(Stage):
    memory = "pure"

    def __init__(self, params: StageParams) -> None: ...

    def process(self, image: Image) -> Contact: ...
"""

Install = Callable[..., str]
_numbers = itertools.count()


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Install]:
    """Install a distribution with one plug-in in a folder of its own; returns the name of its module."""
    added: list[str] = []

    def make(distribution: str, entry: str, body: str | None = None, section: str = "stages") -> str:
        module = f"plug_{next(_numbers)}"
        folder = tmp_path / distribution
        info = folder / f"{distribution}-2.1.dist-info"
        info.mkdir(parents=True)
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {distribution}\nVersion: 2.1\n")
        (info / "entry_points.txt").write_text(f"[tactflow.{section}]\n{entry} = {module}:Plug\n")
        (folder / f"{module}.py").write_text(STAGE.format(name="Plug") if body is None else body)
        monkeypatch.syspath_prepend(str(folder))
        importlib.invalidate_caches()
        added.append(module)
        return module

    yield make
    for module in added:
        sys.modules.pop(module, None)


def test_the_sink_zmq_does_not_hide_the_library_zmq(tmp_path: Path) -> None:
    sink = resolve("zmq", "sinks", tmp_path)
    assert sink.cls.__module__ == "tactflow.sinks.zmq"
    assert hasattr(importlib.import_module("zmq"), "Context")


def test_a_plug_in_is_found_by_the_name_of_its_entry_point(install: Install, tmp_path: Path) -> None:
    module = install("gel-tools", "edges")
    component = resolve("edges", "stages", tmp_path)
    assert component.origin == "plug-in gel-tools 2.1"
    assert component.cls.__module__ == module
    assert "edges" in [c.name for c in catalogue()[0]]


def test_a_built_in_wins_over_a_plug_in_of_its_name(install: Install, tmp_path: Path) -> None:
    module = install("gel-tools", "hull")
    assert resolve("hull", "stages", tmp_path).origin == "built-in"
    assert resolve(f"{module}:Plug", "stages", tmp_path).kind == "stage"


def test_two_plug_ins_with_one_name_are_an_error_that_names_both(install: Install, tmp_path: Path) -> None:
    install("gel-tools", "edges")
    install("other-tools", "edges")
    with pytest.raises(ConfigError) as caught:
        resolve("edges", "stages", tmp_path)
    assert "plug-in gel-tools 2.1" in str(caught.value)
    assert "plug-in other-tools 2.1" in str(caught.value)


def test_a_plug_in_that_cannot_be_imported_is_reported_with_its_line(
    install: Install, tmp_path: Path
) -> None:
    module = install("gel-tools", "edges", "\nimport no_such_thing\n")
    with pytest.raises(ConfigError, match=rf"{module}\.py:2: .*No module named 'no_such_thing'"):
        resolve("edges", "stages", tmp_path)


def test_a_loose_file_is_taken_from_the_first_folder_that_has_it(tmp_path: Path) -> None:
    for folder, name in (("a", "First"), ("b", "Second")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / f"{name}.py").write_text(STAGE.format(name=name))
    folders = tmp_path / "a", tmp_path / "b"
    (tmp_path / "b" / "First.py").write_text(STAGE.format(name="Other"))
    assert resolve("./First.py", "stages", *folders).cls.__name__ == "First"
    assert resolve("./Second.py", "stages", *folders).cls.__name__ == "Second"
    with pytest.raises(
        ConfigError, match=rf"cannot read ./no\.py: .* \({folders[0]}/no.py or {folders[1]}/no.py\)"
    ):
        resolve("./no.py", "stages", *folders)


def test_a_loose_file_is_run_once_and_again_when_it_has_changed(tmp_path: Path) -> None:
    path = tmp_path / "edges.py"
    path.write_text(STAGE.format(name="Edges"))
    first = resolve("./edges.py", "stages", tmp_path).cls
    assert resolve("./edges.py", "stages", tmp_path).cls is first
    path.write_text(STAGE.format(name="Edges") + "    version = 2\n")
    second = resolve("./edges.py", "stages", tmp_path).cls
    assert second is not first
    assert second.__dict__["version"] == 2


def test_a_class_imported_into_a_loose_file_does_not_count_as_its_own(tmp_path: Path) -> None:
    (tmp_path / "edges.py").write_text(
        "from tactflow.stages.hull import Hull\n"
        + STAGE.format(name="Edges").replace("from __future__ import annotations", "")
    )
    assert resolve("./edges.py", "stages", tmp_path).cls.__name__ == "Edges"
