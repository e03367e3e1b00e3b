"""Who may import whom, and that the pages for contributors name what is there."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tactflow.config.registry import catalogue
from tests.clock import PATIENCE

REPOSITORY = Path(__file__).resolve().parents[1]
CONTRIBUTING = (REPOSITORY / "CONTRIBUTING.md").read_text()
PAGES = ["CONTRIBUTING.md", "docs/architecture.md"]

OUTER = ("tactflow.tools", "tactflow.plugins", "lab")
"""Tools, plug-ins and the laboratory, which the core does not import."""

ROOMS = {
    "src/tactflow/engine": ("cv2", "zmq", "tactflow.vision", "tactflow.config", "tactflow.stages"),
    "src/tactflow/config": ("cv2", "zmq", "tactflow.vision", "tactflow.cli", "tactflow.tools"),
    "src/tactflow/vision": ("zmq", "tactflow.engine", "tactflow.config", "tactflow.stages"),
    "src/tactflow/calibration": ("zmq", "tactflow.stages", "tactflow.sinks", "tactflow.cli"),
    "src/tactflow/tools/fleet": ("tactflow.cli", "tactflow.stages", "tactflow.sinks"),
    "src/tactflow/tools/batch": ("tactflow.tools.bench",),
    "src/tactflow/classic": ("tactflow.stages", "tactflow.cli"),
    "stages": ("tactflow.stages", "tactflow.config", "tactflow.cli"),
    "sinks": ("tactflow.stages", "tactflow.config", "tactflow.cli"),
}
"""Folder -> what nothing in it imports."""


def imports(file: Path) -> Iterator[str]:
    """Every module that a file imports, anywhere in it."""
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


@pytest.mark.parametrize("room", ROOMS)
def test_a_room_imports_nothing_that_it_must_not_know(room: str) -> None:
    found = [
        f"{file.relative_to(REPOSITORY)}: {module}"
        for file in (REPOSITORY / room).rglob("*.py")
        for module in imports(file)
        if any(module == banned or module.startswith(f"{banned}.") for banned in ROOMS[room])
    ]
    assert not found


def files_of_the_core() -> list[Path]:
    tools = REPOSITORY / "src/tactflow/tools"
    folders = [REPOSITORY / folder for folder in ("src", "stages", "sinks")]
    return [file for folder in folders for file in folder.rglob("*.py") if tools not in file.parents]


def test_arrows_go_from_tools_plugins_and_laboratory_to_the_core_and_never_back() -> None:
    outer = [REPOSITORY / folder for folder in ("src/tactflow/tools", "plugins")]
    outside = [file for folder in outer for file in folder.rglob("*.py")]
    found = [
        f"{file.relative_to(REPOSITORY)}: {module}"
        for files, banned in ((files_of_the_core(), OUTER), (outside, ("lab",)))
        for file in files
        for module in imports(file)
        if any(module == name or module.startswith(f"{name}.") for name in banned)
    ]
    assert not found


def test_the_engine_names_no_port_but_that_of_its_source_and_no_way_of_publishing() -> None:
    ports = {port.name for component in catalogue()[0] for port in component.ports.outputs} - {"frame"}
    assert {"contact", "contact_mask", "touching"} <= ports
    engine = {file: file.read_text() for file in (REPOSITORY / "src/tactflow/engine").rglob("*.py")}
    named = [
        f"{file.name}:{node.lineno}: {node.value}"
        for file, text in engine.items()
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Constant) and node.value in ports
    ]
    assert not named
    assert not [file for file, text in engine.items() if re.search("zmq|zeromq", text, re.I)]


class Imports(ast.NodeVisitor):
    """Collects what a file imports when it runs; each import as the names it may stand for, longest first."""

    def __init__(self) -> None:
        self.found: list[list[str]] = []

    def visit_If(self, node: ast.If) -> None:
        only_for_types = isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"
        for statement in node.orelse if only_for_types else [*node.body, *node.orelse]:
            self.visit(statement)

    def visit_Import(self, node: ast.Import) -> None:
        self.found += [[alias.name] for alias in node.names]

    def visit_ImportFrom(self, node: ast.ImportFrom) -> None:
        self.found += [[f"{node.module}.{alias.name}", str(node.module)] for alias in node.names]


def import_graph() -> dict[str, set[str]]:
    """Module of the package -> the modules of the package that it imports, at its start or in a function."""
    packages = {"src/tactflow": "tactflow", "stages": "tactflow.stages", "sinks": "tactflow.sinks"}
    files = {
        ".".join([package, *file.relative_to(REPOSITORY / folder).with_suffix("").parts]): file
        for folder, package in packages.items()
        for file in (REPOSITORY / folder).rglob("*.py")
    }
    modules = {name.removesuffix(".__init__"): file for name, file in files.items()}
    graph = {}
    for name, file in modules.items():
        visitor = Imports()
        visitor.visit(ast.parse(file.read_text()))
        imported = {next((one for one in names if one in modules), name) for names in visitor.found}
        graph[name] = imported - {name}
    return graph


def room_graph(modules: dict[str, set[str]]) -> dict[str, set[str]]:
    """Room -> the rooms that it imports; a module at the top of the package, and each tool, is a room."""

    def room(module: str) -> str:
        return ".".join(module.split(".")[: 3 if module.startswith("tactflow.tools.") else 2])

    rooms: dict[str, set[str]] = {room(name): set() for name in modules}
    for name, imported in modules.items():
        rooms[room(name)] |= {room(other) for other in imported} - {room(name), "tactflow"}
    return rooms


@pytest.mark.parametrize("level", [dict, room_graph], ids=["modules", "rooms"])
def test_nothing_imports_itself_by_way_of_others(
    level: Callable[[dict[str, set[str]]], dict[str, set[str]]],
) -> None:
    graph = level(import_graph())
    assert len(graph) > 20

    def reached(start: str) -> set[str]:
        found: set[str] = set()
        pending = [start]
        while pending:
            new = graph[pending.pop()] - found
            found |= new
            pending += new
        return found

    assert [name for name in graph if name in reached(name)] == []


def anchors(page: Path) -> set[str]:
    """What a link to a heading of a page ends in."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(), re.M)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


