"""Lines of Python and C per house and room: `python -m lab.lines [FOLDER]`, of this checkout or another one.

A line of code is one that holds a token other than a comment or a docstring. Tests are counted apart,
wherever they live."""

from __future__ import annotations

import ast
import re
import sys
import tokenize
from collections import Counter
from pathlib import Path

HOUSES = ("core", "tools", "plugins", "lab", "tests", "other")
SKIPPED = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENCODING,
    tokenize.ENDMARKER,
}
"""Tokens that are no code."""


def place(file: Path) -> tuple[str, str]:
    """House and room of a file, given relative to the repository.

    >>> place(Path("src/tactflow/tools/bench/run.py")), place(Path("plugins/onnx/tests/test_network.py"))
    (('tools', 'bench'), ('tests', 'plugins'))
    """
    first, *rest = file.parts
    if first == "tests" or "tests" in rest or "test" in rest or file.name == "conftest.py":
        return "tests", first if first != "tests" else (rest[0] if len(rest) > 1 else "tests")
    if first in ("plugins", "lab"):
        return first, rest[0] if len(rest) > 1 else first
    if first in ("stages", "sinks", "pipelines"):
        return "core", first
    if first == "src":
        inside = rest[1:]
        if inside[0] == "tools":
            return "tools", inside[1] if len(inside) > 2 else "tools"
        return "core", inside[0] if len(inside) > 1 else "tactflow"
    return "other", first


def code_lines(file: Path) -> int:
    """Number of lines with code."""
    text = file.read_text(encoding="utf-8")
    if file.suffix in (".c", ".h"):
        return sum(
            bool(line.strip()) for line in re.sub(r"/\*.*?\*/", "", text, flags=re.DOTALL).splitlines()
        )
    docstrings: set[int] = set()
    for node in ast.walk(ast.parse(text)):
        if (
            isinstance(node, ast.Expr)
            and isinstance(node.value, ast.Constant)
            and isinstance(node.value.value, str)
        ):
            docstrings |= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    with file.open("rb") as stream:
        found = {
            line
            for token in tokenize.tokenize(stream.readline)
            if token.type not in SKIPPED
            for line in range(token.start[0], token.end[0] + 1)
        }
    return len(found - docstrings)


def count(repository: Path) -> dict[tuple[str, str], Counter[str]]:
    """(house, room) -> numbers of files, lines and lines of code."""
    rooms: dict[tuple[str, str], Counter[str]] = {}
    for file in sorted([*repository.rglob("*.py"), *repository.rglob("*.[ch]")]):
        inside = file.relative_to(repository)
        if inside.parts[0].startswith(".") or inside.parts[0] in ("build", "dist"):
            continue
        room = rooms.setdefault(place(inside), Counter())
        room.update(files=1, lines=len(file.read_text(encoding="utf-8").splitlines()), code=code_lines(file))
    return rooms


def main(argv: list[str]) -> None:
    """Print a Markdown table."""
    rooms = count(Path(argv[0]) if argv else Path(__file__).resolve().parents[1])
    print("| house | room | files | lines | code |\n| --- | --- | ---: | ---: | ---: |")
    for house in HOUSES:
        inside = {room: numbers for (owner, room), numbers in rooms.items() if owner == house}
        whole: Counter[str] = sum(inside.values(), Counter())
        print(f"| **{house}** | | {whole['files']} | {whole['lines']:,} | {whole['code']:,} |")
        for room, numbers in sorted(inside.items(), key=lambda item: -item[1]["lines"]):
            print(f"| | {room} | {numbers['files']} | {numbers['lines']:,} | {numbers['code']:,} |")


if __name__ == "__main__":
    main(sys.argv[1:])