def test_every_link_of_every_page_leads_to_a_file_and_a_heading() -> None:
    pages = [REPOSITORY / "README.md", REPOSITORY / "CONTRIBUTING.md", *(REPOSITORY / "docs").glob("*.md")]
    lost = []
    for page in pages:
        for file, heading in re.findall(r"\]\(([^)#:\s]*)(?:#([\w-]+))?\)", page.read_text()):
            there = page.parent / file if file else page
            if not there.exists() or (heading and heading not in anchors(there)):
                lost.append(f"{page.name}: {file}#{heading}")
    assert len(pages) > 12
    assert not lost


@pytest.mark.parametrize("page", PAGES)
def test_every_file_that_a_page_for_contributors_names_is_there(page: str) -> None:
    text = (REPOSITORY / page).read_text()
    named = set(re.findall(r"`((?:[\w-]+/)+[\w-]*(?:\.\w+)?)`", text))
    own = {"stages/invert.py", "sinks/count.py", "tests/stages/test_invert.py", "frames/"}
    for path in named - own:
        source = REPOSITORY / "src"
        inside = [REPOSITORY, source, *(folder for folder in source.rglob("*") if folder.is_dir())]
        assert any((place / path).exists() for place in inside), path


def wordless_numbers(file: Path) -> Iterator[str]:
    """Numeric constants of a module with no words under them or under the group that they stand in."""
    group: list[str] = []
    for statement in ast.parse(file.read_text()).body:
        targets = statement.targets if isinstance(statement, ast.Assign) else []
        targets = [statement.target] if isinstance(statement, ast.AnnAssign) else targets
        names = [t.id for t in targets if isinstance(t, ast.Name) and t.id.strip("_").isupper()]
        value = getattr(statement, "value", None)
        numbers = value is not None and any(
            isinstance(part, ast.Constant) and type(part.value) in (int, float) for part in ast.walk(value)
        )
        if names and numbers and not isinstance(value, ast.Dict):
            group += names
        elif isinstance(value, ast.Constant) and isinstance(value.value, str) and not names:
            group = []
        elif not names:
            yield from group
            group = []
    yield from group


def test_every_number_with_a_name_says_what_it_means() -> None:
    folders = [REPOSITORY / name for name in ("src", "stages", "sinks")]
    files = [file for folder in folders for file in folder.rglob("*.py")]
    found = [f"{file.relative_to(REPOSITORY)}: {name}" for file in files for name in wordless_numbers(file)]
    assert not found


def test_no_class_is_made_while_the_program_runs() -> None:
    """A component is constructed with other arguments (`Component.make`), never by a class forged for it."""
    forged = []
    for folder in ("src", "stages", "sinks", "plugins"):
        for file in (REPOSITORY / folder).rglob("*.py"):
            for node in ast.walk(ast.parse(file.read_text())):
                is_call = isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
                makes_class = is_call and node.func.id == "type" and len(node.args) == 3  # type: ignore[union-attr]
                names = {target.id for target in getattr(node, "targets", ()) if isinstance(target, ast.Name)}
                if makes_class or "__signature__" in names:
                    forged.append(f"{file.relative_to(REPOSITORY)}:{node.lineno}")  # type: ignore[attr-defined]
    assert not forged


def test_every_function_fits_on_a_screen() -> None:
    long = []
    for folder in ("src", "stages", "sinks"):
        for file in (REPOSITORY / folder).rglob("*.py"):
            for node in ast.walk(ast.parse(file.read_text())):
                if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.end_lineno is not None:
                    lines = node.end_lineno - node.lineno + 1
                    if lines > 60:
                        long.append(f"{file.relative_to(REPOSITORY)}: {node.name} has {lines} lines")
    assert not long


def block(first_line: str) -> str:
    """The code block of CONTRIBUTING.md that starts with this line."""
    blocks = re.findall(r"```python\n(.*?)```", CONTRIBUTING, re.S)
    (found,) = [text for text in blocks if text.startswith(first_line)]
    return found


def test_the_stage_and_the_sink_for_contributors_run(tmp_path: Path) -> None:
    (tmp_path / "invert.py").write_text(block("# stages/invert.py"))
    (tmp_path / "count.py").write_text(block("# sinks/count.py"))
    (tmp_path / "pipeline.yaml").write_text(
        'stages:\n  capture: {source: "sim:press?frames=40"}\n  preprocess: {rotate: 90, downsample: 2}\n'
        "  invert: {use: ./invert.py, strength: 1.0}\n"
        "  difference: {in: {unmarked: invert.inverted}}\n  hull: {when: touching}\n"
        "sinks:\n  count: {use: ./count.py}\n"
    )
    command = [sys.executable, "-m", "tactflow", "run", "--quiet", "--check", "pipeline.yaml"]
    done = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, timeout=PATIENCE, check=False
    )
    assert done.returncode == 0, done.stderr
    assert int((tmp_path / "contacts.txt").read_text()) > 0
